"""CSV files of Movella (Xsens) DOT, from its app or its exporter: one sensor a file.

Some lines about the device (``DeviceTag``, ``OutputRate``), then columns of which these are read:
PacketCounter; SampleTimeFine (us, wraps at 2^32); Acc (m/s^2, gravity included, sensor axes) or else
FreeAcc (gravity removed, axes of the local earth frame); Gyr (deg/s); Mag; orientation from the sensor to
the local earth frame as Quat_W ... Z, else Euler_X, _Y, _Z. Times are SampleTimeFine, which synchronised
sensors share; where a rate is declared, it and PacketCounter give the times after the first stamp.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.packets import WRAP_32, Packets, aligned, in_order, lost
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

Array = NDArray[np.float64]
TITLE = "Movella DOT CSV"
_RATE = re.compile(r"OutputRate:\W*([\d.]+)\s*Hz", re.IGNORECASE)
_NAMED = re.compile(r"(.+?)_\d{8}_\d{6}(_\d+)?")
_ITS_OWN = {"Quat_W", "Euler_X"}
_LATEST_PACKETS, _LATEST_US = 100, 1_000_000


def is_xsens_dot(head: str) -> bool:
    """Whether a file that begins so is such a file."""
    lines = head.splitlines()
    names = next((row for row in map(cells, lines) if STAMP in row), [])
    tagged = any(line.startswith("DeviceTag") for line in lines)
    return is_header(names) and (tagged or bool(_ITS_OWN & set(names)))


def read_xsens_dot(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """The sensors of one trial.

    Args:
        paths: a file for each sensor, named ``NAME_date_time.csv`` as the app names them.
        declared: fields of `Declaration` to set otherwise than the format does.

    Raises:
        FileFormatError: not such a file, time stamps that started anew, files of other columns than the
            first one.
    """
    tables = [read_table(path, is_header, is_read) for path in paths]
    own = Declaration(angular_unit="deg/s", **acceleration_declared(tables))
    declaration = own.changed(**declared)
    stamps = [_in_order(table, STAMP, _LATEST_US) for table in tables]
    shifts = aligned([int(one.count[0]) for one in stamps], WRAP_32)
    sensors = []
    for table, by_stamp, shift in zip(tables, stamps, shifts, strict=True):
        one, times = by_stamp, (by_stamp.count + shift) / 1e6
        if declaration.rate_hz is not None:
            one = _in_order(table, COUNTER, _LATEST_PACKETS)
            times = times[0] + (one.count - one.count[0]) / declaration.rate_hz
        lost_ones = lost(times, declaration.rate_hz or _rate(table))
        notes = (*table.notes, *one.notes, *lost_ones)
        sensors.append(readings(_name(table.path), table, one.rows, times, notes))
    return sensor_log(paths, TITLE, sensors, declaration)


def _in_order(table: SensorTable, column: str, late: int) -> Packets:
    counters = table.column(column)
    if counters is None:
        raise FileFormatError(table.path, f"has no column {column}; export it too")
    return in_order(table.path, counters, table.lines, WRAP_32, late, column)


def _name(path: Path) -> str:
    """What stands before date and time in a file's name; else the whole of it."""
    found = _NAMED.fullmatch(path.stem)
    return found[1] if found else path.stem


def _rate(table: SensorTable) -> float | None:
    """The rate in the header, for counting what was lost; None where there is none."""
    found = [match for line in table.header if (match := _RATE.match(line.strip()))]
    try:
        return Declaration(rate_hz=float(found[0][1])).rate_hz if found else None
    except ValueError:
        return None
