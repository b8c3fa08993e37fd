"""Text tables of Xsens and Movella: MT Manager (MTw, MTi) and DOT; one sensor per file.

Columns read in both: Acc (m/s^2, gravity included, sensor axes) or else FreeAcc (gravity removed, axes of
the local earth frame), Gyr, Mag, and orientation from the sensor to the local earth frame (ENU) as
quaternion, else matrix, else Euler angles in degrees (R = Rz Ry Rx).

MT Manager: the file name ends with the serial number. Header lines begin with ``//`` and state the update
rate. Gyr in rad/s; Quat_q0 ... q3, Mat[row][column], or Roll, Pitch, Yaw. Times are PacketCounter / rate,
so sensors of one trial share a clock.

DOT: files are named ``NAME_date_time.csv``. Header lines ``DeviceTag``, ``OutputRate``. Gyr in deg/s;
Quat_W ... Z or Euler_X, _Y, _Z. Times are SampleTimeFine (us, wraps at 2^32), shared by synchronised
sensors; with a declared rate, that rate and PacketCounter give the times after the first stamp.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.readings import WRAP_16, WRAP_32, Packets, Readings, aligned, in_order, lost, sensor_log
from rtof_kin.formats.sensors.sensor_text import (
    MT_START,
    UTC_COLUMNS,
    SensorTable,
    cells,
    read_table,
    start_of_dot,
    start_of_mt,
    unzoned_note,
)

Groups = tuple[tuple[str, ...], ...]
MT_TITLE: Final = "Xsens MT Manager text"
DOT_TITLE: Final = "Movella DOT CSV"
_COUNTER: Final = "PacketCounter"
_STAMP: Final = "SampleTimeFine"
_ACCELERATION: Final[Groups] = (("Acc_X", "Acc_Y", "Acc_Z"),)
_KINDS: Final[dict[str, Groups]] = {
    "acceleration": _ACCELERATION,
    "free": (("FreeAcc_X", "FreeAcc_Y", "FreeAcc_Z"), ("FreeAcc_E", "FreeAcc_N", "FreeAcc_U")),
    "gyroscope": (("Gyr_X", "Gyr_Y", "Gyr_Z"),),
    "magnetometer": (("Mag_X", "Mag_Y", "Mag_Z"),),
    "quaternions": (("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"), ("Quat_W", "Quat_X", "Quat_Y", "Quat_Z")),
    "matrices": (tuple(f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)),),
    "euler": (("Yaw", "Pitch", "Roll"), ("Euler_Z", "Euler_Y", "Euler_X")),
}
"""Alternative groups of columns by what they measure."""
_MEASURES: Final = tuple(frozenset(name.lower() for name in group) for kind in _KINDS.values() for group in kind)
_READ: Final = frozenset({_COUNTER.lower(), _STAMP.lower()}.union(UTC_COLUMNS, *_MEASURES))
_RATE: Final = re.compile(r"(?://\s*Update Rate:\s*|OutputRate:\W*)([\d.]+)\s*Hz", re.IGNORECASE)
_SERIAL: Final = re.compile(r"[0-9A-Fa-f]{8}")
_DOT_NAME: Final = re.compile(r"(.+?)_\d{8}_\d{6}(_\d+)?")
_LATEST_PACKETS: Final = 100
_LATEST_US: Final = 1_000_000


def is_xsens_mt(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    lines = head.splitlines()
    names = next((cells(line) for line in lines if line.strip() and line[:2] != "//"), [])
    has_comments = any(line[:2] == "//" for line in lines)
    return _is_header(names) and (has_comments or "Quat_q0" in names or "Mat[1][1]" in names)


def is_xsens_dot(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    lines = head.splitlines()
    names = next((row for row in map(cells, lines) if _STAMP in row), [])
    tagged = any(line.startswith("DeviceTag") for line in lines)
    return _is_header(names) and (tagged or bool({"Quat_W", "Euler_X"} & set(names)))


def read_xsens_mt(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the header's."""
    tables = [_read(path) for path in paths]
    declaration = Declaration(**_acceleration_declared(tables)).changed(**declared)
    rate = declaration.rate_hz or _common_rate(tables)
    # Counters of MTw have 16 bits, those of some MTi 32.
    counters = (table.column(_COUNTER) for table in tables)
    wrap = WRAP_32 if any(c is not None and (c >= WRAP_16).any() for c in counters) else WRAP_16
    packets = [_counted(table, wrap) for table in tables]
    sensors = []
    for table, one, shift in zip(tables, packets, aligned(packets, wrap), strict=True):
        times = (one.count + shift) / rate
        notes = (*table.notes, *one.notes, *lost(times, rate), *_check_stamps(table, one, rate))
        serial = table.path.stem.split("_")[-1]
        name = serial.upper() if _SERIAL.fullmatch(serial) else serial
        sensors.append(_readings(name, table, one, times, notes))
    first = int(np.argmin([one.times[0] for one in sensors]))
    start = start_of_mt(tables[first], int(packets[first].rows[0]))
    stated = next((match[1] for line in tables[first].header if (match := MT_START.match(line.strip()))), None)
    notes = () if start else unzoned_note(stated)
    return sensor_log(paths, MT_TITLE, sensors, declaration, notes, start)


def read_xsens_dot(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` and the counter replace the time stamps."""
    tables = [_read(path) for path in paths]
    own = Declaration(angular_unit="deg/s", **_acceleration_declared(tables))
    declaration = own.changed(**declared)
    stamps = [_ordered(table, _STAMP, WRAP_32, _LATEST_US) for table in tables]
    sensors = []
    for table, by_stamp, shift in zip(tables, stamps, aligned(stamps, WRAP_32), strict=True):
        one, times = by_stamp, (by_stamp.count + shift) / 1e6
        if declaration.rate_hz is not None:
            one = _ordered(table, _COUNTER, WRAP_32, _LATEST_PACKETS)
            times = times[0] + (one.count - one.count[0]) / declaration.rate_hz
        notes = (*table.notes, *one.notes, *lost(times, declaration.rate_hz or _header_rate(table)))
        named = _DOT_NAME.fullmatch(table.path.stem)
        sensors.append(_readings(named[1] if named else table.path.stem, table, one, times, notes))
    first = int(np.argmin([one.times[0] for one in sensors]))
    return sensor_log(paths, DOT_TITLE, sensors, declaration, (), start_of_dot(tables[first].header))


# --- tables --------------------------------------------------------------------------------------


def _is_header(names: Iterable[str]) -> bool:
    low = {name.lower() for name in names}
    return any(group <= low for group in _MEASURES)


def _read(path: Path) -> SensorTable:
    return read_table(path, _is_header, lambda name: name.lower() in _READ)


def _first(table: SensorTable, kind: Groups) -> Array | None:
    """Return the first complete group of columns; refuse an incomplete one."""
    for group in kind:
        lacking = [name for name in group if table.column(name) is None]
        if not lacking:
            return table.columns(*group)
        if len(lacking) < len(group):
            there = ", ".join(name for name in group if name not in lacking)
            raise FileFormatError(
                table.path, f"has columns {there} and no {', '.join(lacking)}; export all of them, by these names"
            )
    return None


def _acceleration_declared(tables: Sequence[SensorTable]) -> dict[str, Any]:
    """Return the fields of `Declaration` for raw (Acc) or free (FreeAcc) acceleration."""
    lacking = [table.path for table in tables if _first(table, _ACCELERATION) is None]
    if not lacking:
        return {}
    if len(lacking) < len(tables):
        raise FileFormatError(
            lacking[0], "has no Acc_X, Acc_Y, Acc_Z, as other files of the trial have; export all alike"
        )
    return {"gravity": "removed", "acceleration_axes": "inertial"}


def _readings(name: str, table: SensorTable, packets: Packets, times: Array, notes: tuple[str, ...]) -> Readings:
    found = {kind: _first(table, groups) for kind, groups in _KINDS.items()}
    taken = {kind: None if columns is None else columns[packets.rows] for kind, columns in found.items()}
    acceleration, matrices = taken["acceleration"], taken["matrices"]
    if matrices is not None:
        matrices = matrices.reshape(-1, 3, 3)
    elif (euler := taken["euler"]) is not None:
        matrices = so3.euler_to_matrix("zyx", np.deg2rad(euler))
    return Readings(
        name,
        times,
        taken["free"] if acceleration is None else acceleration,
        taken["gyroscope"],
        taken["magnetometer"],
        taken["quaternions"],
        matrices,
        notes,
    )


# --- times ---------------------------------------------------------------------------------------


def _ordered(table: SensorTable, column: str, wrap: int, late: int) -> Packets:
    counters = table.column(column)
    if counters is None:
        raise FileFormatError(table.path, f"has no column {column}; export it too")
    return in_order(table.path, counters, table.lines, wrap, late, column)


def _counted(table: SensorTable, wrap: int) -> Packets:
    if table.column(_COUNTER) is None:
        rows = np.arange(len(table.values))
        return Packets(rows, rows, (f"no {_COUNTER}: packets that were lost cannot be seen",))
    return _ordered(table, _COUNTER, wrap, _LATEST_PACKETS)


def _header_rate(table: SensorTable) -> float | None:
    """Return the header's rate, Hz; None where absent or impossible."""
    found = next((match for line in table.header if (match := _RATE.match(line.strip()))), None)
    try:
        return None if found is None else Declaration(rate_hz=float(found[1])).rate_hz
    except ValueError:
        return None


def _common_rate(tables: Sequence[SensorTable]) -> float:
    rates = {rate: table.path for table in tables if (rate := _header_rate(table))}
    if len(rates) != 1 or not all(map(_header_rate, tables)):
        found = " and ".join(f"{rate:g} Hz in {path.name}" for rate, path in rates.items()) or "none"
        problem = f"each file needs a line '// Update Rate: ... Hz' with the same rate, found {found}; declare rate_hz"
        raise FileFormatError(tables[-1].path, problem)
    return next(iter(rates))


def _check_stamps(table: SensorTable, packets: Packets, rate: float) -> tuple[str, ...]:
    """Return a sentence where time stamps imply another rate, in ticks of 0.1 ms as in microseconds."""
    stamps = table.column(_STAMP)
    if stamps is None or len(packets.rows) < 2:
        return ()
    tick = float(np.median(np.diff(stamps[packets.rows]) / np.diff(packets.count)))
    if not tick > 0 or any(abs(tick * rate / per_second - 1) < 0.02 for per_second in (1e4, 1e6)):
        return ()
    said = f"{1e4 / tick:.4g} Hz in ticks of 0.1 ms or {1e6 / tick:.4g} Hz in microseconds"
    return (f"{_STAMP} steps by {tick:g}: {said}, and the rate is taken as {rate:g} Hz; else declare rate_hz",)
