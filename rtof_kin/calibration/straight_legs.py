"""How straight legs are while a person stands or walks, as evidence of how sensors sit on thighs and shanks.

Gravity in the axes of a segment, as its sensor measures it, is the segment's tilt but for the mounting; headings do not
matter. People who stand still have nearly straight knees, and so have those who walk in the straightest tenth of the
time. By how much people differ is the standard deviation of the evidence, which counts less where it contradicts the
rest (Student's t): a patient's knees may be bent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

_KNEE, _LEAN, _ASIDE = (2.0, 4.0), (4.0, 4.0), (0.0, 5.0)
"""[deg] Mean and standard deviation over people who stand: knee flexion, shank forward, thigh and shank sideways."""
_WALKING_KNEE: Final = (4.0, 4.0)  # [deg] The same of the knee in the straightest tenth of a walk
_FREEDOM, _TINY = 4.0, 1e-6  # Degrees of freedom of Student's t, and least residual, of which a root is taken
_STILL, _STILL_S, _STEP_S = 0.25, 0.7, 0.1  # [rad/s] of thighs and shanks in standing, [s] for which, [s] of a turn
_UPRIGHT: Final = float(np.cos(np.radians(30.0)))  # Of thighs, shanks and trunk in standing, by the image
_WINDOW_S, _WALK_S = 2.0, 2.5  # [s] in which walking is recognised, and shortest walk
_BENDS: Final = float(np.radians(30.0))  # Least range of both knees in such a window
_ALTERNATE: Final = -0.4  # Largest correlation of both thighs in it
LEGS: Final = (("LeftUpLeg", "LeftLeg"), ("RightUpLeg", "RightLeg"))
NEVER_STILL: Final = "the person never stands still"  # Beginning of the note of a recording that was set up so


@dataclass(frozen=True)
class StraightLeg:
    """A leg in a posture whose tilts are known from other people."""

    sensors: tuple[int, int]  # Of thigh and shank, among S
    up: Array  # (2, F, 3) vertical in their measured axes
    still: bool  # Whether the person stands, or walks

    def residuals(self, y: Array) -> tuple[Array, Array]:
        """Return residuals (m,), half of whose squares are nats, and their derivatives (m, 3S) at mountings y (S, 3),
        rad.
        """
        tilts, slopes = np.zeros((2, 2)), np.zeros((2, 2, *y.shape))  # Segment; forward, sideways
        for i, s in enumerate(self.sensors):
            v = self.up[i] @ so3.exp(y[s])
            by = so3.skew(v) @ quat.right_jacobian(y[s])
            x, aside, z = v.T
            tilts[i] = np.arctan2(-x, z).mean(), np.arctan2(aside, z).mean()
            slopes[i, 0, s] = ((x[:, None] * by[:, 2] - z[:, None] * by[:, 0]) / (x**2 + z**2)[:, None]).mean(axis=0)
            turned = z[:, None] * by[:, 1] - aside[:, None] * by[:, 2]
            slopes[i, 1, s] = (turned / (aside**2 + z**2)[:, None]).mean(axis=0)
        values, by_y = [tilts[1, 0] - tilts[0, 0]], [slopes[1, 0] - slopes[0, 0]]
        usual = [_KNEE if self.still else _WALKING_KNEE]
        if self.still:
            values += [tilts[1, 0], *tilts[:, 1]]
            by_y += [slopes[1, 0], *slopes[:, 1]]
            usual += [_LEAN, _ASIDE, _ASIDE]
        mean, sigma = np.radians(usual).T
        r = (np.array(values) - mean) / sigma
        r = np.where(np.abs(r) < _TINY, _TINY, r)
        robust = np.sign(r) * np.sqrt((_FREEDOM + 1) * np.log1p(r**2 / _FREEDOM))
        slope = (_FREEDOM + 1) * r / (_FREEDOM + r**2) / robust
        return robust, (slope / sigma)[:, None] * np.reshape(by_y, (len(r), -1))


def straight_legs(
    slices: Sequence[tuple[BoneImuSequence, PoseSequence]], sensors: Sequence[str]
) -> tuple[StraightLeg, ...]:
    """Return the legs with both sensors in standing, else in walking; none where the person does neither.

    Args:
        slices: of one recording: sensors, and poses at the same even times. sensors: S segments.
    """
    legs = [leg for leg in LEGS if {*leg} <= {*sensors}]
    needed = {joint for leg in legs for joint in leg}
    parts = [_postures(imus, poses, legs) for imus, poses in slices if needed and needed <= {*imus.joints}]
    if not parts:
        return ()
    up, stands, walks = (np.concatenate(values) for values in zip(*parts, strict=True))
    found = []
    for (thigh, shank), own in zip(legs, np.swapaxes(up, 0, 1).reshape(len(legs), 2, -1, 3), strict=True):
        chosen = np.flatnonzero(stands)
        if not len(chosen):
            frames = np.flatnonzero(walks)
            chosen = frames[np.argsort(_knee(own[:, frames]))[: len(frames) // 10]]
        if len(chosen):
            carriers = sensors.index(thigh), sensors.index(shank)
            found.append(StraightLeg(carriers, own[:, chosen], bool(stands.any())))
    return tuple(found)


def _knee(up: Array) -> Array:
    """(...) flexion, rad, of (2, ..., 3) verticals in thigh and shank."""
    thigh, shank = np.arctan2(-up[..., 0], up[..., 2])
    return np.asarray(shank - thigh)


def _postures(imus: BoneImuSequence, poses: PoseSequence, legs: Sequence[tuple[str, str]]) -> tuple[Array, Mask, Mask]:
    """Return verticals (T, 2 L, 3) in thighs and shanks, and in which frames (T,) the person stands and walks."""
    names = [joint for leg in legs for joint in leg]
    R, T, rate = imus.R_world_bone[:, [imus.joints.index(n) for n in names]], len(poses), poses.rate_hz
    up, known = R[..., 2, :], np.asarray(np.isfinite(R).all(axis=(1, 2, 3)))
    upward = poses.R_world_bone[:, [poses.names.index(n) for n in (*names, "Spine3")], 2, 2]
    tall = np.asarray(upward > _UPRIGHT)
    step, width = max(1, round(_STEP_S * rate)), max(1, round(_STILL_S * rate))
    turned = np.full((T, len(names)), np.inf)
    if step < T:
        turned[step // 2 : T - step + step // 2] = so3.angle_between(R[:-step], R[step:]) * rate / step
    fast = np.where(np.isfinite(turned), np.minimum(turned, 10.0), 10.0).max(axis=1)
    stands = (uniform_filter1d(fast, width, mode="constant", cval=10.0) < _STILL) & known & np.all(tall, axis=1)
    walks = np.zeros(T, dtype=bool)
    window = round(_WINDOW_S * rate)
    for first in range(0, T - window + 1 if len(legs) == 2 else 0, window):
        own = slice(first, first + window)
        if known[own].all() and tall[own, -1].all() and _strides(np.moveaxis(up[own], 0, 1)):
            walks[own] = True
    return up, stands, walks & (walks.sum() >= _WALK_S * rate)


def _strides(up: Array) -> bool:
    """Whether both knees bend and the thighs alternate; up: (4, F, 3) verticals in left and right thigh and shank."""
    bends = [np.ptp(_knee(up[own])) for own in (slice(0, 2), slice(2, 4))]
    thighs = np.arctan2(-up[[0, 2], :, 0], up[[0, 2], :, 2])
    return bool(min(bends) > _BENDS and np.corrcoef(thighs)[0, 1] < _ALTERNATE)
