"""How well calibrated sensors fit a body: log-likelihoods of what they say in movement, in nats.

A sensor is read as sitting on some segment (`SegmentMotion`). What is looked at:

- posture: the orientation of two segments against each other, under the pose prior of free motion
  (`FreeMotion`) and the limits of the joint;
- turning: the direction of their relative angular velocity in the axes of both, under the angular
  central Gaussian (Tyler 1987) that the prior's movements have: a knee turns about its y axis;
- upright: where up is in a segment's axes, for somebody who mostly stands;
- seen: where a camera looked, the directions of the bones (where given);
- joint centre: where one segment begins at the other, both sensors must find the same acceleration.

All have heavy tails (Student's t), since people do what no prior has seen. Neighbouring instants say
nearly the same: what an instant weighs is its duration over a correlation time, which grows with the
number of joints between two segments. And it weighs little where nothing moves: a posture that is held
for long is still one posture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import gammaln

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.inertial.free_motion import FreeMotion, Pair
from rtof_kin.inertial.segment_motion import RATE_HZ, SegmentMotion

Array = NDArray[np.float64]
_EVERY = 4
"""Every so many instants are looked at, which say nearly as much as all."""


@dataclass(frozen=True)
class LikelihoodSettings:
    """How much is believed of what."""

    limit_deg: float = 10.0  # [deg] by which a joint passes its limits with likelihood exp(-1/2)
    seen_deg: float = 20.0  # [deg] between a bone as a camera saw it and as its sensor says
    least_turning: float = 0.7  # [rad/s] slower relative turns say nothing
    acceleration: float = 1.5  # [m/s^2] at rest, of a joint centre
    acceleration_share: float = 0.3  # [-] and this share of it in movement
    smoothing: float = 0.1  # [s] that accelerations are averaged over
    posture_memory: float = 1.0  # [s] correlation times
    turning_memory: float = 0.3  # [s]
    acceleration_memory: float = 0.3  # [s]
    degrees_of_freedom: float = 3.0  # [-] of Student's t


class MotionLikelihood:
    """Log-likelihoods of motions on one skeleton, in nats."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        settings: LikelihoodSettings | None = None,
        seen: Mapping[str, Array] | None = None,
    ) -> None:
        """For one skeleton; `seen`: `seen_bones` at the motions' times, where a camera looked.

        Raises:
            CalibrationError: there is no pose prior of this skeleton.
        """
        self.skeleton, self.settings = skeleton, settings or LikelihoodSettings()
        self.free_motion, self.seen = FreeMotion(skeleton), seen or {}
        self._accelerations: WeakKeyDictionary[SegmentMotion, dict[str, Array]] = WeakKeyDictionary()

    def tree(self, joints: Sequence[str]) -> list[tuple[str, str]]:
        """Pairs of segments by which all are compared, each with what is nearest to it in the skeleton.

        Of a pair the one nearer to the root stands first.
        """
        distance = np.array([[self._apart(a, b) for b in joints] for a in joints], dtype=float)
        # Of equal distances the smaller indices, so that the tree does not depend on rounding.
        rows, columns = minimum_spanning_tree(np.triu(distance)).nonzero()
        pairs = [(joints[int(i)], joints[int(j)]) for i, j in zip(rows, columns, strict=True)]
        order = self.skeleton.names.index
        return [(a, b) if order(a) < order(b) else (b, a) for a, b in pairs]

    def single(self, motion: SegmentMotion) -> float:
        """Of one sensor alone: where up is, and where a camera looked, whether the bones point so."""
        mean, precision = self.free_motion.up(motion.joint)
        values = self._student(motion.R_world_bone[:, 2, :] - mean, precision)
        if motion.joint in self.seen:
            own = kinematics.children_of(self.skeleton.parents, self.skeleton.names.index(motion.joint))
            rest = so3.unit(self.skeleton.joint_offsets[own])
            expected = np.einsum("tij,cj->tci", motion.R_world_bone, rest)
            square = np.sum((expected - self.seen[motion.joint]) ** 2, axis=-1).mean(axis=1)
            values = values - self._tail(square / np.radians(self.settings.seen_deg) ** 2, 2)
        return self._summed(values * self._moving(motion.w_world), self.settings.posture_memory)

    def pair(self, a: SegmentMotion, b: SegmentMotion) -> float:
        """Of two sensors, a's segment nearer to the root: posture, turning, joint centre."""
        prior = self.free_motion.pair(a.joint, b.joint)
        R_a_b = np.swapaxes(a.R_world_bone, -1, -2) @ b.R_world_bone
        known = np.isfinite(R_a_b).all(axis=(-2, -1))
        weight = self._moving(b.w_world - a.w_world)[known]
        values = self._posture(a.joint, b.joint, prior, R_a_b[known][::_EVERY])
        out = _EVERY * self._summed(values * weight[::_EVERY], self.settings.posture_memory)
        out = (out + self._turning(prior, a, b)) / self._apart(a.joint, b.joint)
        return out + self._joint_centre(a, b) if self._neighbours(a.joint, b.joint) else out

    # --- terms -----------------------------------------------------------------------------------

    def _moving(self, w: Array) -> Array:
        """(T,) how much instants weigh, 0 to 1, by angular velocities (T, 3)."""
        speed = np.linalg.norm(w, axis=-1) / self.settings.least_turning
        return np.asarray(np.minimum(speed, 1.0))

    def _posture(self, a: str, b: str, prior: Pair, R_a_b: Array) -> Array:
        """(T,) log densities of orientations (T, 3, 3) of one segment against another."""
        off = so3.log(prior.R_mean.T @ R_a_b)
        values = self._student(off, prior.precision)
        if self._neighbours(a, b):
            joint = self.skeleton.table.joints[self.skeleton.names.index(b)]
            low, high = joint.limits.T
            angles = so3.matrix_to_euler(joint.axes, R_a_b)
            angles = so3.euler_near(angles, np.broadcast_to((low + high) / 2, angles.shape))
            excess = np.maximum(np.maximum(low - angles, angles - high), 0.0)
            off_limits = np.sum(excess**2, axis=-1) / np.radians(self.settings.limit_deg) ** 2
            values -= self._tail(off_limits, 1)
        return values

    def _turning(self, prior: Pair, a: SegmentMotion, b: SegmentMotion) -> float:
        w = (b.w_world - a.w_world)[::_EVERY]
        enough = np.linalg.norm(w, axis=-1) > self.settings.least_turning
        direction = so3.unit(w[enough])
        out = 0.0
        for shape, motion in ((prior.turning_a, a), (prior.turning_b, b)):
            R = motion.R_world_bone[::_EVERY][enough]
            own = np.einsum("tji,tj->ti", R, direction)
            out -= np.sum(np.log(np.einsum("ti,ij,tj->t", own, shape, own)))
        # Half of each: the two say much the same.
        return float(1.5 * out / 2 * _EVERY / (RATE_HZ * self.settings.turning_memory))

    def _joint_centre(self, a: SegmentMotion, b: SegmentMotion) -> float:
        at_a, at_b = self._acceleration(a, b.joint), self._acceleration(b, b.joint)
        known = np.isfinite(at_a).all(axis=-1) & np.isfinite(at_b).all(axis=-1)
        if not known.any():
            return 0.0
        at_a, at_b = at_a[known], at_b[known]
        s = self.settings
        variance = s.acceleration**2 + s.acceleration_share**2 * np.mean(at_b**2)
        typical = variance + np.mean(at_b**2)
        together = self._tail(np.sum((at_a - at_b) ** 2, axis=-1) / variance, 3)
        apart = self._tail(np.sum(at_b**2, axis=-1) / typical, 3)
        gain = 1.5 * np.log(typical / variance) + apart - together
        signal = np.sum(at_a**2 + at_b**2, axis=-1) / (6 * s.acceleration**2)
        return self._summed(gain * signal / (1 + signal), s.acceleration_memory) * _EVERY

    def _acceleration(self, motion: SegmentMotion, joint: str) -> Array:
        """(T / _EVERY, 3) m/s^2 in world of a joint at one end of the sensor's segment, smoothed.

        The sensor's own, and the second central difference of the arm from it to the joint, as
        `BoneImuSequence.resample` averages the sensor's. NaN near gaps.
        """
        known = self._accelerations.setdefault(motion, {})
        if joint not in known:
            here = joint == motion.joint
            at = 0.0 if here else self.skeleton.joint_offsets[self.skeleton.names.index(joint)]
            arm = motion.R_world_bone @ (at - motion.p_bone_sensor)
            a = motion.a_world[1:-1] + np.diff(arm, n=2, axis=0) * RATE_HZ**2
            width = max(round(self.settings.smoothing * RATE_HZ), 1)
            sums = [a[i : len(a) - width + 1 + i : 1][::_EVERY] for i in range(width)]
            known[joint] = np.sum(sums, axis=0) / width
        return known[joint]

    # --- parts -----------------------------------------------------------------------------------

    def _student(self, off: Array, precision: Array) -> Array:
        """(T,) log densities of a t distribution at deviations (T, d)."""
        d, nu = off.shape[-1], self.settings.degrees_of_freedom
        square = np.einsum("ti,ij,tj->t", off, precision, off)
        constant = (
            gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
            + np.linalg.slogdet(precision)[1] / 2
        )  # fmt: skip
        return np.asarray(constant - self._tail(square, d))

    def _tail(self, square: Array, d: int) -> Array:
        """Minus the log of a t density but for its constant, of squared deviations (T,) in d axes."""
        nu = self.settings.degrees_of_freedom
        return np.asarray((nu + d) / 2 * np.log1p(square / nu))

    def _apart(self, a: str, b: str) -> int:
        """Number of joints between two segments. So many times longer do they keep a posture: what
        happens between limbs is habit, and what no sensor sees has to be guessed.
        """
        parents = self.skeleton.parents
        lines = (kinematics.line_to_root(parents, j) for j in self.skeleton.index(a, b))
        return len(set.symmetric_difference(*map(set, lines)))

    def _neighbours(self, a: str, b: str) -> bool:
        return self.skeleton.parents[self.skeleton.names.index(b)] == self.skeleton.names.index(a)

    def _summed(self, values: Array, memory: float) -> float:
        return float(np.nansum(values) / (RATE_HZ * memory))
