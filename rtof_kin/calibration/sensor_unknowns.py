"""Unknown errors of the sensors; see `unknowns`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.calibration.residuals import CalibrationObservations, CalibrationResiduals, Changes
from rtof_kin.calibration.unknowns import Isotropic, Unknown, each, powers_of_time
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

Sampled = Callable[[Array], tuple[Array, Array, Array, Array]]
"""Times (T,) -> quaternions (T, S, 4) and their weights (T, S), accelerations, their weights."""


@dataclass(frozen=True)
class Delay(Unknown):
    """Delay of the video, and its rate where the clocks differ."""

    sigma: float
    """[s]"""
    sigma_drift: float | None
    """[s/s]; None for equal clocks."""
    sampled: Sampled
    """The sensors at any times."""
    name = "delay"
    searched = True
    items = ("video",)

    @property
    def covariance(self) -> Array:
        """(1, 1), or (2, 2) with the clocks' drift."""
        return np.diag(np.square([v for v in (self.sigma, self.sigma_drift) if v is not None]))

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Sample the sensors at the corrected times of the video."""
        times = given.times
        q, w, a, w_a = self.sampled(times - powers_of_time(times, times, len(y)) @ y)
        return replace(given.changed(quat_sensor=q, w_sensor=w), a_world=a, w_acceleration=w_a)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives by time; those of accelerations after a low-pass, as they are mostly noise."""
        rate, R = at.given.rate_hz, at.R_measured
        known = at.given.rows["w_sensor"][at.index] > 0
        steps = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * rate
        steps = steps * (known[1:] & known[:-1])[..., None]
        turning = np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
        powers = powers_of_time(at.times, at.given.times, len(y))
        return Changes(
            turns=-turning[..., None] * powers[:, None, None],
            accelerations=-at.given.jerk_world[at.index][1:-1, ..., None] * powers[1:-1, None, None],
        )


@dataclass(frozen=True)
class Heading(Unknown):
    """Rotation of each sensor's reference about the vertical, and its rate."""

    items: tuple[str, ...]
    sigma: float
    """[rad]"""
    sigma_drift: float | None
    """[rad/s]; None for constant headings."""
    name = "heading"

    @property
    def covariance(self) -> Array:
        """(k, k), sensor after sensor."""
        own = [v for v in (self.sigma, self.sigma_drift) if v is not None]
        return np.diag(np.square(np.tile(own, len(self.items))))

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate orientations and accelerations."""
        own = y.reshape(len(self.items), -1)
        angle = powers_of_time(given.times, given.times, own.shape[1]) @ own.T
        zero = np.zeros_like(angle)
        turn = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
        a = so3.about_axis("z", angle) @ given.a_world[..., None]
        q = quat.multiply(turn, given.rows["quat_sensor"])
        return replace(given.changed(quat_sensor=q), a_world=a[..., 0])

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives by rotations about world's z."""
        powers = powers_of_time(at.times, at.given.times, len(y) // len(self.items))
        a = at.a_world
        across = np.stack([-a[..., 1], a[..., 0], np.zeros_like(a[..., 0])], axis=-1)
        return Changes(
            turns=each(at.R_measured[..., 2, :, None] * powers[:, None, None]),
            accelerations=each(across[..., None] * powers[1:-1, None, None]),
        )


@dataclass(frozen=True)
class Mounting(Unknown):
    """Rotation of each sensor's segment from its measured orientation."""

    items: tuple[str, ...]
    axes: Array
    """(S, 3) directions of the bones in their segments; 0 for none."""
    sigma_swing: float
    """[rad] about axes across the bone."""
    sigma_twist: float
    """[rad] about the bone."""
    name = "mounting"

    @property
    def covariance(self) -> Array:
        """(3S, 3S), swing and twist of sensor after sensor."""
        out = np.eye(3 * len(self.items)) * self.sigma_swing**2
        for s, axis in enumerate(self.axes):
            own = slice(3 * s, 3 * s + 3)
            out[own, own] += (self.sigma_twist**2 - self.sigma_swing**2) * np.outer(axis, axis)
        return out

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Rotate orientations in their segments."""
        q = quat.multiply(given.rows["quat_sensor"], quat.exp(y.reshape(-1, 3)))
        return given.changed(quat_sensor=q)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:
        """Derivatives in the segment's axes."""
        turn = quat.right_jacobian(y.reshape(-1, 3))
        return Changes(turns=each(np.broadcast_to(turn, (len(at.times), *turn.shape))))


@dataclass(frozen=True)
class LeverArm(Isotropic):
    """Error of each sensor's position in its segment."""

    items: tuple[str, ...]
    sigma: float
    """[m] per axis."""
    name = "lever arm"
    width = 3

    def correct(self, given: CalibrationObservations, y: Array) -> CalibrationObservations:
        """Add to the lever arms."""
        return given.known(levers=given.constant["levers"] + y.reshape(-1, 3).T)

    def changes(self, at: CalibrationResiduals, y: Array) -> Changes:  # noqa: ARG002
        """Derivatives along the segments' axes."""
        return Changes(sensors=each(at.R[:, list(at.joints.sensors)]))
