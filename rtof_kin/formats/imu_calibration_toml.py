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

from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.section import Section
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu import ImuCalibration

_QUATERNION_TOLERANCE: Final = 1e-3


def read_imu_calibration_toml(path: str | Path, skeleton: SkeletonModel) -> ImuCalibration:
    """Read a calibration.

    Args:
        skeleton: its segments carry the sensors; it has the default positions.

    Raises:
        FileFormatError: no such file, no sensor in it, or a missing or invalid field, which is named.
        UnknownNameError: unknown field or segment.
    """
    file = Section.of_file(Path(path))
    calibration = calibration_of(file.table("sensors"), skeleton)
    file.close()
    if calibration is None:
        raise FileFormatError(path, "no table [sensors.NAME] in it; give a calibration of IMUs")
    return calibration


def write_imu_calibration_toml(path: str | Path, calibration: ImuCalibration, overwrite: bool = False) -> None:
    """Write a calibration, which `read_imu_calibration_toml` reads back to the same bits.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    content = {"sensors": calibration_table(calibration)}
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def calibration_of(sensors: Section, skeleton: SkeletonModel) -> ImuCalibration | None:
    """Read the calibration in a table of sensors; None where the table is empty.

    Args:
        skeleton: as for `read_imu_calibration_toml`, whose errors are raised.
    """
    if len(sensors) == 0:
        return None
    joints, levers, R_world_inertial, R_sensor_bone, stated = [], [], [], [], []
    for name in sensors.keys():  # noqa: SIM118 - a Section is no mapping
        own = sensors.table(name)
        usual_joint, usual_lever = skeleton.sensors.get(name, (None, None))
        joint = own.text("joint", usual_joint)
        if joint not in skeleton.names:
            raise UnknownNameError(f"joint in {own.path}, {own.where('joint')}", [joint], skeleton.names)
        usual = usual_lever is not None and joint == usual_joint and not own.has("lever_arm_m")
        joints.append(joint)
        levers.append(usual_lever if usual else own.array("lever_arm_m", (3,)))
        R_world_inertial.append(_rotation(own, "world_inertial"))
        R_sensor_bone.append(_rotation(own, "sensor_bone"))
        stated.append(own.optional_number("mounting_sd_deg"))
        own.close()
    try:
        return ImuCalibration(
            sensors=tuple(sensors.keys()),
            joints=tuple(joints),
            R_world_inertial=np.array(R_world_inertial),
            R_sensor_bone=np.array(R_sensor_bone),
            p_bone_sensor=np.array(levers),
            mounting_sd_deg=None if set(stated) == {None} else np.array(stated, dtype=np.float64),
        )
    except (CalibrationError, InvalidInputError) as error:
        raise FileFormatError(sensors.path, str(error)) from error


def _rotation(section: Section, frames: str) -> Array:
    """Return a rotation from the matrix ``R_<frames>`` or from ``quat_wxyz_<frames>``."""
    matrix, quat = f"R_{frames}", f"quat_wxyz_{frames}"
    if section.has(matrix) == section.has(quat):
        raise section.error(matrix, f"give one of {matrix} (3 x 3) and {quat} (4 numbers)")
    if section.has(matrix):
        return section.array(matrix, (3, 3))
    value = section.array(quat, (4,))
    norm = float(np.linalg.norm(value))
    if abs(norm - 1) > _QUATERNION_TOLERANCE:
        raise section.error(quat, f"has norm {norm:.6g}, not 1; normalise it")
    return so3.from_quat_wxyz(value)


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
