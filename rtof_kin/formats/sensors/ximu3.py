"""Folders of x-io Technologies' x-IMU3: a folder per sensor, a CSV per kind of message.

Read are ``Inertial.csv`` (gyroscope deg/s, accelerometer g, gravity included, sensor axes), ``Quaternion.csv`` (W, X,
Y, Z from the sensor to the earth, z up in its usual NWU) and ``Magnetometer.csv``, each with its own time stamps in
us. ``Command.json`` names the sensor, else the folder does. Orientation and magnetic field are interpolated to the
inertial samples where their stamps differ. Clocks are those of the devices, which the maker's software synchronises.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.packets import in_order, lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import cells, read_table
from rtof_kin.formats.sensors.start_times import unzoned_note

TITLE: Final = "x-IMU3 folders"
_STAMP: Final = "Timestamp (us)"
_GYROSCOPE: Final = tuple(f"Gyroscope {axis} (deg/s)" for axis in "XYZ")
_ACCELEROMETER: Final = tuple(f"Accelerometer {axis} (g)" for axis in "XYZ")
_OTHERS: Final = {
    "Quaternion": (("W", "X", "Y", "Z"), 0.1),
    "Magnetometer": (("X (a.u.)", "Y (a.u.)", "Z (a.u.)"), 0.5),
}
"""Columns of other messages, and the longest gap, s, that is interpolated."""
_WHOLE: Final = 2**53
_LATEST_US: Final = 1_000_000
_LARGEST_JSON: Final = 2**20


def is_ximu3(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return cells(head.split("\n", 1)[0])[0] == _STAMP


def read_ximu3(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` gives equal steps after the first stamp."""
    declaration = Declaration(acceleration_unit="g", angular_unit="deg/s").changed(**declared)
    folders = list(dict.fromkeys(path.parent for path in paths))
    labels = [_label(folder) for folder in folders]
    names = [name for name, _ in labels]
    sensors = [
        _sensor(folder, f"{name} {serial}" if names.count(name) > 1 else name, declaration.rate_hz)
        for folder, (name, serial) in zip(folders, labels, strict=True)
    ]
    notes = unzoned_note(_command(folders[0], "time"))
    return sensor_log(paths if len(paths) == 1 else folders, TITLE, sensors, declaration, notes)


def _label(folder: Path) -> tuple[str, str]:
    """Return a sensor's name and serial number, from Command.json, else from the folder's name."""
    ping = _command(folder, "ping")
    name, serial = (ping.get("name"), ping.get("sn")) if isinstance(ping, dict) else (None, None)
    if isinstance(name, str) and isinstance(serial, str) and name.strip():
        return name.strip(), serial
    found = re.fullmatch(r"(.+?) ([0-9A-Fa-f]{8})( \(.*\))?", folder.name)
    return (found[1], found[2]) if found else (folder.name, "")


def _command(folder: Path, name: str) -> Any:
    """Return the value of a command in Command.json; None where absent, or not as devices write it."""
    try:
        with (folder / "Command.json").open("rb") as stream:
            commands = json.loads(stream.read(_LARGEST_JSON))
        return next(command[name] for command in commands if name in command)
    except (OSError, ValueError, TypeError, KeyError, StopIteration, RecursionError):
        return None


def _sensor(folder: Path, name: str, rate_hz: float | None) -> Readings:
    inertial = _messages(folder / "Inertial.csv", (*_GYROSCOPE, *_ACCELEROMETER))
    if inertial is None:
        raise FileFormatError(folder, "has no Inertial.csv; log inertial messages")
    stamps, values, notes = inertial
    others: dict[str, Array | None] = dict.fromkeys(_OTHERS)
    for kind, (columns, max_gap) in _OTHERS.items():
        found = _messages(folder / f"{kind}.csv", columns)
        if found is not None:
            own, others[kind], remarks = found
            if not np.array_equal(own, stamps):
                remarks.append(f"{len(own)} messages interpolated to the inertial samples")
                others[kind] = _interpolated(own, found[1], stamps, max_gap * 1e6)
            notes += [f"{kind}: {note}" for note in remarks]
    times = stamps / 1e6
    if rate_hz is not None:
        times = times[0] + np.arange(len(times)) / rate_hz
    else:
        notes += lost(times)
    f, w = values[:, 3:], values[:, :3]
    return Readings(name, times, f, w, others["Magnetometer"], others["Quaternion"], notes=tuple(notes))


def _messages(path: Path, columns: Sequence[str]) -> tuple[Array, Array, list[str]] | None:
    """Return stamps (T,) us, numbers (T, C) and notes of one file, in order; None without the file."""
    if not path.exists():
        return None
    wanted = {_STAMP, *columns}
    table = read_table(path, lambda names: _STAMP in names, lambda name: name in wanted)
    stamps, values = table.column(_STAMP), table.columns(*columns)
    if stamps is None or values is None:
        raise FileFormatError(path, f"has no columns {', '.join(columns)}", 1)
    packets = in_order(path, stamps, table.lines, _WHOLE, _LATEST_US, _STAMP)
    return packets.count.astype(float), values[packets.rows], [*table.notes, *packets.notes]


def _interpolated(stamps: Array, values: Array, at: Array, max_gap: float) -> Array:
    """Interpolate vectors (T, 3), or quaternions (T, 4) whose signs may jump."""
    if values.shape[1] == 4:  # a quaternion and its opposite are the same rotation
        turned = np.sum(values[1:] * values[:-1], axis=1) < 0
        values = values * np.cumprod(np.where([False, *turned], -1.0, 1.0))[:, None]
    return signals.interpolate(stamps, values, at, max_gap)
