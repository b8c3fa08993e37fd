"""Sensors of Total Capture (``*_Xsens.sensors``) as a log, without the calibration of another file.

60 Hz; quaternions w x y z from the sensor to its inertial frame, z up; acceleration in m/s^2 with gravity,
sensor axes. `rtof_kin.datasets.total_capture` reads whole takes with their calibration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.total_capture import read_sensors

TITLE: Final = "Total Capture .sensors"
_RATE_HZ: Final = 60.0


def is_total_capture(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    rows = [line.split() for line in head.splitlines()[:3]]
    counts = [len(row) for row in rows]
    return len(rows) == 3 and counts[:2] == [2, 1] and counts[2] >= 8 and rows[1][0] == "1"


def read_total_capture_sensors(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`."""
    declaration = Declaration(rate_hz=_RATE_HZ).changed(**declared)
    table = read_sensors(path)
    times = np.arange(len(table.f_sensor)) / (declaration.rate_hz or _RATE_HZ)
    sensors = [
        Readings(name, times, table.f_sensor[:, s], quaternions=table.quat_wxyz[:, s])
        for s, name in enumerate(table.names)
    ]
    return sensor_log([path], TITLE, sensors, declaration)
