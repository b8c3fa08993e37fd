"""How well calibrated sensors fit a body: log-likelihoods of what they say in movement, in nats.

`Reading` is one sensor, read as sitting on some segment. What is looked at:

- posture: the orientation of two segments against each other, under the pose prior of free motion
  (carried to pairs that are not neighbours by samples of whole poses) and the limits of the joint;
- turning: the direction of their relative angular velocity in the axes of both, under the angular
  central Gaussian (Tyler 1987) that the prior's movements have: a knee turns about its y axis;
- upright: where up is in a segment's axes, for somebody who mostly stands;
- joint centre: where one segment begins at the other, both sensors must find the same acceleration.

All have heavy tails (Student's t), since people do what no prior has seen. Neighbouring instants say
nearly the same: what an instant weighs is its duration over a correlation time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import gammaln

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.checks import readonly
from rtof_kin.errors import ShapeError
from rtof_kin.inertial.stillness import orientation_rate
from rtof_kin.joint_space.prior import shipped_prior
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence

Array = NDArray[np.float64]
RATE_HZ = 60.0
"""Rate that readings are compared at; calibrated sensors are resampled to it."""


@dataclass(frozen=True)
class EvidenceSettings:
    """How much is believed of what."""

    misalignment_deg: float = 12.0  # [deg] per axis, of a good calibration and soft tissue
    limit_deg: float = 10.0  # [deg] by which a joint passes its limits with likelihood exp(-1/2)
    tilt_deg: float = 20.0  # [deg] per axis, of the root against upright
    up_sigma: float = 0.25  # [-] added to the spread of the direction of up
    turning_floor: float = 0.06  # [-] share of a turn that is about any axis
    least_turning: float = 0.7  # [rad/s] slower relative turns say nothing
    acceleration: float = 1.5  # [m/s^2] at rest, of a joint centre
    acceleration_share: float = 0.3  # [-] and this share of it in movement
    smoothing: float = 0.1  # [s] that accelerations are averaged over
    posture_memory: float = 1.0  # [s] correlation times
    turning_memory: float = 0.3  # [s]
    acceleration_memory: float = 0.3  # [s]
    degrees_of_freedom: float = 3.0  # [-] of Student's t


@dataclass(frozen=True)
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


def readings_of(bone_imus: BoneImuSequence) -> tuple[Reading, ...]:
    """The sensors as declared, at `RATE_HZ`."""
    start, stop = bone_imus.times[[0, -1]]
    times = np.arange(start, stop + 1e-9, 1 / RATE_HZ)
    if len(times) < 4:
        raise ShapeError(f"{stop - start:.2g} s of sensor data are too short to judge a movement")
    even = bone_imus.resample(times)
    readings = []
    for s, joint in enumerate(even.joints):
        R = even.R_world_bone[:, s]
        w_world = np.einsum("tij,tj->ti", R, orientation_rate(times, R))
        readings.append(Reading(joint, R, w_world, even.a_world[:, s], even.p_bone_sensor[s]))
    return tuple(readings)


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

    def __init__(self, skeleton: SkeletonModel, settings: EvidenceSettings | None = None) -> None:
        self.skeleton, self.settings = skeleton, settings or EvidenceSettings()
        self._pairs: dict[tuple[str, str], _Pair] = {}
        self._ups: dict[str, tuple[Array, Array]] = {}

    def tree(self, joints: Sequence[str]) -> list[tuple[str, str]]:
        """Pairs of segments by which all are compared, each with what is nearest to it in the skeleton.

        Of a pair the one nearer to the root stands first.
        """
        lines = [self._line(joint) for joint in joints]
        distance = np.array([[len(set(a) ^ set(b)) for b in lines] for a in lines], dtype=float)
        # Of equal distances the smaller indices, so that the tree does not depend on rounding.
        rows, columns = minimum_spanning_tree(np.triu(distance)).nonzero()
        pairs = [(joints[int(i)], joints[int(j)]) for i, j in zip(rows, columns, strict=True)]
        order = self.skeleton.names.index
        return [(a, b) if order(a) < order(b) else (b, a) for a, b in pairs]

    def single(self, reading: Reading) -> float:
        """Of one sensor alone: where up is."""
        mean, precision = self._up(reading.joint)
        off = reading.R_world_bone[:, 2, :] - mean
        values = self._student(off, precision)
        return self._summed(values, self.settings.posture_memory)

    def pair(self, a: Reading, b: Reading) -> float:
        """Of two sensors, a's segment nearer to the root: posture, turning, joint centre."""
        prior = self._pair(a.joint, b.joint)
        R_a_b = np.swapaxes(a.R_world_bone, -1, -2) @ b.R_world_bone
        known = np.isfinite(R_a_b).all(axis=(-2, -1))
        out = self._posture(a.joint, b.joint, prior, R_a_b[known][::3]) * 3
        out += self._turning(prior, a, b)
        names, parents = self.skeleton.names, self.skeleton.parents
        if names.index(a.joint) == parents[names.index(b.joint)]:
            out += self._joint_centre(a, b)
        return out

    # --- terms -----------------------------------------------------------------------------------

    def _posture(self, a: str, b: str, prior: _Pair, R_a_b: Array) -> float:
        off = so3.log(prior.R_mean.T @ R_a_b)
        values = self._student(off, prior.precision)
        j = self.skeleton.names.index(b)
        if self.skeleton.parents[j] == self.skeleton.names.index(a):
            joint = self.skeleton.table.joints[j]
            low, high = joint.limits.T
            angles = so3.matrix_to_euler(joint.axes, R_a_b)
            angles = so3.euler_near(angles, np.broadcast_to((low + high) / 2, angles.shape))
            excess = np.maximum(np.maximum(low - angles, angles - high), 0.0)
            off_limits = np.sum(excess**2, axis=-1) / np.radians(self.settings.limit_deg) ** 2
            values -= self._tail(off_limits, 1)
        return self._summed(values, self.settings.posture_memory)

    def _turning(self, prior: _Pair, a: Reading, b: Reading) -> float:
        w = b.w_world - a.w_world
        enough = np.linalg.norm(w, axis=-1) > self.settings.least_turning
        direction = so3.unit(w[enough])
        out = 0.0
        for shape, reading in ((prior.turning_a, a), (prior.turning_b, b)):
            own = np.einsum("tji,tj->ti", reading.R_world_bone[enough], direction)
            out -= np.sum(np.log(np.einsum("ti,ij,tj->t", own, shape, own)))
        # Half of each: the two say much the same.
        return float(1.5 * out / 2 / (RATE_HZ * self.settings.turning_memory))

    def _joint_centre(self, a: Reading, b: Reading) -> float:
        offset = self.skeleton.joint_offsets[self.skeleton.names.index(b.joint)]
        at_a = self._acceleration_at(a, offset)
        at_b = self._acceleration_at(b, np.zeros(3))
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
        return self._summed(gain, s.acceleration_memory)

    def _acceleration_at(self, reading: Reading, point: Array) -> Array:
        """(T, 3) m/s^2 in world of a point of the segment (3,), smoothed; NaN at the two ends.

        The second central difference of the arm from sensor to point, as `BoneImuSequence.resample`
        averages the sensor's acceleration.
        """
        arm = reading.R_world_bone @ (point - reading.p_bone_sensor)
        out = np.full_like(arm, np.nan)
        out[1:-1] = reading.a_world[1:-1] + np.diff(arm, n=2, axis=0) * RATE_HZ**2
        width = max(round(self.settings.smoothing * RATE_HZ), 1)
        padded = np.pad(out, ((width, width), (0, 0)), constant_values=np.nan)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * (width // 2) + 1, axis=0)
        first = width - width // 2
        return np.asarray(windows[first : first + len(out)].mean(axis=-1))

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

    def _summed(self, values: Array, memory: float) -> float:
        return float(np.nansum(values) / (RATE_HZ * memory))

    def _line(self, joint: str) -> list[int]:
        """Indices of a joint and all between it and the root."""
        out = []
        j = self.skeleton.index(joint)[0]
        while j >= 0:
            out.append(j)
            j = self.skeleton.parents[j]
        return out

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
