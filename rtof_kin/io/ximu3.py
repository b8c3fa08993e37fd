"""Folders of x-io Technologies' x-IMU3: a folder for each sensor, a CSV for each kind of message.

Read are ``Inertial.csv`` (gyroscope deg/s, accelerometer g, gravity included, sensor axes),
``Quaternion.csv`` (W, X, Y, Z from the sensor to the earth, z up in its usual NWU) and
``Magnetometer.csv``, each with time stamps of its own in us. ``Command.json`` names the sensor, else the
folder does. Orientation and magnetic field are interpolated to the inertial samples where their stamps
differ. Sensors' clocks are the device's own synchronised ones.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin import signals
from rtof_kin.errors import FileFormatError
from rtof_kin.inertial.declaration import Declaration
from rtof_kin.inertial.packets import in_order, lost
from rtof_kin.inertial.readings import Readings, sensor_log
from rtof_kin.inertial.streams import SensorLog
from rtof_kin.io.sensor_text import cells, read_table

Array = NDArray[np.float64]
TITLE = "x-IMU3 folders"
_STAMP = "Timestamp (us)"
_GYROSCOPE = tuple(f"Gyroscope {axis} (deg/s)" for axis in "XYZ")
_ACCELEROMETER = tuple(f"Accelerometer {axis} (g)" for axis in "XYZ")
_QUATERNION = ("W", "X", "Y", "Z")
_MAGNETOMETER = tuple(f"{axis} (a.u.)" for axis in "XYZ")
_WHOLE = 2**53
_LATEST_US = 2_000_000
_QUATERNION_GAP, _MAGNETOMETER_GAP = 0.1, 0.5
"""Seconds across which nothing is interpolated."""
_LARGEST_JSON = 2**20


def is_ximu3(head: str) -> bool:
    """Whether a file that begins so is one of such a folder."""
    return cells(head.split("\n", 1)[0])[0] == _STAMP


def read_ximu3(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """The sensors of one trial.

    Args:
        paths: the CSV files of all sensors, those of a sensor in one folder.
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` puts samples
            at equal steps after the first stamp.

    Raises:
        FileFormatError: a folder without Inertial.csv, a damaged file, time stamps that started anew.
    """
    own = Declaration(acceleration_unit="g", angular_unit="deg/s")
    declaration = own.changed(**declared)
    folders = list(dict.fromkeys(path.parent for path in paths))
    labels = [_label(folder) for folder in folders]
    sensors = []
    for folder, (name, serial) in zip(folders, labels, strict=True):
        twice = [label for label, _ in labels].count(name) > 1
        full = f"{name} {serial}" if twice else name
        sensors.append(_sensor(folder, full, declaration.rate_hz))
    return sensor_log(paths if len(paths) == 1 else folders, TITLE, sensors, declaration)


def _label(folder: Path) -> tuple[str, str]:
    """Name and serial number of a sensor, by its Command.json, else by its folder's name."""
    try:
        with (folder / "Command.json").open("rb") as stream:
            commands = json.loads(stream.read(_LARGEST_JSON))
        ping = next(command["ping"] for command in commands if "ping" in command)
        name, serial = ping["name"], ping["sn"]
        if isinstance(name, str) and isinstance(serial, str) and name.strip():
            return name.strip(), serial
    except (OSError, ValueError, TypeError, KeyError, StopIteration, RecursionError):
        pass  # not there, or not as devices write it: the folder's name says the same
    found = re.fullmatch(r"(.+?) ([0-9A-Fa-f]{8})( \(.*\))?", folder.name)
    return (found[1], found[2]) if found else (folder.name, "")


def _sensor(folder: Path, name: str, rate_hz: float | None) -> Readings:
    inertial = _messages(folder / "Inertial.csv", (*_GYROSCOPE, *_ACCELEROMETER))
    if inertial is None:
        raise FileFormatError(folder, "has no Inertial.csv; log inertial messages")
    stamps, values, notes = inertial
    quaternion, magnetometer = (
        _at(stamps, _messages(folder / f"{kind}.csv", columns), max_gap)
        for kind, columns, max_gap in (
            ("Quaternion", _QUATERNION, _QUATERNION_GAP),
            ("Magnetometer", _MAGNETOMETER, _MAGNETOMETER_GAP),
        )
    )
    times = stamps / 1e6
    if rate_hz is not None:
        times = times[0] + np.arange(len(times)) / rate_hz
    elif len(times) > 1:
        notes += lost(times, float(1 / np.median(np.diff(times))))
    f, w = values[:, 3:], values[:, :3]
    return Readings(name, times, f, w, magnetometer, quaternion, notes=tuple(notes))


def _messages(path: Path, columns: Sequence[str]) -> tuple[Array, Array, list[str]] | None:
    """Stamps (T,) us, numbers (T, C) and notes of one file, in order; None where there is none."""
    if not path.exists():
        return None
    wanted = {_STAMP, *columns}
    table = read_table(path, lambda names: _STAMP in names, lambda name: name in wanted)
    stamps, values = table.column(_STAMP), table.columns(*columns)
    if stamps is None or values is None:
        raise FileFormatError(path, f"has no columns {', '.join(columns)}", 1)
    packets = in_order(path, stamps, table.lines, _WHOLE, _LATEST_US, _STAMP)
    return packets.count.astype(float), values[packets.rows], [*table.notes, *packets.notes]


def _at(stamps: Array, messages: tuple[Array, Array, list[str]] | None, gap: float) -> Array | None:
    """Numbers of another kind of message at the inertial stamps, us."""
    if messages is None:
        return None
    own, values, _ = messages
    if np.array_equal(own, stamps):
        return values
    if values.shape[1] == 4:  # a quaternion and its opposite are the same rotation
        turned = np.sum(values[1:] * values[:-1], axis=1) < 0
        values = values * np.cumprod(np.where([False, *turned], -1.0, 1.0))[:, None]
    return signals.interpolate(own, values, stamps, gap * 1e6)
