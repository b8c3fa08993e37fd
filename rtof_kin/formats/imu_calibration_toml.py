"""Calibration of IMUs on their segments as TOML: one table per sensor, in its own file or in a recording's.

    [sensors.L_UpArm]
    joint = "LeftArm"                    # the segment's proximal joint
    lever_arm_m = [0.03, 0.225, 0.012]   # the sensor's position in the bone's frame
    R_world_inertial = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]  # or quat_wxyz_world_inertial
    R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]     # or quat_wxyz_sensor_bone
    mounting_sd_deg = 6.0                # standard deviation of R_sensor_bone about each axis, where known

`joint` and `lever_arm_m` default to those of the skeleton table's sensor of that name. The rotations are
those of `rtof_kin.data.imu`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tomli_w
from pydantic import Field

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.input_table import InputTable, Matrix3, Quaternion, Rule, Vector3, explained_by
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu import ImuCalibration

_QUATERNION_TOLERANCE: Final = 1e-3


def _one_rotation(frames: str) -> tuple[Rule, Rule]:
    """Return the rules that a rotation is given once, as a matrix or as a quaternion."""
    matrix, quat = f"R_{frames}", f"quat_wxyz_{frames}"
    one = f"give one of {matrix} (3 x 3) and {quat} (4 numbers)"
    return (
        Rule(f"stands beside {matrix}; {one}", given=(matrix,), excluded=(quat,)),
        Rule(f"missing; {one}", absent=(matrix, quat), required=(matrix,)),
    )


class SensorTable(InputTable):
    """Calibration of a sensor on its segment."""

    joint: Annotated[str, Field(examples=["LeftArm"])] | None = None
    """Proximal joint of its segment; may be left out for sensors of the skeleton's table."""
    lever_arm_m: Vector3 | None = None
    """Sensor in the bone's frame, m; may be left out as `joint`."""
    R_world_inertial: Matrix3 | None = None
    """Rotation from the sensor's own reference to world."""
    quat_wxyz_world_inertial: Quaternion | None = None
    """The same as a unit quaternion."""
    R_sensor_bone: Matrix3 | None = None
    """Rotation from the bone to the sensor."""
    quat_wxyz_sensor_bone: Quaternion | None = None
    """The same as a unit quaternion."""
    mounting_sd_deg: (
        Annotated[
            float,
            Field(ge=0, le=180),
            explained_by("is no standard deviation of an angle; give degrees, or leave it out"),
        ]
        | None
    ) = None
    """Standard deviation of the rotation from the bone to the sensor about each axis, deg; angles carry it. Left out
    where not known."""
    rules = (*_one_rotation("world_inertial"), *_one_rotation("sensor_bone"))


class CalibrationTable(InputTable):
    """A file of calibrated sensors."""

    sensors: dict[str, SensorTable] = {}
    """One table for each sensor."""


def read_imu_calibration_toml(path: str | Path, skeleton: SkeletonModel) -> ImuCalibration:
    """Read a calibration.

    Args:
        skeleton: its segments carry the sensors; it has the default positions.

    Raises:
        FileFormatError: no such file, no sensor in it, or a missing or invalid field, which is named.
        UnknownNameError: unknown field or segment.
    """
    calibration = calibration_of(CalibrationTable.read(path).sensors, skeleton)
    if calibration is None:
        raise FileFormatError(path, "no table [sensors.NAME] in it; give a calibration of IMUs")
    return calibration


def write_imu_calibration_toml(path: str | Path, calibration: ImuCalibration, overwrite: bool = False) -> None:
    """Write a calibration, which `read_imu_calibration_toml` reads back to the same bits.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    content = {"sensors": calibration_table(calibration)}
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def calibration_of(sensors: Mapping[str, SensorTable], skeleton: SkeletonModel) -> ImuCalibration | None:
    """Return the calibration in the tables of sensors by name; None without any. Raises as
    `read_imu_calibration_toml`.
    """
    joints, levers = [], []
    for name, own in sensors.items():
        usual_joint, usual_lever = skeleton.sensors.get(name, (None, None))
        joint = usual_joint if own.joint is None else own.joint
        if joint is None:
            raise own.error("joint", 'missing; add e.g. joint = "..."')
        if joint not in skeleton.names:
            raise UnknownNameError("joint", [joint], skeleton.names, own.path, own.where("joint"))
        lever = usual_lever if own.lever_arm_m is None and joint == usual_joint else own.lever_arm_m
        if lever is None:
            raise own.error("lever_arm_m", "missing; add 3 numbers")
        joints.append(joint)
        levers.append(lever)
    if not joints:
        return None
    tables = sensors.values()
    stated = [own.mounting_sd_deg for own in tables]
    try:
        return ImuCalibration(
            sensors=tuple(sensors),
            joints=tuple(joints),
            R_world_inertial=np.array([_rotation(own, "world_inertial") for own in tables]),
            R_sensor_bone=np.array([_rotation(own, "sensor_bone") for own in tables]),
            p_bone_sensor=np.array(levers),
            mounting_sd_deg=None if set(stated) == {None} else np.array(stated, dtype=np.float64),
        )
    except (CalibrationError, InvalidInputError) as error:
        raise FileFormatError(next(iter(tables)).path, str(error)) from error


def _rotation(table: SensorTable, frames: str) -> Array:
    """Return a rotation from the matrix ``R_<frames>`` or from ``quat_wxyz_<frames>``."""
    quat: Array | None = getattr(table, f"quat_wxyz_{frames}")
    if quat is None:
        return np.asarray(getattr(table, f"R_{frames}"))
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1) > _QUATERNION_TOLERANCE:
        raise table.error(f"quat_wxyz_{frames}", f"has norm {norm:.6g}, not 1; normalise it")
    return so3.from_quat_wxyz(quat)


def calibration_table(calibration: ImuCalibration) -> dict[str, Any]:
    """Return the tables of the sensors, by name, which `calibration_of` reads back to the same bits."""
    tables: dict[str, Any] = {
        name: {
            "joint": calibration.joints[s],
            "lever_arm_m": calibration.p_bone_sensor[s].tolist(),
            "R_world_inertial": calibration.R_world_inertial[s].tolist(),
            "R_sensor_bone": calibration.R_sensor_bone[s].tolist(),
        }
        for s, name in enumerate(calibration.sensors)
    }
    if calibration.mounting_sd_deg is not None:
        for own, sd in zip(tables.values(), calibration.mounting_sd_deg, strict=True):
            own |= {} if np.isnan(sd) else {"mounting_sd_deg": float(sd)}
    return tables
