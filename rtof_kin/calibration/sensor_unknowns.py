"""What may be wrong with the sensors all through a recording; see `unknowns`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.calibration.residuals import Changes, Evidence, Situation
from rtof_kin.calibration.unknowns import Unlimited, each, powers_of_time
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
Sampled = Callable[[Array], tuple[Array, Array, Array, Array]]
"""Times (T,) -> quaternions (T, S, 4) and their weights (T, S), accelerations, their weights."""


@dataclass(frozen=True)
class Delay(Unlimited):
    """By how much the video is late; and by how much more a second, where the clocks differ."""

    sigma: float
    """[s]"""
    sigma_drift: float | None
    """[s/s]; None where the clocks run alike."""
    sampled: Sampled
    """The sensors at any times."""
    name = "delay"
    searched = True
    items = ("video",)

    @property
    def covariance(self) -> Array:
        """(1, 1), or (2, 2) with the clocks' drift."""
        return np.diag(np.square([v for v in (self.sigma, self.sigma_drift) if v is not None]))

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """The sensors at the times of what the video shows."""
        times = evidence.times
        q, w, a, w_a = self.sampled(times - powers_of_time(times, times, len(y)) @ y)
        return replace(evidence.changed(quat_sensor=q, w_sensor=w), a_world=a, w_acceleration=w_a)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Orientations and accelerations go back in time.

        Slopes of accelerations are taken after a low-pass: before it they are mostly noise, with which a
        delay would seem to be known many times better than it is.
        """
        rate, R = at.evidence.rate_hz, at.R_measured
        known = at.evidence.rows["w_sensor"][at.index] > 0  # elsewhere there is no orientation to go by
        steps = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * rate
        steps = steps * (known[1:] & known[:-1])[..., None]
        turning = np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
        powers = powers_of_time(at.times, at.evidence.times, len(y))
        return Changes(
            turns=-turning[..., None] * powers[:, None, None],
            accelerations=-at.evidence.jerk_world[at.index][1:-1, ..., None] * powers[1:-1, None, None],
        )


@dataclass(frozen=True)
class Heading(Unlimited):
    """By how much each sensor's reference is to be turned about the vertical, and how that grows."""

    items: tuple[str, ...]
    sigma: float
    """[rad]"""
    sigma_drift: float | None
    """[rad/s]; None where headings stay."""
    name = "heading"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of a sensor's constant and growth, sensor after sensor."""
        own = [v for v in (self.sigma, self.sigma_drift) if v is not None]
        return np.diag(np.square(np.tile(own, len(self.items))))

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Orientations and accelerations turned."""
        own = y.reshape(len(self.items), -1)
        angle = powers_of_time(evidence.times, evidence.times, own.shape[1]) @ own.T
        zero = np.zeros_like(angle)
        turn = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
        a = so3.about_axis("z", angle) @ evidence.a_world[..., None]
        q = quat.multiply(turn, evidence.rows["quat_sensor"])
        return replace(evidence.changed(quat_sensor=q), a_world=a[..., 0])

    def changes(self, at: Situation, y: Array) -> Changes:
        """About world's z."""
        S = len(self.items)
        powers = powers_of_time(at.times, at.evidence.times, len(y) // S)
        a = at.a_world
        across = np.stack([-a[..., 1], a[..., 0], np.zeros_like(a[..., 0])], axis=-1)
        return Changes(
            turns=each(at.R_measured[..., 2, :, None] * powers[:, None, None]),
            accelerations=each(across[..., None] * powers[1:-1, None, None]),
        )


@dataclass(frozen=True)
class Mounting(Unlimited):
    """How each sensor's segment is turned from where the sensor says it is."""

    items: tuple[str, ...]
    axes: Array
    """(S, 3) directions of the bones in their segments, about which a sensor slips most; 0 for none."""
    sigma_swing: float
    """[rad] about axes across the bone."""
    sigma_twist: float
    """[rad] about it."""
    name = "mounting"
    searched = False

    @property
    def covariance(self) -> Array:
        """Swing and twist apart, sensor after sensor."""
        out = np.eye(3 * len(self.items)) * self.sigma_swing**2
        for s, axis in enumerate(self.axes):
            own = slice(3 * s, 3 * s + 3)
            out[own, own] += (self.sigma_twist**2 - self.sigma_swing**2) * np.outer(axis, axis)
        return out

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Orientations turned in their segments."""
        q = quat.multiply(evidence.rows["quat_sensor"], quat.exp(y.reshape(-1, 3)))
        return evidence.changed(quat_sensor=q)

    def changes(self, at: Situation, y: Array) -> Changes:
        """In the segment's axes."""
        turn = quat.right_jacobian(y.reshape(-1, 3))
        return Changes(turns=each(np.broadcast_to(turn, (len(at.times), *turn.shape))))


@dataclass(frozen=True)
class LeverArm(Unlimited):
    """Where each sensor sits in its segment."""

    items: tuple[str, ...]
    sigma: float
    """[m] per axis."""
    name = "lever arm"
    searched = False

    @property
    def covariance(self) -> Array:
        """Of three axes, sensor after sensor."""
        return np.eye(3 * len(self.items)) * self.sigma**2

    def correct(self, evidence: Evidence, y: Array) -> Evidence:
        """Other lever arms."""
        return evidence.known(levers=evidence.constant["levers"] + y.reshape(-1, 3).T)

    def changes(self, at: Situation, y: Array) -> Changes:
        """Along the segments' axes."""
        own = list(at.joints.sensors)
        return Changes(sensors=each(at.R[:, own]))
