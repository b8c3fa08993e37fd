"""Columns of one sensor that files of Xsens and Movella have in common, whatever their unit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.readings import Readings
from rtof_kin.formats.sensors.sensor_text import SensorTable

Array = NDArray[np.float64]
COUNTER, STAMP = "PacketCounter", "SampleTimeFine"
_ACCELERATION = (("Acc_X", "Acc_Y", "Acc_Z"),)
_FREE = (("FreeAcc_X", "FreeAcc_Y", "FreeAcc_Z"), ("FreeAcc_E", "FreeAcc_N", "FreeAcc_U"))
_GYROSCOPE = (("Gyr_X", "Gyr_Y", "Gyr_Z"),)
_MAGNETOMETER = (("Mag_X", "Mag_Y", "Mag_Z"),)
_QUATERNION = (("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"), ("Quat_W", "Quat_X", "Quat_Y", "Quat_Z"))
_MATRIX = (tuple(f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)),)
_EULER = (("Yaw", "Pitch", "Roll"), ("Euler_Z", "Euler_Y", "Euler_X"))
_KINDS = (_ACCELERATION, _FREE, _GYROSCOPE, _MAGNETOMETER, _QUATERNION, _MATRIX, _EULER)
_MEASURES = [{name.lower() for name in group} for kind in _KINDS for group in kind]
_READ = {COUNTER.lower(), STAMP.lower()}.union(*_MEASURES)


def is_header(names: Iterable[str]) -> bool:
    """Whether these are column names: all of one measurement's are there."""
    low = {name.lower() for name in names}
    return any(group <= low for group in _MEASURES)


def is_read(name: str) -> bool:
    """Whether the column of this name is read."""
    return name.lower() in _READ


def acceleration_declared(tables: Sequence[SensorTable]) -> dict[str, Any]:
    """Fields of `Declaration` that follow from the columns of one trial: Acc is what the accelerometer
    measured; where there is none FreeAcc is read, without gravity and in axes of the local earth frame.

    Raises:
        FileFormatError: only some of the files have Acc.
    """
    lacking = [table.path for table in tables if _first(table, _ACCELERATION) is None]
    if not lacking:
        return {}
    if len(lacking) < len(tables):
        raise FileFormatError(
            lacking[0], "has no Acc_X, Acc_Y, Acc_Z, as other files of the trial have; export all alike"
        )
    return {"gravity": "removed", "acceleration_axes": "inertial"}


def readings(
    name: str, table: SensorTable, rows: NDArray[np.int64], times: Array, notes: Iterable[str]
) -> Readings:
    """One sensor's numbers, of the rows given, at these times.

    Orientation is taken from quaternions, else matrices, else Euler angles in degrees (roll, pitch, yaw
    about x, y, z: R = Rz Ry Rx).
    """

    def taken(kind: Sequence[Sequence[str]]) -> Array | None:
        columns = _first(table, kind)
        return None if columns is None else columns[rows]

    acceleration = taken(_FREE) if taken(_ACCELERATION) is None else taken(_ACCELERATION)
    matrices, euler = taken(_MATRIX), taken(_EULER)
    if matrices is not None:
        matrices = matrices.reshape(-1, 3, 3)
    elif euler is not None:
        matrices = so3.euler_to_matrix("zyx", np.deg2rad(euler))
    return Readings(
        name,
        times,
        acceleration,
        taken(_GYROSCOPE),
        taken(_MAGNETOMETER),
        taken(_QUATERNION),
        matrices,
        tuple(notes),
    )


def _first(table: SensorTable, kind: Sequence[Sequence[str]]) -> Array | None:
    """The first of some groups of columns that the table has; one that is there in part is refused."""
    for group in kind:
        lacking = [name for name in group if table.column(name) is None]
        if not lacking:
            return table.columns(*group)
        if len(lacking) < len(group):
            there = ", ".join(name for name in group if name not in lacking)
            raise FileFormatError(
                table.path, f"has columns {there} and no {', '.join(lacking)}; export all of them, by "
                "these names"
            )  # fmt: skip
    return None
