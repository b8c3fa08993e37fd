"""Declaration of the units and conventions of a file of inertial data; nothing is guessed.

A format has a declaration, which the user may change. `rtof_kin.inertial.physics` checks it against the data.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final, Literal, Self, get_args

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY

AccelerationUnit = Literal["m/s2", "g", "mg"]
Gravity = Literal["included", "removed"]
AccelerationAxes = Literal["sensor", "inertial"]
AngularUnit = Literal["rad/s", "deg/s"]
QuaternionOrder = Literal["wxyz", "xyzw"]
OrientationMaps = Literal["sensor to inertial", "inertial to sensor"]
InertialAxes = Literal["z up", "z down", "y up"]
CHOICES: Final[dict[str, tuple[str, ...]]] = {
    "acceleration_unit": get_args(AccelerationUnit),
    "gravity": get_args(Gravity),
    "acceleration_axes": get_args(AccelerationAxes),
    "angular_unit": get_args(AngularUnit),
    "quaternion_order": get_args(QuaternionOrder),
    "orientation_maps": get_args(OrientationMaps),
    "inertial_axes": get_args(InertialAxes),
}
"""Values of each field of `Declaration` except the rate."""
_METRES = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}
_UPRIGHT: dict[str, Array] = {
    "z up": np.eye(3),
    "z down": np.diag([1.0, -1.0, -1.0]),
    "y up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations from the reference axes to axes with z up."""


@dataclass(frozen=True)
class Declaration:
    """Units and conventions of a file. The defaults are those of this package."""

    acceleration_unit: AccelerationUnit = "m/s2"
    gravity: Gravity = "included"
    """'included': 9.81 upwards at rest. 'removed': 0 at rest."""
    acceleration_axes: AccelerationAxes = "sensor"
    """Axes of accelerations; 'inertial': those of the sensor's own reference."""
    angular_unit: AngularUnit = "rad/s"
    quaternion_order: QuaternionOrder = "wxyz"
    orientation_maps: OrientationMaps = "sensor to inertial"
    """Direction of the orientation; 'sensor to inertial' is R_inertial_sensor."""
    inertial_axes: InertialAxes = "z up"
    """'z up': ENU, NWU. 'z down': NED. 'y up': as in computer graphics."""
    rate_hz: float | None = None
    """Sampling rate, Hz; None: from time stamps or the header."""

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise UnknownNameError(name.replace("_", " "), [str(getattr(self, name))], choices)
        if self.rate_hz is not None and not 0 < self.rate_hz < 1e5:
            raise InvalidInputError(f"rate_hz is {self.rate_hz:g}; give a positive number of samples per second")

    def changed(self, **values: Any) -> Self:
        """Return the declaration with other values of some fields.

        Args:
            values: by field; None leaves it unchanged.

        Raises:
            UnknownNameError: an unknown field or value.
        """
        known = [f.name for f in fields(self)]
        unknown = [name for name in values if name not in known]
        if unknown:
            raise UnknownNameError("field of a declaration", unknown, known)
        return replace(self, **{k: v for k, v in values.items() if v is not None})

    def rotations(self, quaternions: Array) -> Array:
        """Return R_inertial_sensor (T, 3, 3), reference with z up; NaN where not finite or zero.

        Args:
            quaternions: (T, 4) of the file, of any norm.
        """
        order = [0, 1, 2, 3] if self.quaternion_order == "wxyz" else [3, 0, 1, 2]
        quat_wxyz = np.asarray(quaternions, dtype=np.float64)[..., order]
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(quat_wxyz, axis=-1)
        known = np.isfinite(norm) & (norm > 0)
        R = np.full((*norm.shape, 3, 3), np.nan)
        R[known] = so3.from_quat_wxyz(quat_wxyz[known])
        return self.upright(R)

    def upright(self, R: Array) -> Array:
        """Return R_inertial_sensor (..., 3, 3), reference with z up.

        Args:
            R: (..., 3, 3) rotation matrices of the file.
        """
        if self.orientation_maps == "inertial to sensor":
            R = np.swapaxes(R, -1, -2)
        return _UPRIGHT[self.inertial_axes] @ R

    def specific_force(self, acceleration: Array, R_inertial_sensor: Array | None = None) -> Array:
        """Return f_sensor (T, 3), m/s^2.

        Args:
            acceleration: (T, 3) of the file.
            R_inertial_sensor: (T, 3, 3) from `rotations`; required if gravity was removed or axes are inertial.

        Raises:
            InvalidInputError: it is required and not given.
        """
        a = np.asarray(acceleration, dtype=np.float64) * _METRES[self.acceleration_unit]
        if self.gravity == "included" and self.acceleration_axes == "sensor":
            return a
        if R_inertial_sensor is None:
            raise InvalidInputError(
                f"accelerations with gravity {self.gravity}, in {self.acceleration_axes} axes, are of no "
                "use without an orientation; log the raw accelerometer, or orientation beside it"
            )
        if self.acceleration_axes == "inertial":
            in_world: Array = a @ _UPRIGHT[self.inertial_axes].T
        else:
            in_world = np.einsum("tij,tj->ti", R_inertial_sensor, a)
        if self.gravity == "removed":
            in_world = in_world - GRAVITY_WORLD
        f: Array = np.einsum("tji,tj->ti", R_inertial_sensor, in_world)
        return f

    def angular_velocity(self, rate: Array) -> Array:
        """Return w_sensor (T, 3), rad/s.

        Args:
            rate: (T, 3) of the file.
        """
        factor = np.pi / 180 if self.angular_unit == "deg/s" else 1.0
        return np.asarray(rate, dtype=np.float64) * factor

    # --- inverse: numbers of the file ------------------------------------------------------------

    def filed_rotations(self, R_inertial_sensor: Array) -> Array:
        """Invert `upright`: return the rotation matrices (..., 3, 3) of the file.

        Args:
            R_inertial_sensor: (..., 3, 3).
        """
        R: Array = _UPRIGHT[self.inertial_axes].T @ R_inertial_sensor
        return np.swapaxes(R, -1, -2) if self.orientation_maps == "inertial to sensor" else R

    def filed_quaternions(self, R_inertial_sensor: Array) -> Array:
        """Invert `rotations`: return the unit quaternions (T, 4) of the file, up to sign.

        Args:
            R_inertial_sensor: (T, 3, 3).
        """
        quat = so3.known_to_quat_wxyz(self.filed_rotations(R_inertial_sensor))
        return quat if self.quaternion_order == "wxyz" else quat[..., [1, 2, 3, 0]]

    def filed_acceleration(self, f_sensor: Array, R_inertial_sensor: Array | None = None) -> Array:
        """Invert `specific_force`: return the accelerations (T, 3) of the file.

        Args:
            f_sensor: (T, 3) m/s^2. R_inertial_sensor: (T, 3, 3), see `specific_force`.
        """
        if self.gravity == "included" and self.acceleration_axes == "sensor":
            return f_sensor / _METRES[self.acceleration_unit]
        if R_inertial_sensor is None:
            raise InvalidInputError("accelerations of these axes were made with an orientation; give it")
        a: Array = np.einsum("tij,tj->ti", R_inertial_sensor, f_sensor)
        if self.gravity == "removed":
            a = a + GRAVITY_WORLD
        if self.acceleration_axes == "inertial":
            a = a @ _UPRIGHT[self.inertial_axes]
        else:
            a = np.einsum("tji,tj->ti", R_inertial_sensor, a)
        return a / _METRES[self.acceleration_unit]

    def filed_angular_velocity(self, w_sensor: Array) -> Array:
        """Invert `angular_velocity`: return the angular velocities (T, 3) of the file.

        Args:
            w_sensor: (T, 3) rad/s.
        """
        return w_sensor / self.angular_velocity(np.ones(1))
