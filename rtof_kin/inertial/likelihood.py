"""Log-likelihoods, in nats, of calibrated sensors' motion under a model of the body.

A sensor's motion is read as that of a segment (`SegmentMotion`). The terms:

- posture: relative orientation of two segments, under the pose prior and the limits of the joint;
- turning: direction of their relative angular velocity in the axes of both, under an angular central
  Gaussian (Tyler 1987) fitted to samples of the prior;
- upright: direction of up in a segment's axes;
- seen: directions of the bones from a camera, if given;
- joint centre: equal accelerations from the two sensors beside a joint.

All have heavy tails (Student's t). Samples are correlated: a sample is weighted by its duration over a
correlation time, which grows with the number of joints between two segments, and little without movement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.special import gammaln

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import PosePrior, has_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

RATE_HZ: Final = 60.0  # of motions
_EVERY = 4  # sample used of so many, as neighbours are nearly equal
_MISALIGNMENT_DEG = 12.0  # per axis, of a good calibration and soft tissue
_TILT_DEG = 20.0  # per axis, of the root against upright
_UP_SIGMA = 0.25  # [-] added to the spread of the direction of up
_TURNING_FLOOR = 0.06  # [-] fraction of a rotation that is about any axis
_LIMIT_DEG = 10.0  # beyond a joint's limits, with likelihood exp(-1/2)
_SEEN_DEG = 20.0  # between a bone's direction from a camera and from its sensor
_LEAST_TURNING = 0.7  # [rad/s] of relative rotations that are used
_ACCELERATION, _ACCELERATION_SHARE = 1.5, 0.3  # [m/s^2] of a joint centre at rest, and [-] of its motion
_SMOOTHING = 0.1  # [s] window of accelerations
_POSTURE_MEMORY, _TURNING_MEMORY, _ACCELERATION_MEMORY = 1.0, 0.3, 0.3  # [s] correlation times
_FREEDOM = 3.0  # degrees of freedom of Student's t


@dataclass(frozen=True, eq=False)
class SegmentMotion:
    """Motion of one sensor on a segment."""

    joint: str  # Segment, by its proximal joint
    R_world_bone: Array  # (T, 3, 3)
    w_world: Array  # (T, 3) angular velocity, rad/s
    a_world: Array  # (T, 3) acceleration of the sensor, m/s^2
    p_bone_sensor: Array  # (3,) m

    def moved(self, joint: str, R_bone_new: Array, p_bone_sensor: Array) -> SegmentMotion:
        """Return the motion of the same sensor on another segment, or mounted otherwise: R_bone_new (3, 3) is a factor
        of R_world_bone, its position in m.
        """
        return SegmentMotion(joint, self.R_world_bone @ R_bone_new, self.w_world, self.a_world, p_bone_sensor)

    def turned(self, R_world_new: Array) -> SegmentMotion:
        """Return the motion with its reference rotated in world by a factor (3, 3) from the left."""
        R, w, a = R_world_new @ self.R_world_bone, self.w_world @ R_world_new.T, self.a_world @ R_world_new.T
        return SegmentMotion(self.joint, R, w, a, self.p_bone_sensor)


def even_times(bone_imus: BoneImuSequence) -> Array:
    """Return times (T,), s, at `RATE_HZ` over the sensors' duration; less than a second raises `InvalidInputError`."""
    start, stop = bone_imus.times[[0, -1]]
    if stop - start < 1.0:
        raise InvalidInputError(f"{stop - start:.2g} s of sensor data are too short to judge a movement by")
    return np.asarray(np.arange(start, stop + 1e-9, 1 / RATE_HZ), dtype=np.float64)


def segment_motions(bone_imus: BoneImuSequence) -> tuple[SegmentMotion, ...]:
    """Return the motions of calibrated sensors at `even_times`."""
    times = even_times(bone_imus)
    even = bone_imus.resample(times)
    motions = []
    for s, joint in enumerate(even.joints):
        R = even.R_world_bone[:, s]
        motions.append(SegmentMotion(joint, R, angular_velocity(times, R), even.a_world[:, s], even.p_bone_sensor[s]))
    return tuple(motions)


def seen_bones(poses: PoseSequence, skeleton: SkeletonModel, times: Array) -> dict[str, Array]:
    """Return directions (T, C, 3) in world from each joint to its C children at times (T,), s, from a camera's poses,
    by joint, without those never seen.
    """
    skeleton.check_joints(poses.names)
    p = signals.interpolate(poses.times, poses.p_world_joint, times, max_gap=0.2)
    children = {j: kinematics.children_of(skeleton.parents, j) for j in range(len(skeleton.names))}
    return {
        skeleton.names[j]: so3.unit(p[:, own] - p[:, [j]])
        for j, own in children.items()
        if own and np.isfinite(p[:, [*own, j]]).all(axis=(1, 2)).any()
    }


def angular_velocity(times: Array, R: Array) -> Array:
    """Return the angular velocity (T, 3), rad/s, in the reference of the orientations; see `orientation_rate`."""
    return np.asarray(np.einsum("tij,tj->ti", R, orientation_rate(times, R)))


def orientation_rate(times: Array, R: Array) -> Array:
    """Differentiate orientations (T, 3, 3) at times (T,), s, to angular velocity (T, 3), rad/s, in the rotating frame.
    Central differences, ``log(R(t-1)^T R(t+1)) / (t(t+1) - t(t-1))``, one-sided at the ends; NaN where one of the two
    orientations is.
    """
    last = len(times) - 1
    before, after = np.maximum(np.arange(last + 1) - 1, 0), np.minimum(np.arange(last + 1) + 1, last)
    return so3.known_log(np.swapaxes(R[before], -1, -2) @ R[after]) / (times[after] - times[before])[:, None]


@dataclass(frozen=True)
class _Pair:
    """Distribution of the orientation of segment b relative to segment a."""

    R_mean: Array  # (3, 3) mean of R_a_b
    precision: Array  # (3, 3) of log(R_mean^T R_a_b), rad^-2
    turning_a: Array  # (3, 3) inverse shape of the relative angular velocity in a's axes, determinant 1
    turning_b: Array  # (3, 3) in b's axes


class MotionLikelihood:
    """Log-likelihoods of motions on one skeleton, in nats. `CalibrationError`: there is no pose prior of this skeleton.

    Args:
        seen: `seen_bones` at the motions' times.
    """

    def __init__(self, skeleton: SkeletonModel, seen: Mapping[str, Array] | None = None) -> None:
        if not has_prior(skeleton.name):
            raise CalibrationError(
                f"movement cannot be judged on the skeleton {skeleton.name}: there is no pose prior of "
                "it; use the one with 21 joints, or give the headings"
            )
        self._skeleton, self._seen = skeleton, seen or {}
        self._samples = _sampled_poses(skeleton.names, tuple(skeleton.parents))
        self._pair, self._up = cache(self._make_pair), cache(self._make_up)
        self._accelerations: WeakKeyDictionary[SegmentMotion, dict[str, Array]] = WeakKeyDictionary()

    def tree(self, joints: Sequence[str]) -> list[tuple[str, str]]:
        """Return the pairs of segments to compare, the one nearer to the root first: a minimum spanning tree of
        distances in the skeleton.
        """
        distance = np.array([[self._apart(a, b) for b in joints] for a in joints], dtype=float)
        # Of equal distances the smaller indices, so that the tree does not depend on rounding.
        rows, columns = minimum_spanning_tree(np.triu(distance)).nonzero()
        pairs = [(joints[int(i)], joints[int(j)]) for i, j in zip(rows, columns, strict=True)]
        order = self._skeleton.names.index
        return [(a, b) if order(a) < order(b) else (b, a) for a, b in pairs]

    def single(self, motion: SegmentMotion) -> float:
        """Return the log-likelihood of one sensor: direction of up, and bones seen by a camera."""
        mean, precision = self._up(motion.joint)
        values = _student(motion.R_world_bone[:, 2, :] - mean, precision)
        if motion.joint in self._seen:
            own = kinematics.children_of(self._skeleton.parents, self._index(motion.joint))
            rest = so3.unit(self._skeleton.joint_offsets[own])
            expected = np.einsum("tij,cj->tci", motion.R_world_bone, rest)
            square = np.sum((expected - self._seen[motion.joint]) ** 2, axis=-1).mean(axis=1)
            values = values - _tail(square / np.radians(_SEEN_DEG) ** 2, 2)
        return _summed(values * _moving(motion.w_world), _POSTURE_MEMORY)

    def pair(self, a: SegmentMotion, b: SegmentMotion) -> float:
        """Return the log-likelihood of two sensors: posture, turning, joint centre."""
        prior = self._pair(a.joint, b.joint)
        R_a_b = np.swapaxes(a.R_world_bone, -1, -2) @ b.R_world_bone
        known = np.isfinite(R_a_b).all(axis=(-2, -1))
        weight = _moving(b.w_world - a.w_world)[known]
        values = self._posture(a.joint, b.joint, prior, R_a_b[known][::_EVERY])
        out = _EVERY * _summed(values * weight[::_EVERY], _POSTURE_MEMORY)
        out = (out + _turning(prior, a, b)) / self._apart(a.joint, b.joint)
        return out + self._joint_centre(a, b) if self._neighbours(a.joint, b.joint) else out

    def _posture(self, a: str, b: str, prior: _Pair, R_a_b: Array) -> Array:
        """Return (T,) log densities of relative orientations (T, 3, 3)."""
        values = _student(so3.log(prior.R_mean.T @ R_a_b), prior.precision)
        if self._neighbours(a, b):
            joint = self._skeleton.table.joints[self._index(b)]
            low, high = joint.limits.T
            angles = so3.matrix_to_euler(joint.axes, R_a_b)
            angles = so3.euler_near(angles, np.broadcast_to((low + high) / 2, angles.shape))
            excess = np.maximum(np.maximum(low - angles, angles - high), 0.0)
            values -= _tail(np.sum(excess**2, axis=-1) / np.radians(_LIMIT_DEG) ** 2, 1)
        return values

    def _joint_centre(self, a: SegmentMotion, b: SegmentMotion) -> float:
        at_a, at_b = self._acceleration(a, b.joint), self._acceleration(b, b.joint)
        known = np.isfinite(at_a).all(axis=-1) & np.isfinite(at_b).all(axis=-1)
        if not known.any():
            return 0.0
        at_a, at_b = at_a[known], at_b[known]
        variance = _ACCELERATION**2 + _ACCELERATION_SHARE**2 * np.mean(at_b**2)
        typical = variance + np.mean(at_b**2)
        together = _tail(np.sum((at_a - at_b) ** 2, axis=-1) / variance, 3)
        apart = _tail(np.sum(at_b**2, axis=-1) / typical, 3)
        gain = 1.5 * np.log(typical / variance) + apart - together
        signal = np.sum(at_a**2 + at_b**2, axis=-1) / (6 * _ACCELERATION**2)
        return _summed(gain * signal / (1 + signal), _ACCELERATION_MEMORY) * _EVERY

    def _acceleration(self, motion: SegmentMotion, joint: str) -> Array:
        """Return (T / _EVERY, 3), m/s^2, of a joint at one end of the sensor's segment, smoothed: the sensor's own plus
        the second central difference of the arm to the joint, which averages as `BoneImuSequence.resample` does. NaN
        near gaps.
        """
        known = self._accelerations.setdefault(motion, {})
        if joint not in known:
            at = 0.0 if joint == motion.joint else self._skeleton.joint_offsets[self._index(joint)]
            arm = motion.R_world_bone @ (at - motion.p_bone_sensor)
            a = motion.a_world[1:-1] + np.diff(arm, n=2, axis=0) * RATE_HZ**2
            width = max(round(_SMOOTHING * RATE_HZ), 1)
            sums = [a[i : len(a) - width + 1 + i : 1][::_EVERY] for i in range(width)]
            known[joint] = np.sum(sums, axis=0) / width
        return known[joint]

    def _make_up(self, joint: str) -> tuple[Array, Array]:
        """Return mean (3,) and precision (3, 3) of the direction of up in a segment's axes."""
        up = self._samples[0][:, self._index(joint), 2, :]
        spread = np.cov(up.T) + _UP_SIGMA**2 * np.eye(3)
        return up.mean(axis=0), np.asarray(np.linalg.inv(spread))

    def _make_pair(self, a: str, b: str) -> _Pair:
        i, j = self._skeleton.index(a, b)
        now, soon = (np.swapaxes(R[:, i], -1, -2) @ R[:, j] for R in self._samples)
        R_mean = so3.nearest_rotation(now.mean(axis=0))
        off = so3.log(R_mean.T @ now)
        spread = off.T @ off / len(off)
        spread += 2 * np.radians(_MISALIGNMENT_DEG) ** 2 * np.eye(3)
        w_b = so3.log(np.swapaxes(now, -1, -2) @ soon)
        w_a = np.einsum("nij,nj->ni", now, w_b)
        return _Pair(R_mean, np.asarray(np.linalg.inv(spread)), _inverse_shape(w_a), _inverse_shape(w_b))

    def _apart(self, a: str, b: str) -> int:
        """Return the number of joints between two segments; the correlation time is proportional to it."""
        parents = self._skeleton.parents
        lines = (kinematics.line_to_root(parents, j) for j in self._skeleton.index(a, b))
        return len(set.symmetric_difference(*map(set, lines)))

    def _index(self, joint: str) -> int:
        return self._skeleton.names.index(joint)

    def _neighbours(self, a: str, b: str) -> bool:
        return self._skeleton.parents[self._index(b)] == self._index(a)


def _moving(w: Array) -> Array:
    """Return (T,) weights, 0 to 1, by angular velocity (T, 3)."""
    return np.asarray(np.minimum(np.linalg.norm(w, axis=-1) / _LEAST_TURNING, 1.0))


def _turning(prior: _Pair, a: SegmentMotion, b: SegmentMotion) -> float:
    w = (b.w_world - a.w_world)[::_EVERY]
    enough = np.linalg.norm(w, axis=-1) > _LEAST_TURNING
    direction = so3.unit(w[enough])
    out = 0.0
    for shape, motion in ((prior.turning_a, a), (prior.turning_b, b)):
        own = np.einsum("tji,tj->ti", motion.R_world_bone[::_EVERY][enough], direction)
        out -= np.sum(np.log(np.einsum("ti,ij,tj->t", own, shape, own)))
    # Half of each, as the two are nearly the same information.
    return float(1.5 * out / 2 * _EVERY / (RATE_HZ * _TURNING_MEMORY))


def _inverse_shape(w: Array) -> Array:
    """Return the inverse matrix, of determinant 1, of an angular central Gaussian of velocities (N, 3)."""
    shape = w.T @ w
    shape = shape / np.trace(shape) + _TURNING_FLOOR * np.eye(3)
    return np.asarray(np.linalg.inv(shape / np.cbrt(np.linalg.det(shape))))


def _student(off: Array, precision: Array) -> Array:
    """Return (T,) log densities of a t distribution at deviations (T, d)."""
    d, nu = off.shape[-1], _FREEDOM
    square = np.einsum("ti,ij,tj->t", off, precision, off)
    constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
    constant += np.linalg.slogdet(precision)[1] / 2
    return np.asarray(constant - _tail(square, d))


def _tail(square: Array, d: int) -> Array:
    """Return minus the log of a t density, without its constant, at squared deviations (T,) in d axes."""
    return np.asarray((_FREEDOM + d) / 2 * np.log1p(square / _FREEDOM))


def _summed(values: Array, memory: float) -> float:
    return float(np.nansum(values) / (RATE_HZ * memory))


@cache
def _sampled_poses(names: tuple[str, ...], parents: tuple[int, ...], count: int = 4000) -> tuple[Array, Array]:
    """Return R_world_bone (N, J, 3, 3) of poses of upright people with heading 0, and a moment later, in which every
    joint moves by a hundredth of another draw from their prior; that of the solver, with people who lie, tells less.
    """
    prior = PosePrior.load(names, model_path("upright_prior.npz"))
    rng = np.random.default_rng(0)
    size = len(prior.covariance)
    root = np.linalg.cholesky(prior.covariance + 1e-9 * np.eye(size))
    pose, velocity = rng.standard_normal((2, count, size)) @ root.T
    tilt = rng.standard_normal((count, 1, 3)) * np.radians(_TILT_DEG) * np.array([1.0, 1.0, 0.0])
    out = []
    for off in (pose, pose + 0.01 * velocity):
        local = so3.from_quat_wxyz(prior.mean_quat_wxyz) @ so3.exp(off.reshape(count, -1, 3))
        R = kinematics.world_rotations(parents, np.concatenate([so3.exp(tilt), local], axis=1))
        out.append(readonly("sampled poses", R, (count, len(names), 3, 3)))
    return out[0], out[1]


Score = Callable[[float], float]
_GRID = 18  # headings of the grid: every 20 degrees
_BELIEF = 0.2  # [-] weight of the log-likelihood in standard deviations, as errors of pose are common to all
_REFINEMENTS = np.radians([5.0, 1.5, 0.5])


@dataclass(frozen=True)
class Headings:
    """Headings of sensors and their uncertainty."""

    angles: Array  # (S,) rad about z, to be added to those of the motions
    sigmas: Array  # (S,) rad, standard deviation of each with the others fixed; up to 1.8 (uniform)
    margin: float  # Log-likelihood ratio, nats, to the best heading more than 45 degrees away


def own_headings(likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """Estimate a heading for each of S sensors calibrated in a pose, R_world_bone (S, 3, 3) of their segments, with
    headings 0.

    In the pose, at time 0, they are right for any heading h of their reference::

        R_world_bone(t; h) = Rz(h) R_inertial_sensor(t) R_inertial_sensor(0)^T Rz(-h) R_pose.

    h changes the axis in the body about which the segment rotates afterwards; an axis that is vertical in the pose does
    not determine it. The likelihood is maximised exactly on a grid of headings over the tree of compared pairs
    (max-product, Pearl 1988), then refined.
    """
    turned = _Turned(likelihood, motions, R_pose)
    angles = turned.best_on_grid()
    for step in _REFINEMENTS:
        for s in range(len(angles)):
            angles[s] = _refined(turned.along(angles, s), float(angles[s]), step)
    sigmas, margins = zip(*(_spread(turned.along(angles, s)) for s in range(len(motions))), strict=True)
    return Headings(wrapped(angles), np.array(sigmas), float(min(margins)))


def shared_heading(likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """Estimate one heading for all sensors, as `own_headings` does for each."""
    score, everyone = _Turned(likelihood, motions, R_pose).total, np.ones(len(motions))
    sigma, margin = _spread(score)
    best = float(_grid(_GRID)[int(np.argmax([score(h) for h in _grid(_GRID)]))])
    for step in _REFINEMENTS:
        best = _refined(score, best, step)
    return Headings(wrapped(best * everyone), sigma * everyone, margin)


def wrapped(angles: ArrayLike) -> Array:
    """Return angles, rad, in (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - np.asarray(angles, dtype=float)) % (2 * np.pi))


def _grid(count: int) -> Array:
    return np.asarray(2 * np.pi / count * np.arange(count), dtype=np.float64)


def _refined(score: Score, angle: float, step: float) -> float:
    around = angle + step * np.arange(-2, 3)
    return float(around[int(np.argmax([score(float(h)) for h in around]))])


def _spread(score: Score) -> tuple[float, float]:
    """Return the circular standard deviation of exp(score) and the margin over distant headings."""
    angles = _grid(2 * _GRID)
    values = np.array([score(h) for h in angles])
    best = int(np.argmax(values))
    weights = np.exp(_BELIEF * (values - values[best]))
    length = np.abs(np.sum(weights * np.exp(1j * angles))) / weights.sum()
    far = np.abs(wrapped(angles - angles[best])) > np.radians(45.0)
    sigma = np.sqrt(-2 * np.log(np.clip(length, 0.2, 1.0)) + (np.pi / len(angles)) ** 2)
    return float(sigma), float(values[best] - values[far].max())


class _Turned:
    """Motions under other headings, and their log-likelihood."""

    def __init__(self, likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> None:
        self._likelihood, self._motions, self._R_pose = likelihood, list(motions), R_pose
        joints = [motion.joint for motion in motions]
        self._pairs = [(joints.index(a), joints.index(b)) for a, b in likelihood.tree(joints)]

    def _motion(self, s: int, angle: float) -> SegmentMotion:
        turn, own, R = so3.about_axis("z", angle), self._motions[s], self._R_pose[s]
        return own.turned(turn).moved(own.joint, R.T @ turn.T @ R, own.p_bone_sensor)

    def total(self, angle: float) -> float:
        """Return the log-likelihood of one heading for all sensors."""
        motions = [self._motion(s, angle) for s in range(len(self._motions))]
        out = sum(self._likelihood.pair(motions[a], motions[b]) for a, b in self._pairs)
        return float(out + sum(self._likelihood.single(motion) for motion in motions))

    def along(self, angles: Array, s: int) -> Score:
        """Return the terms of sensor s as a function of its heading, the others fixed."""
        near = [pair for pair in self._pairs if s in pair]
        others = {i: self._motion(i, float(angles[i])) for pair in near for i in pair}

        def score(angle: float) -> float:
            own = {**others, s: self._motion(s, angle)}
            pairs = sum(self._likelihood.pair(own[a], own[b]) for a, b in near)
            return self._likelihood.single(own[s]) + pairs

        return score

    def best_on_grid(self) -> Array:
        """Return the best set of headings (S,) on the grid, by messages up the tree."""
        grid, S, pair = _grid(_GRID), len(self._motions), self._likelihood.pair
        motions = [[self._motion(s, float(h)) for h in grid] for s in range(S)]
        belief = np.array([[self._likelihood.single(motion) for motion in own] for own in motions])
        tables = {(a, b): np.array([[pair(x, y) for y in motions[b]] for x in motions[a]]) for a, b in self._pairs}
        tables |= {(b, a): table.T for (a, b), table in tables.items()}
        graph = np.zeros((S, S))
        for edge in tables:
            graph[edge] = 1.0
        nodes, parents = breadth_first_order(graph, 0)
        choices = {}
        for child in nodes[:0:-1]:
            message = tables[int(parents[child]), int(child)] + belief[child]
            choices[child] = message.argmax(axis=1)
            belief[parents[child]] += message.max(axis=1)
        best = np.zeros(S, dtype=np.intp)
        best[0] = int(belief[0].argmax())
        for child in nodes[1:]:
            best[child] = choices[child][best[parents[child]]]
        return np.asarray(grid[best])
