"""How well calibrated sensors fit a body: log-likelihoods of what they say in movement, in nats.

`Reading` is one sensor, read as sitting on some segment. What is looked at:

- posture: the orientation of two segments against each other, under the pose prior of free motion
  (carried to pairs that are not neighbours by samples of whole poses) and the limits of the joint;
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
from functools import cache, cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import gammaln

from rtof_kin import kinematics, signals
from rtof_kin import rotations as so3
from rtof_kin.checks import readonly
from rtof_kin.errors import CalibrationError, ShapeError
from rtof_kin.inertial.stillness import orientation_rate
from rtof_kin.joint_space.prior import has_prior, shipped_prior
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, PoseSequence

Array = NDArray[np.float64]
RATE_HZ = 60.0
"""Rate that readings are compared at; calibrated sensors are resampled to it."""
_EVERY = 4
"""Every so many instants are looked at, which say nearly as much as all."""


@dataclass(frozen=True)
class EvidenceSettings:
    """How much is believed of what."""

    misalignment_deg: float = 12.0  # [deg] per axis, of a good calibration and soft tissue
    limit_deg: float = 10.0  # [deg] by which a joint passes its limits with likelihood exp(-1/2)
    tilt_deg: float = 20.0  # [deg] per axis, of the root against upright
    up_sigma: float = 0.25  # [-] added to the spread of the direction of up
    seen_deg: float = 20.0  # [deg] between a bone as a camera saw it and as its sensor says
    turning_floor: float = 0.06  # [-] share of a turn that is about any axis
    least_turning: float = 0.7  # [rad/s] slower relative turns say nothing
    acceleration: float = 1.5  # [m/s^2] at rest, of a joint centre
    acceleration_share: float = 0.3  # [-] and this share of it in movement
    smoothing: float = 0.1  # [s] that accelerations are averaged over
    posture_memory: float = 1.0  # [s] correlation times
    turning_memory: float = 0.3  # [s]
    acceleration_memory: float = 0.3  # [s]
    degrees_of_freedom: float = 3.0  # [-] of Student's t


@dataclass(frozen=True, eq=False)
class Reading:
    """One sensor, read as sitting on a segment."""

    joint: str
    """The segment, by its proximal joint."""
    R_world_bone: Array
    """(T, 3, 3)"""
    w_world: Array
    """(T, 3) angular velocity in world, rad/s"""
    a_world: Array
    """(T, 3) acceleration of the sensor, m/s^2"""
    p_bone_sensor: Array
    """(3,) m"""

    def moved(self, joint: str, R_bone_new: Array, p_bone_sensor: Array) -> Reading:
        """The same sensor on another segment, or mounted otherwise: bone axes turned by R_bone_new."""
        return Reading(
            joint, self.R_world_bone @ R_bone_new, self.w_world, self.a_world, p_bone_sensor
        )

    def turned(self, R_world_new: Array) -> Reading:
        """The same with its reference turned in world, by R (3, 3) from the left."""
        return Reading(
            self.joint,
            R_world_new @ self.R_world_bone,
            self.w_world @ R_world_new.T,
            self.a_world @ R_world_new.T,
            self.p_bone_sensor,
        )


def even_times(bone_imus: BoneImuSequence) -> Array:
    """(T,) s at `RATE_HZ`, over all that the sensors measured.

    Raises:
        ShapeError: that is too short to say anything about movement.
    """
    start, stop = bone_imus.times[[0, -1]]
    if stop - start < 1.0:
        raise ShapeError(f"{stop - start:.2g} s of sensor data are too short to judge a movement by")
    return np.asarray(np.arange(start, stop + 1e-9, 1 / RATE_HZ), dtype=np.float64)


def readings_of(bone_imus: BoneImuSequence) -> tuple[Reading, ...]:
    """The sensors as declared, at `even_times`."""
    times = even_times(bone_imus)
    even = bone_imus.resample(times)
    readings = []
    for s, joint in enumerate(even.joints):
        R = even.R_world_bone[:, s]
        w_world = np.einsum("tij,tj->ti", R, orientation_rate(times, R))
        readings.append(Reading(joint, R, w_world, even.a_world[:, s], even.p_bone_sensor[s]))
    return tuple(readings)


def seen_bones(poses: PoseSequence, skeleton: SkeletonModel, times: Array) -> dict[str, Array]:
    """Directions (T, C, 3) in world, at some times, from each joint to its C children, as a camera
    saw them.

    Joints of which nothing was seen, and those without children, are not there.
    """
    skeleton.check_joints(poses.names)
    p = signals.interpolate(poses.times, poses.p_world_joint, times, max_gap=0.2)
    children = {j: kinematics.children_of(skeleton.parents, j) for j in range(len(skeleton.names))}
    return {
        skeleton.names[j]: so3.unit(p[:, own] - p[:, [j]])
        for j, own in children.items()
        if own and np.isfinite(p[:, [*own, j]]).all(axis=(1, 2)).any()
    }


@dataclass(frozen=True)
class _Pair:
    """What free motion says of the orientation of segment b against segment a."""

    R_mean: Array
    """(3, 3) mean of R_a_b"""
    precision: Array
    """(3, 3) of log(R_mean^T R_a_b), rad^-2"""
    turning_a: Array
    """(3, 3) inverse shape of the relative angular velocity in a's axes, determinant 1"""
    turning_b: Array
    """(3, 3) the same in b's axes"""


class Evidence:
    """Log-likelihoods of readings on one skeleton, in nats."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        settings: EvidenceSettings | None = None,
        seen: Mapping[str, Array] | None = None,
    ) -> None:
        """For one skeleton; `seen`: `seen_bones` at the readings' times, where a camera looked.

        Raises:
            CalibrationError: there is no pose prior of this skeleton.
        """
        if not has_prior(skeleton.name):
            raise CalibrationError(
                f"movement cannot be judged on the skeleton {skeleton.name}: there is no pose prior of "
                "it; use the one with 21 joints, or give the headings"
            )
        self.skeleton, self.settings = skeleton, settings or EvidenceSettings()
        self.seen = seen or {}
        self._pairs: dict[tuple[str, str], _Pair] = {}
        self._ups: dict[str, tuple[Array, Array]] = {}
        self._accelerations: WeakKeyDictionary[Reading, dict[str, Array]] = WeakKeyDictionary()

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

    def single(self, reading: Reading) -> float:
        """Of one sensor alone: where up is, and where a camera looked, whether the bones point so."""
        mean, precision = self._up(reading.joint)
        values = self._student(reading.R_world_bone[:, 2, :] - mean, precision)
        if reading.joint in self.seen:
            own = kinematics.children_of(
                self.skeleton.parents, self.skeleton.names.index(reading.joint)
            )
            rest = so3.unit(self.skeleton.joint_offsets[own])
            expected = np.einsum("tij,cj->tci", reading.R_world_bone, rest)
            square = np.sum((expected - self.seen[reading.joint]) ** 2, axis=-1).mean(axis=1)
            values = values - self._tail(square / np.radians(self.settings.seen_deg) ** 2, 2)
        return self._summed(values * self._moving(reading.w_world), self.settings.posture_memory)

    def pair(self, a: Reading, b: Reading) -> float:
        """Of two sensors, a's segment nearer to the root: posture, turning, joint centre."""
        prior = self._pair(a.joint, b.joint)
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

    def _posture(self, a: str, b: str, prior: _Pair, R_a_b: Array) -> Array:
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

    def _turning(self, prior: _Pair, a: Reading, b: Reading) -> float:
        w = (b.w_world - a.w_world)[::_EVERY]
        enough = np.linalg.norm(w, axis=-1) > self.settings.least_turning
        direction = so3.unit(w[enough])
        out = 0.0
        for shape, reading in ((prior.turning_a, a), (prior.turning_b, b)):
            R = reading.R_world_bone[::_EVERY][enough]
            own = np.einsum("tji,tj->ti", R, direction)
            out -= np.sum(np.log(np.einsum("ti,ij,tj->t", own, shape, own)))
        # Half of each: the two say much the same.
        return float(1.5 * out / 2 * _EVERY / (RATE_HZ * self.settings.turning_memory))

    def _joint_centre(self, a: Reading, b: Reading) -> float:
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

    def _acceleration(self, reading: Reading, joint: str) -> Array:
        """(T / _EVERY, 3) m/s^2 in world of a joint at one end of the sensor's segment, smoothed.

        The sensor's own, and the second central difference of the arm from it to the joint, as
        `BoneImuSequence.resample` averages the sensor's. NaN near gaps.
        """
        known = self._accelerations.setdefault(reading, {})
        if joint not in known:
            here = joint == reading.joint
            at = 0.0 if here else self.skeleton.joint_offsets[self.skeleton.names.index(joint)]
            arm = reading.R_world_bone @ (at - reading.p_bone_sensor)
            a = reading.a_world[1:-1] + np.diff(arm, n=2, axis=0) * RATE_HZ**2
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
        happens between limbs is habit, and what no sensor sees has to be guessed."""
        parents = self.skeleton.parents
        lines = (kinematics.line_to_root(parents, j) for j in self.skeleton.index(a, b))
        return len(set.symmetric_difference(*map(set, lines)))

    def _neighbours(self, a: str, b: str) -> bool:
        return self.skeleton.parents[self.skeleton.names.index(b)] == self.skeleton.names.index(a)

    def _summed(self, values: Array, memory: float) -> float:
        return float(np.nansum(values) / (RATE_HZ * memory))

    @cached_property
    def _samples(self) -> tuple[Array, Array]:
        return _sampled_poses(self.skeleton.names, tuple(self.skeleton.parents), self.settings.tilt_deg)

    def _up(self, joint: str) -> tuple[Array, Array]:
        """Mean (3,) and precision (3, 3) of the direction of up in a segment's axes."""
        if joint not in self._ups:
            up = self._samples[0][:, self.skeleton.names.index(joint), 2, :]
            spread = np.cov(up.T) + self.settings.up_sigma**2 * np.eye(3)
            self._ups[joint] = up.mean(axis=0), np.asarray(np.linalg.inv(spread))
        return self._ups[joint]

    def _pair(self, a: str, b: str) -> _Pair:
        if (a, b) not in self._pairs:
            i, j = self.skeleton.index(a, b)
            now, soon = (np.swapaxes(R[:, i], -1, -2) @ R[:, j] for R in self._samples)
            R_mean = so3.nearest_rotation(now.mean(axis=0))
            off = so3.log(R_mean.T @ now)
            spread = off.T @ off / len(off)
            spread += 2 * np.radians(self.settings.misalignment_deg) ** 2 * np.eye(3)
            w_b = so3.log(np.swapaxes(now, -1, -2) @ soon)
            w_a = np.einsum("nij,nj->ni", now, w_b)
            precision = np.asarray(np.linalg.inv(spread))
            shapes = self._inverse_shape(w_a), self._inverse_shape(w_b)
            self._pairs[a, b] = _Pair(R_mean, precision, *shapes)
        return self._pairs[a, b]

    def _inverse_shape(self, w: Array) -> Array:
        """Inverse of the angular central Gaussian's matrix, of determinant 1, of velocities (N, 3)."""
        shape = w.T @ w
        shape = shape / np.trace(shape) + self.settings.turning_floor * np.eye(3)
        return np.asarray(np.linalg.inv(shape / np.cbrt(np.linalg.det(shape))))


@cache
def _sampled_poses(
    names: tuple[str, ...], parents: tuple[int, ...], tilt_deg: float, count: int = 4000
) -> tuple[Array, Array]:
    """R_world_bone (N, J, 3, 3) of poses of the prior with the root's heading 0, and a moment later.

    A moment later every joint has moved by a hundredth of another draw from the prior.
    """
    prior = shipped_prior(names)
    rng = np.random.default_rng(0)
    size = len(prior.covariance)
    root = np.linalg.cholesky(prior.covariance + 1e-9 * np.eye(size))
    pose, velocity = rng.standard_normal((2, count, size)) @ root.T
    tilt = rng.standard_normal((count, 1, 3)) * np.radians(tilt_deg) * np.array([1.0, 1.0, 0.0])
    out = []
    for off in (pose, pose + 0.01 * velocity):
        local = so3.from_quat_wxyz(prior.mean_quat_wxyz) @ so3.exp(off.reshape(count, -1, 3))
        all_local = np.concatenate([so3.exp(tilt), local], axis=1)
        out.append(readonly("sampled poses", kinematics.world_rotations(parents, all_local),
                            (count, len(names), 3, 3)))  # fmt: skip
    return out[0], out[1]
