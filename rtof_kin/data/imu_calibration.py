"""IMU frame alignment: from a sensor's own frames to the segment that carries it.

::

    R_world_bone = R_world_inertial . R_inertial_sensor . R_sensor_bone
    a_world      = R_world_inertial . R_inertial_sensor . f_sensor + g,    g = (0, 0, -9.81)

The paper prints R^imu = R_kj^-1 R_kg R_k (eq. 1); the frames only close in the order above, with
R_kg = R_world_inertial, R_k = R_inertial_sensor and R_kj = R_sensor_bone^-1. It subtracts a g that
points up (eq. 6); here gravity points down and is added once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu import GRAVITY_WORLD, BoneImuSequence, ImuSequence

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImuCalibration:
    """How each sensor's frames relate to the world and to its segment. Only applies itself."""

    sensors: tuple[str, ...]
    """S sensor names."""
    joints: tuple[str, ...]
    """S names of the segments (by their proximal joint) that carry them."""
    R_world_inertial: Array
    """(S, 3, 3) from each sensor's gravity-aligned reference to world."""
    R_sensor_bone: Array
    """(S, 3, 3) from the segment's link frame to sensor axes."""
    p_bone_sensor: Array
    """(S, 3) lever arm: position of the sensor in the link frame, m."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "sensors", tuple(self.sensors))
        set_(self, "joints", tuple(self.joints))
        S = len(self.sensors)
        if len(self.joints) != S:
            raise CalibrationError(f"calibration: {S} sensors but {len(self.joints)} segments")
        for kind, names in (("sensor", self.sensors), ("segment", self.joints)):
            double = {name for name in names if names.count(name) > 1}
            if double:
                raise CalibrationError(
                    f"calibration: {kind} {', '.join(sorted(double))} stands there more than once"
                )
        set_(self, "p_bone_sensor", readonly("calibration p_bone_sensor", self.p_bone_sensor, (S, 3)))
        for field in ("R_world_inertial", "R_sensor_bone"):
            R = readonly(f"calibration {field}", getattr(self, field), (S, 3, 3))
            for name, matrix in zip(self.sensors, R, strict=True):
                if not so3.is_rotation(matrix, tolerance=1e-5):
                    raise CalibrationError(f"calibration of {name}: {field} is not a rotation")
            set_(self, field, R)
        for name, lever in zip(self.sensors, self.p_bone_sensor, strict=True):
            if not np.linalg.norm(lever) <= 1:
                raise CalibrationError(
                    f"calibration of {name}: its lever arm is not finite or longer than 1 m; give metres"
                )

    def select(self, sensors: tuple[str, ...]) -> Self:
        """The calibration of the sensors named, in that order."""
        index = indices_of("calibrated sensor", sensors, self.sensors)
        return replace(
            self,
            sensors=sensors,
            joints=tuple(self.joints[i] for i in index),
            R_world_inertial=self.R_world_inertial[index],
            R_sensor_bone=self.R_sensor_bone[index],
            p_bone_sensor=self.p_bone_sensor[index],
        )

    def apply(self, imus: ImuSequence) -> BoneImuSequence:
        """Sensor data as orientation of the segments and acceleration in world less gravity.

        Args:
            imus: S' sensors, each of which must be calibrated; their order is kept.

        Returns:
            At the sensors' own times; `BoneImuSequence.resample` brings them to the video's.

        Raises:
            CalibrationError: a sensor has no calibration.
        """
        missing = [name for name in imus.names if name not in self.sensors]
        if missing:
            raise CalibrationError(
                f"no calibration for the sensors {', '.join(missing)}; there is one for "
                f"{', '.join(self.sensors)}"
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
