"""Text files of Xsens MT Manager (MTw, MTi): one sensor a file, named by the serial at its name's end.

Lines that begin with ``//`` tell the update rate; then come columns, separated by tabs, commas or
semicolons, of which these are read: PacketCounter; Acc (m/s^2, gravity included, sensor axes) or else
FreeAcc (gravity removed, axes of the local earth frame); Gyr (rad/s); Mag; orientation from the sensor
to the local earth frame (ENU) as Quat_q0 ... q3, else Mat[row][column], else Roll, Pitch, Yaw (degrees,
about x, y, z: R = Rz Ry Rx). Times are PacketCounter / rate: sensors of one trial share a clock.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.errors import FileFormatError
from rtof_kin.inertial.declaration import Declaration
from rtof_kin.inertial.packets import WRAP_16, WRAP_32, Packets, aligned, in_order, lost
from rtof_kin.inertial.readings import Readings, sensor_log
from rtof_kin.inertial.streams import SensorLog
from rtof_kin.io.sensor_text import SensorTable, cells, read_table

Array = NDArray[np.float64]
TITLE = "Xsens MT Manager text"
_ACC, _FREE = ("Acc_X", "Acc_Y", "Acc_Z"), ("FreeAcc_X", "FreeAcc_Y", "FreeAcc_Z")
_FREE_ENU = ("FreeAcc_E", "FreeAcc_N", "FreeAcc_U")
_GYR, _MAG = ("Gyr_X", "Gyr_Y", "Gyr_Z"), ("Mag_X", "Mag_Y", "Mag_Z")
_QUAT = ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3")
_MAT = tuple(f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3))
_EULER = ("Yaw", "Pitch", "Roll")
_COUNTER, _STAMP = "PacketCounter", "SampleTimeFine"
_WANTED = {
    name.lower()
    for group in (_ACC, _FREE, _FREE_ENU, _GYR, _MAG, _QUAT, _MAT, _EULER, (_COUNTER, _STAMP))
    for name in group
}
_RATE = re.compile(r"//\s*Update Rate:\s*([\d.]+)\s*Hz", re.IGNORECASE)
_LATEST_PACKETS = 200


def is_header(names: Sequence[str]) -> bool:
    """Whether these are column names of such a file."""
    low = {name.lower() for name in names}
    groups = (_ACC, _FREE, _FREE_ENU, _GYR, _QUAT, _MAT)
    return any(all(name.lower() in low for name in group) for group in groups)


def is_xsens_mt(head: str) -> bool:
    """Whether a file that begins so is such a file."""
    lines = [line for line in head.splitlines() if line.strip()]
    names = next((cells(line) for line in lines if not line.lstrip().startswith("//")), [])
    return is_header(names) and "quat_w" not in map(str.lower, names)


def read_xsens_mt(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """The sensors of one trial.

    Args:
        paths: a file for each sensor.
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` instead of
            the header's.

    Raises:
        FileFormatError: not such a file, no rate, a counter that started anew, sensors of two trials.
    """
    tables = [read_table(path, is_header, lambda name: name.lower() in _WANTED) for path in paths]
    names = [_name(path) for path in paths]
    has_raw = [table.columns(*_ACC) is not None for table in tables]
    if any(has_raw) and not all(has_raw):
        at = paths[has_raw.index(False)]
        raise FileFormatError(at, "has no Acc_X, Acc_Y, Acc_Z as other files of the trial do")
    own = Declaration() if all(has_raw) else Declaration(gravity="removed", acceleration_axes="inertial")
    declaration = own.changed(**declared)
    notes, packets, rates = [], [], []
    for name, table in zip(names, tables, strict=True):
        rate = declaration.rate_hz or _rate(table)
        one = _packets(table)
        told = (*table.notes, *one.notes, *lost(one.count / rate, rate), *_stamps(table, one, rate))
        notes += [f"{name}: {note}" for note in told]
        packets.append(one)
        rates.append(rate)
    shifts = aligned([int(one.count[0]) for one in packets], WRAP_16)
    readings = [
        _readings(name, table, one.rows, (one.count + shift) / rate)
        for name, table, one, shift, rate in zip(names, tables, packets, shifts, rates, strict=True)
    ]
    return sensor_log(paths, TITLE, readings, declaration, notes)


def _name(path: Path) -> str:
    """The serial number at the end of a file's name, in capitals; else the end as it is."""
    last = path.stem.split("_")[-1]
    return last.upper() if re.fullmatch(r"[0-9A-Fa-f]{8}", last) else last


def _rate(table: SensorTable) -> float:
    for line in table.header:
        found = _RATE.match(line.strip())
        if found:
            return Declaration(rate_hz=float(found[1])).rate_hz or np.nan
    raise FileFormatError(table.path, "no line '// Update Rate: ... Hz'; declare rate_hz")


def _packets(table: SensorTable) -> Packets:
    counters = table.column(_COUNTER)
    if counters is None:
        rows = np.arange(len(table.values))
        return Packets(rows, rows, (f"no {_COUNTER}: packets that were lost cannot be seen",))
    wrap = WRAP_32 if (counters >= WRAP_16).any() else WRAP_16
    return in_order(table.path, counters, table.lines, wrap, _LATEST_PACKETS, _COUNTER)


def _stamps(table: SensorTable, packets: Packets, rate: float) -> tuple[str, ...]:
    """A sentence where the time stamps, in ticks of 0.1 ms, tell another rate."""
    stamps = table.column(_STAMP)
    if stamps is None or len(packets.rows) < 2 or not np.isfinite(stamps).all():
        return ()
    tick = float(np.median(np.diff(stamps[packets.rows]) / np.diff(packets.count)))
    if tick <= 0 or abs(tick * rate / 1e4 - 1) < 0.02:
        return ()
    return (
        f"{_STAMP} steps by {tick:g}, which is {1e4 / tick:.4g} Hz in its ticks of 0.1 ms or "
        f"{1e6 / tick:.4g} Hz in microseconds, and the rate is taken as {rate:g} Hz; declare rate_hz if "
        "that is wrong",
    )


def _readings(name: str, table: SensorTable, rows: NDArray[np.int64], times: Array) -> Readings:
    def taken(*names: str) -> Array | None:
        columns = table.columns(*names)
        return None if columns is None else columns[rows]

    free = taken(*_FREE) if taken(*_FREE_ENU) is None else taken(*_FREE_ENU)
    acceleration = free if taken(*_ACC) is None else taken(*_ACC)
    matrices = taken(*_MAT)
    if matrices is not None:
        matrices = matrices.reshape(-1, 3, 3)
    euler = taken(*_EULER)
    if matrices is None and euler is not None:
        matrices = so3.euler_to_matrix("zyx", np.deg2rad(euler))
    return Readings(name, times, acceleration, taken(*_GYR), taken(*_MAG), taken(*_QUAT), matrices)
