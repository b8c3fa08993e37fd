"""Plain CSV of inertial sensors, for any logger.

The first line names the columns, the others hold numbers; commas, decimal points, UTF-8; an empty cell
or ``nan`` is a missing sample. ``time`` is in seconds and increases; without it the rate is declared, and
the first line is 0 s. NAME is a sensor's, of any characters but commas:

=====================================  =============================================================
NAME_fx, NAME_fy, NAME_fz              specific force, sensor axes: 9.81 m/s^2 upwards at rest
NAME_wx, NAME_wy, NAME_wz              angular velocity, sensor axes, rad/s
NAME_mx, NAME_my, NAME_mz              magnetic field, sensor axes, any unit
NAME_qw, NAME_qx, NAME_qy, NAME_qz     unit quaternion from the sensor to a reference with z up
=====================================  =============================================================

Each sensor has one or more complete groups. Other units, axes and order can be declared.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import SensorTable, cells, read_table

TITLE: Final = "plain CSV"
_GROUPS: Final = {"f": "xyz", "w": "xyz", "m": "xyz", "q": "wxyz"}
_ENDINGS: Final = tuple(f"_{kind}{axis}" for kind, axes in _GROUPS.items() for axis in axes)


def _is_header(names: Sequence[str]) -> bool:
    return any(name[-3:] in _ENDINGS for name in names)


def is_imu_csv(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return _is_header(cells(head.split("\n", 1)[0]))


def read_imu_csv(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    declaration = Declaration().changed(**declared)
    table = read_table(path, _is_header, lambda name: True)
    columns = [name for name in table.names if name != "time"]
    for column in columns:
        if column[-3:] not in _ENDINGS or len(column) == 3:
            known = "time, or a sensor's name and one of " + ", ".join(_ENDINGS)
            raise FileFormatError(path, f"column {column!r}: expected {known}", 1)
    times = _times(table, declaration.rate_hz)
    readings = []
    for name in dict.fromkeys(column[:-3] for column in columns):
        f, w, m, q = (_group(table, f"{name}_{kind}", axes) for kind, axes in _GROUPS.items())
        readings.append(Readings(name, times, f, w, m, q))
    return sensor_log([path], TITLE, readings, declaration, (*table.notes, *lost(times)))


def _group(table: SensorTable, start: str, axes: str) -> Array | None:
    """Return the columns of one group; None where all of them are absent."""
    lacking = [start + axis for axis in axes if start + axis not in table.names]
    if 0 < len(lacking) < len(axes):
        raise FileFormatError(table.path, f"there is no column {', '.join(lacking)}", 1)
    return None if lacking else table.columns(*(start + axis for axis in axes))


def _times(table: SensorTable, rate_hz: float | None) -> Array:
    times = table.column("time")
    if rate_hz is not None:
        return np.arange(len(table.values)) / rate_hz
    if times is None:
        raise FileFormatError(table.path, "no column time (s); add it, or declare rate_hz", 1)
    wrong = np.flatnonzero(~(np.diff(times, prepend=-np.inf) > 0))
    if len(wrong):
        i = int(wrong[0])
        problem = f"time {times[i]:g} s is not after the one above; sort, and drop what came twice"
        raise FileFormatError(table.path, problem, table.lines[i])
    return times
