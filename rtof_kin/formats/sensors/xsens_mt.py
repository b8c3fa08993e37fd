"""Text files of Xsens MT Manager (MTw, MTi): one sensor a file, named by the serial at its name's end.

Lines that begin with ``//`` tell the update rate; then come columns, separated by tabs, commas or
semicolons, of which these are read: PacketCounter; Acc (m/s^2, gravity included, sensor axes) or else
FreeAcc (gravity removed, axes of the local earth frame); Gyr (rad/s); Mag; orientation from the sensor
to the local earth frame (ENU) as Quat_q0 ... q3, else Mat[row][column], else Roll, Pitch, Yaw. Times are
PacketCounter / rate, so that sensors of one trial share a clock.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.packets import WRAP_16, WRAP_32, Packets, aligned, in_order, lost
from rtof_kin.formats.sensors.readings import sensor_log
from rtof_kin.formats.sensors.sensor_text import SensorTable, cells, read_table
from rtof_kin.formats.sensors.xsens_columns import (
    COUNTER,
    STAMP,
    acceleration_declared,
    is_header,
    is_read,
    readings,
)

TITLE = "Xsens MT Manager text"
_RATE = re.compile(r"//\s*Update Rate:\s*([\d.]+)\s*Hz", re.IGNORECASE)
_SERIAL = re.compile(r"[0-9A-Fa-f]{8}")
_LATEST_PACKETS = 100


def is_xsens_mt(head: str) -> bool:
    """Whether a file that begins so is such a file."""
    lines = head.splitlines()
    names = next((cells(line) for line in lines if line.strip() and line[:2] != "//"), [])
    has_comments = any(line[:2] == "//" for line in lines)
    return is_header(names) and (has_comments or "Quat_q0" in names or "Mat[1][1]" in names)


def read_xsens_mt(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """The sensors of one trial.

    Args:
        paths: a file for each sensor.
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` instead of
            the header's.

    Raises:
        FileFormatError: not such a file, no rate, a counter that started anew, files of other columns
            or another rate than the first one.
    """
    tables = [read_table(path, is_header, is_read) for path in paths]
    declaration = Declaration(**acceleration_declared(tables)).changed(**declared)
    rate = declaration.rate_hz or _rate(tables)
    wrap = _wrap(tables)
    packets = [_packets(table, wrap) for table in tables]
    shifts = aligned([int(one.count[0]) for one in packets], wrap)
    sensors = []
    for table, one, shift in zip(tables, packets, shifts, strict=True):
        times = (one.count + shift) / rate
        notes = (*table.notes, *one.notes, *lost(times, rate), *_stamps(table, one, rate))
        sensors.append(readings(_name(table.path), table, one.rows, times, notes))
    return sensor_log(paths, TITLE, sensors, declaration)


def _name(path: Path) -> str:
    """The serial number at the end of a file's name, in capitals; else the end as it is."""
    last = path.stem.split("_")[-1]
    return last.upper() if _SERIAL.fullmatch(last) else last


def _rate(tables: Sequence[SensorTable]) -> float:
    rates = []
    for table in tables:
        found = [match for line in table.header if (match := _RATE.match(line.strip()))]
        if not found:
            raise FileFormatError(table.path, "has no line '// Update Rate: ... Hz'; declare rate_hz")
        try:
            rates.append(Declaration(rate_hz=float(found[0][1])).rate_hz or 0.0)
        except ValueError as error:
            raise FileFormatError(table.path, f"{found[0][0]!r}: {error}") from error
        if rates[-1] != rates[0]:
            problem = f"its rate is {rates[-1]:g} Hz and that of {tables[0].path.name} {rates[0]:g} Hz"
            raise FileFormatError(table.path, problem + "; name files of one trial")
    return rates[0]


def _wrap(tables: Sequence[SensorTable]) -> int:
    """Where the counters begin again: those of MTw have 16 bits, some of MTi 32."""
    counters = (table.column(COUNTER) for table in tables)
    wide = any(c is not None and (c >= WRAP_16).any() for c in counters)
    return WRAP_32 if wide else WRAP_16


def _packets(table: SensorTable, wrap: int) -> Packets:
    counters = table.column(COUNTER)
    if counters is None:
        rows = np.arange(len(table.values))
        return Packets(rows, rows, (f"no {COUNTER}: packets that were lost cannot be seen",))
    return in_order(table.path, counters, table.lines, wrap, _LATEST_PACKETS, COUNTER)


def _stamps(table: SensorTable, packets: Packets, rate: float) -> tuple[str, ...]:
    """A sentence where the time stamps tell another rate, in ticks of 0.1 ms as in microseconds."""
    stamps = table.column(STAMP)
    if stamps is None or len(packets.rows) < 2:
        return ()
    tick = float(np.median(np.diff(stamps[packets.rows]) / np.diff(packets.count)))
    if not tick > 0 or any(abs(tick * rate / per_second - 1) < 0.02 for per_second in (1e4, 1e6)):
        return ()
    return (
        f"{STAMP} steps by {tick:g}, which is {1e4 / tick:.4g} Hz in its ticks of 0.1 ms or "
        f"{1e6 / tick:.4g} Hz in microseconds, and the rate is taken as {rate:g} Hz; declare rate_hz if "
        "that is wrong",
    )
