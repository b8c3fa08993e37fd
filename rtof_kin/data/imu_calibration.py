"""Alignment of IMUs: from sensor frames to the segments that carry them.

::

    R_world_bone = R_world_inertial . R_inertial_sensor . R_sensor_bone
    a_world      = R_world_inertial . R_inertial_sensor . f_sensor + g,    g = (0, 0, -9.80665)

The paper has R^imu = R_kj^-1 R_kg R_k (eq. 1); the frames close only in the order above, with
R_kg = R_world_inertial, R_k = R_inertial_sensor and R_kj = R_sensor_bone^-1. It subtracts an upward g (eq.
6); here g points down and is added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, freeze, indices_of
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import GRAVITY_WORLD, BoneImuSequence, ImuSequence


@dataclass(frozen=True)
class ImuCalibration:
    """Rotations of each sensor to world and to its segment, and its position in the segment."""

    sensors: tuple[str, ...]
    """S sensor names."""
    joints: tuple[str, ...]
    """S segments that carry them, by their proximal joint."""
    R_world_inertial: Array
    """(S, 3, 3) from each sensor's gravity-aligned reference to world."""
    R_sensor_bone: Array
    """(S, 3, 3) from the segment's link frame to sensor axes."""
    p_bone_sensor: Array
    """(S, 3) lever arm: position of the sensor in the link frame, m."""
    mounting_sd_deg: Array | None = None
    """(S,) standard deviation of R_sensor_bone about each axis, deg; NaN, or None for all: not stated."""

    def __post_init__(self) -> None:
        S = len(self.sensors)
        if len(self.joints) != S:
            raise CalibrationError(f"calibration: {S} sensors but {len(self.joints)} segments")
        try:
            object.__setattr__(self, "sensors", checked_names("calibration: sensor", self.sensors))
            object.__setattr__(self, "joints", checked_names("calibration: segment", self.joints))
        except InvalidInputError as error:
            raise CalibrationError(str(error)) from error
        rotations = ("R_world_inertial", "R_sensor_bone")
        freeze(self, "calibration", **dict.fromkeys(rotations, (S, 3, 3)), p_bone_sensor=(S, 3))
        for field in rotations:
            for name, matrix in zip(self.sensors, getattr(self, field), strict=True):
                if not so3.is_rotation(matrix, tolerance=1e-5):
                    raise CalibrationError(f"calibration of {name}: {field} is not a rotation")
        for name, lever in zip(self.sensors, self.p_bone_sensor, strict=True):
            if not np.linalg.norm(lever) <= 1:
                raise CalibrationError(
                    f"calibration of {name}: its lever arm is not finite or longer than 1 m; give metres"
                )
        if self.mounting_sd_deg is None:
            return
        freeze(self, "calibration", mounting_sd_deg=(S,))
        for name, sd in zip(self.sensors, self.mounting_sd_deg, strict=True):
            if not (0 <= sd <= 180 or np.isnan(sd)):
                raise CalibrationError(
                    f"calibration of {name}: mounting_sd_deg is {sd:g}, no standard deviation of an angle; "
                    "give degrees, or leave it out"
                )

    def select(self, sensors: tuple[str, ...]) -> Self:
        """Return the calibration of sensors in the order given.

        Raises:
            UnknownNameError: a sensor has no calibration.
        """
        index = indices_of("calibrated sensor", sensors, self.sensors)
        return replace(
            self,
            sensors=sensors,
            joints=tuple(self.joints[i] for i in index),
            R_world_inertial=self.R_world_inertial[index],
            R_sensor_bone=self.R_sensor_bone[index],
            p_bone_sensor=self.p_bone_sensor[index],
            mounting_sd_deg=None if self.mounting_sd_deg is None else self.mounting_sd_deg[index],
        )

    def apply(self, imus: ImuSequence) -> BoneImuSequence:
        """Return orientations of the segments and accelerations in world without gravity.

        Raises:
            CalibrationError: a sensor has no calibration.
        """
        missing = [name for name in imus.names if name not in self.sensors]
        if missing:
            raise CalibrationError(
                f"no calibration for the sensors {', '.join(missing)}; there is one for {', '.join(self.sensors)}"
            )
        own = self.select(imus.names)
        R_world_sensor = own.R_world_inertial @ imus.R_inertial_sensor
        a_world = np.einsum("tsij,tsj->tsi", R_world_sensor, imus.f_sensor) + GRAVITY_WORLD
        return BoneImuSequence(
            times=imus.times,
            R_world_bone=R_world_sensor @ own.R_sensor_bone,
            a_world=a_world,
            p_bone_sensor=own.p_bone_sensor,
            joints=own.joints,
        )
