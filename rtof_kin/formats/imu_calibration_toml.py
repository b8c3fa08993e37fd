"""How IMUs sit on their segments, as TOML: one table a sensor, in a file of its own or in a recording's.

    [sensors.L_UpArm]
    joint = "LeftArm"                    # the segment's proximal joint; the usual one where absent
    lever_arm_m = [0.03, 0.225, 0.012]   # the sensor in the bone's frame; the usual place where absent
    R_world_inertial = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]  # or quat_wxyz_world_inertial
    R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]     # or quat_wxyz_sensor_bone

Usual are the segments and places of the skeleton table's sensors. `rtof_kin.data.imu_calibration` says what the
rotations mean.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.section import Section
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu_calibration import ImuCalibration

Array = NDArray[np.float64]
_QUATERNION_TOLERANCE = 1e-3


def read_imu_calibration_toml(path: str | Path, skeleton: SkeletonModel) -> ImuCalibration:
    """A calibration from a file.

    Args:
        path: the file.
        skeleton: whose segments carry the sensors, and where they usually sit.

    Raises:
        FileFormatError: no such file, no sensor in it, or a field is missing or wrong, which is named.
        UnknownNameError: a field or segment that does not exist.
    """
    file = Section.of_file(Path(path))
    calibration = calibration_of(file.table("sensors"), skeleton)
    file.close()
    if calibration is None:
        raise FileFormatError(path, "no table [sensors.NAME] in it; give a calibration of IMUs")
    return calibration


def write_imu_calibration_toml(
    path: str | Path, calibration: ImuCalibration, overwrite: bool = False
) -> None:
    """Write what `read_imu_calibration_toml` reads back to the same bits.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for.
        RtofError: it cannot be written.
    """
    content = {"sensors": calibration_table(calibration)}
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def calibration_of(sensors: Section, skeleton: SkeletonModel) -> ImuCalibration | None:
    """The calibration in a table of sensors, here or in a recording; None where the table is empty."""
    if len(sensors) == 0:
        return None
    joints, levers, R_world_inertial, R_sensor_bone = [], [], [], []
    for name in sensors.keys():  # noqa: SIM118 - a Section is no mapping
        own = sensors.table(name)
        usual_joint, usual_lever = skeleton.sensors.get(name, (None, None))
        joint = own.text("joint", usual_joint)
        if joint not in skeleton.names:
            raise UnknownNameError(f"joint in {own.path}, {own.where('joint')}", [joint], skeleton.names)
        lever = own.optional_array("lever_arm_m", (3,))
        if lever is None and usual_lever is not None and joint == usual_joint:
            lever = usual_lever
        joints.append(joint)
        levers.append(own.array("lever_arm_m", (3,)) if lever is None else lever)
        R_world_inertial.append(_rotation(own, "world_inertial"))
        R_sensor_bone.append(_rotation(own, "sensor_bone"))
        own.close()
    try:
        return ImuCalibration(
            sensors=tuple(sensors.keys()),
            joints=tuple(joints),
            R_world_inertial=np.array(R_world_inertial),
            R_sensor_bone=np.array(R_sensor_bone),
            p_bone_sensor=np.array(levers),
        )
    except (CalibrationError, InvalidInputError) as error:
        raise FileFormatError(sensors.path, str(error)) from error


def _rotation(section: Section, frames: str) -> Array:
    """A rotation given as the matrix ``R_<frames>`` or as ``quat_wxyz_<frames>``."""
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
    """The tables of the sensors, by name, that `calibration_of` reads back to the same bits."""
    return {
        name: {
            "joint": calibration.joints[s],
            "lever_arm_m": calibration.p_bone_sensor[s].tolist(),
            "R_world_inertial": calibration.R_world_inertial[s].tolist(),
            "R_sensor_bone": calibration.R_sensor_bone[s].tolist(),
        }
        for s, name in enumerate(calibration.sensors)
    }
