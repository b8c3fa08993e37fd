"""OpenSense orientation tables (.sto) of OpenSim: orientation alone, all sensors at the same times.

Header lines to ``endheader``, among them ``DataType=Quaternion``; then tab-separated columns ``time``
and ``<body>_imu``, with cells ``w,x,y,z``: from the sensor to a reference with z up, or with y up where
OpenSim's rotation was already applied; then declare ``inertial_axes="y up"``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import MOST_HEADER_LINES, text_lines

TITLE: Final = "OpenSense .sto"
_SUFFIX: Final = "_imu"
_END: Final = "endheader"


def is_opensense_sto(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    lines = [line.strip().lower().replace(" ", "") for line in head.splitlines()]
    return "datatype=quaternion" in lines and _END in lines


def read_opensense_sto(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    declaration = Declaration().changed(**declared)
    rows = text_lines(path)
    for number, line in rows:
        if line.strip().lower() == _END:
            break
        if number >= MOST_HEADER_LINES:
            raise FileFormatError(path, f"no {_END} in the first {number} lines", number)
    number, line = next(rows, (1, ""))
    names = line.rstrip().split("\t")
    if names[0] != "time" or len(names) < 2:
        raise FileFormatError(path, f"expected time and sensors' names after {_END}", number)
    table = [_row(path, n, line.rstrip().split("\t"), len(names)) for n, line in rows if line.strip()]
    if not table:
        raise FileFormatError(path, "holds names and no row", number)
    times = np.array([time for time, _ in table])
    quaternions = np.array([row for _, row in table]).transpose(1, 0, 2)
    if declaration.rate_hz is not None:
        times = np.arange(len(times)) / declaration.rate_hz
    sensors = [
        Readings(name.removesuffix(_SUFFIX), times, quaternions=quat)
        for name, quat in zip(names[1:], quaternions, strict=True)
    ]
    return sensor_log([path], TITLE, sensors, declaration, lost(times))


def _row(path: Path, line: int, cells: list[str], columns: int) -> tuple[float, list[list[float]]]:
    if len(cells) != columns:
        raise FileFormatError(path, f"{len(cells)} cells under {columns} column names", line)
    try:
        time, quaternions = float(cells[0]), [list(map(float, c.split(","))) for c in cells[1:]]
    except ValueError as error:
        raise FileFormatError(path, f"holds something else than numbers ({error})", line) from error
    if any(len(quat) != 4 for quat in quaternions):
        raise FileFormatError(path, "a cell has not four numbers w,x,y,z", line)
    return time, quaternions


def write_opensense_sto(path: str | Path, log: SensorLog) -> None:
    """Write orientations R_inertial_sensor, z up, for OpenSim's OpenSense.

    Args:
        log: its sensors should have the names of their bodies (`SensorLog.renamed`).

    Raises:
        InvalidInputError: a sensor lacks orientation or was sampled at other times.
    """
    times = log.streams[0].times
    columns = []
    for stream in log.streams:
        R = stream.R_inertial_sensor
        if R is None or np.isnan(R).any():
            raise InvalidInputError(f"sensor {stream.name} has no orientation in every sample; cut or fill it")
        if not np.array_equal(stream.times, times):
            problem = f"sensors {log.names[0]} and {stream.name} were sampled at different times"
            raise InvalidInputError(f"{problem}; resample one of them")
        columns.append([",".join(map(repr, quat)) for quat in so3.to_quat_wxyz(R).tolist()])
    rate = log.streams[0].rate_hz if len(times) > 1 else 1.0
    header = [f"DataRate={rate:.6f}", "DataType=Quaternion", "version=3", _END]
    names = "\t".join(["time", *(name + _SUFFIX for name in log.names)])
    rows = ["\t".join(cells) for cells in zip(map(repr, times.tolist()), *columns, strict=True)]
    write_text(Path(path), "\n".join([*header, names, *rows, ""]), overwrite=True)
