"""The plain CSV of inertial sensors: for any logger, written with a few lines of code.

The first line names the columns, the others hold numbers; commas, decimal points, UTF-8; an empty cell
or ``nan`` is a missing sample. ``time`` is in seconds and increases; without it the rate is declared, and
the first line is 0 s. NAME is a sensor's, of any characters but commas:

=====================================  =============================================================
NAME_fx, NAME_fy, NAME_fz              specific force, sensor axes: 9.81 m/s^2 upwards at rest
NAME_wx, NAME_wy, NAME_wz              angular velocity, sensor axes, rad/s
NAME_mx, NAME_my, NAME_mz              magnetic field, sensor axes, any unit
NAME_qw, NAME_qx, NAME_qy, NAME_qz     unit quaternion from the sensor to a reference with z up
=====================================  =============================================================

Each sensor has one group or more, a group whole. Units, axes and order other than these can be declared
when the file is read. Columns q and f are those that a recording's own CSV has.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import SensorTable, cells, read_table

Array = NDArray[np.float64]
TITLE = "plain CSV"
_TIME = "time"
_GROUPS = {"f": "xyz", "w": "xyz", "m": "xyz", "q": "wxyz"}
_PARTS = {f"_{kind}{axis}": kind for kind, axes in _GROUPS.items() for axis in axes}


def _is_header(names: Sequence[str]) -> bool:
    return any(name[-3:] in _PARTS for name in names)


def is_imu_csv(head: str) -> bool:
    """Whether a file that begins so is such a file."""
    return _is_header(cells(head.split("\n", 1)[0]))


def read_imu_csv(path: Path, **declared: Any) -> SensorLog:
    """The sensors of one file.

    Args:
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` instead of
            the column of times.

    Raises:
        FileFormatError: not such a file, a group that lacks a column, a column of no meaning, no times.
    """
    declaration = Declaration().changed(**declared)
    table = read_table(path, _is_header, lambda name: True)
    groups = _groups(table)
    times = _times(table, declaration.rate_hz)
    readings = []
    for name, kinds in groups.items():
        found = {kind: table.columns(*(f"{name}_{kind}{axis}" for axis in _GROUPS[kind])) for kind in kinds}
        readings.append(Readings(name, times, found.get("f"), found.get("w"), found.get("m"), found.get("q")))
    return sensor_log([path], TITLE, readings, declaration, (*table.notes, *lost(times)))


def _groups(table: SensorTable) -> dict[str, list[str]]:
    """Kinds of columns that each sensor has, in the file's order."""
    found: dict[str, dict[str, list[str]]] = {}
    for column in table.names:
        name, ending = column[:-3], column[-3:]
        if column == _TIME:
            continue
        if ending not in _PARTS or not name:
            known = "time, or a sensor's name and one of " + ", ".join(_PARTS)
            raise FileFormatError(table.path, f"column {column!r}: expected {known}", 1)
        found.setdefault(name, {}).setdefault(_PARTS[ending], []).append(ending[-1])
    for name, kinds in found.items():
        for kind, axes in kinds.items():
            lacking = [f"{name}_{kind}{axis}" for axis in _GROUPS[kind] if axis not in axes]
            if lacking:
                raise FileFormatError(table.path, f"there is no column {', '.join(lacking)}", 1)
    return {name: list(kinds) for name, kinds in found.items()}


def _times(table: SensorTable, rate_hz: float | None) -> Array:
    times = table.column(_TIME)
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
