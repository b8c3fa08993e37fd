"""`BodyDynamics`: inverse dynamics of one frame, its derivatives, and what the wrench from outside is about.

``tau = M(q) a + h(q, v)`` (Pinocchio's recursive Newton-Euler). The first six rows are the wrench that the motion
needs from outside. A foot that bears it all, and nothing else, turns them to zero and changes the torques of its leg.
The wrench is given in world axes about a reference under the feet: the middle between heel and toe of the foot that
bears the load, else the mean of those of both feet.

A `Confidence` has the covariance C of the errors in each frame. How fast an error changes is not in it, and that
decides about accelerations: a bias of 10 degrees has none, a ripple of 1 degree at 3 Hz 6 rad/s^2. So every error is a
stationary process with the autocovariance ::

    C [(1 - s) + s exp(-t^2 / (2 l^2))]

that is a constant part and a smooth fast one with a share s of the variance and a correlation time l (`ErrorSpectrum`).
``python -m benchmarks dynamics --corpus DIR --fit`` fits both to the errors of torques and of the wrench of the
validation people; the force is weighted to be stated too large rather than too small, and l is held near 0.12 s. The
turn of each segment in world is a linear function of its parent's and an independent rest, both from the stated
covariances of the parent, the child, and the one in the other: of all joint distributions with these covariances this
one assumes least (maximum entropy). The position of the root is independent of the turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from scipy.linalg import toeplitz

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import mass_fraction
from rtof_kin.body.urdf import pin
from rtof_kin.clinical.angle_table import SIDES, angle_table
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import WORLD, Confidence

UNKNOWN: Final = -1  #: Neither foot is known to bear all load
MASS_SIGMA: Final = 0.1  #: Standard deviation of the mass of a segment, relative to it, with body mass known


@dataclass(frozen=True)
class FrameDynamics:
    """Inverse dynamics of one frame."""

    tau: Array  #: (nv,) N m, with the foot's wrench if one foot bears all
    root_wrench: Array  #: (6,) from outside: force, N, and moment about the root, N m, world axes
    left: Array  #: (6,) the part of it that no foot bears
    wrench: Array  #: (6,) as `root_wrench`, the moment about the reference
    reference: Array  #: (3,) m, world


@dataclass(frozen=True)
class FrameDerivatives:
    """How torques and the wrench of a frame change, to first order. Rows: nv - 6 torques, then the wrench
    (6,) about the reference; columns: as the rows of `PoseErrors.factors`.
    """

    value: Array  #: (nv, nv) by an error
    velocity: Array  #: (nv, nv) by its first derivative
    acceleration: Array  #: (nv, nv) by its second derivative
    masses: Array  #: (nv, G) by relative changes of the masses of `BodyDynamics.segments`, body mass unchanged


class BodyDynamics:
    """Inverse dynamics of a body.

    Attributes:
        skeleton: with the subject's mass. segments: G of de Leva's segments; right and left are one.
    """

    def __init__(self, skeleton: SkeletonModel):
        """Prepare a body with the subject's mass."""
        self.skeleton = skeleton
        self._model, self._data = skeleton.model, skeleton.model.createData()
        self._root = self._model.getJointId("root_joint")
        table = angle_table(skeleton.table)
        feet = [skeleton.table.joints[skeleton.names.index(table.segments[f"{side} foot"])] for side in SIDES]
        # the last of the three revolutes of a joint carries its link; between heel and toe in that link's frame, m
        self._feet = [int(skeleton.model.getJointId(joint.dofs[-1].urdf)) for joint in feet]
        ends = [[table.segments[f"{side} {word}"] for word in ("heel", "toe")] for side in SIDES]
        self._soles = [np.mean([skeleton.landmarks[end][1] for end in pair], axis=0) for pair in ends]
        self.segments, self._shares = _segment_shares(skeleton)

    def at(self, q: Array, v: Array, a: Array, carries: int) -> FrameDynamics:
        """Return torques and wrench; q, v, a: (nq,), (nv,), (nv,); carries: the foot that bears all load, by `SIDES`,
        or `UNKNOWN`.
        """
        model, data = self._model, self._data
        pin.forwardKinematics(model, data, q)  # rnea does not compute joint placements in world
        tau = pin.rnea(model, data, q, v, a)
        to_world = pin.SE3(data.oMi[self._root].rotation, np.zeros(3))
        root_wrench = left = to_world.act(pin.Force(tau[:6])).vector
        lever = data.oMi[self._root].translation - (reference := self._reference(carries))
        wrench = root_wrench.copy()
        wrench[3:] += np.cross(lever, wrench[:3])
        if carries != UNKNOWN:
            tau = pin.rnea(model, data, q, v, a, self._outside(tau[:6], carries))
            left = to_world.act(pin.Force(tau[:6])).vector
        return FrameDynamics(tau, root_wrench, left, wrench, reference)

    def derivatives(self, q: Array, v: Array, a: Array, carries: int) -> FrameDerivatives:
        """Return the derivatives of torques and wrench.

        An error of the pose moves the root's frame, in which v and a are given: ``dv = e' + [v, e]`` and
        ``da = e'' + [v, e'] + [a, e]`` for an error e and the Lie bracket of its first six components.
        Torques and wrench do not change where the whole body is moved, or moves evenly.

        Args:
            q, v, a, carries: see `at`.
        """
        model, data = self._model, self._data
        by_motion = _by_errors(pin.computeRNEADerivatives(model, data, q, v, a), v, a)
        tau = data.tau.copy()
        pin.computeJointJacobians(model, data, q)
        R = data.oMi[self._root].rotation.copy()
        wrench = self._wrench_rows(by_motion, tau[:6], carries)
        lever = data.oMi[self._root].translation - self._reference(carries)
        masses = self._by_masses(q, v, a)
        turned = np.stack([R @ masses[:3], R @ masses[3:6]]).reshape(6, -1)
        turned[3:] += so3.skew(lever) @ turned[:3]
        if carries != UNKNOWN:
            outside = self._outside(tau[:6], carries)
            by_motion = _by_errors(pin.computeRNEADerivatives(model, data, q, v, a, outside), v, a)
            pin.computeJointJacobians(model, data, q)
            J = pin.getJointJacobian(model, data, self._feet[carries], pin.LOCAL)
            by_foot = np.linalg.solve(J[:, :6].T, np.eye(6))  # the wrench on the foot that is the root's
            by_motion = [S - J.T @ (by_foot @ S[:6]) for S in by_motion]
            masses = masses - J.T @ (by_foot @ masses[:6])
        value, velocity, acceleration = (np.concatenate([S[6:], W]) for S, W in zip(by_motion, wrench, strict=True))
        value[:, :3] = velocity[:, :3] = 0.0
        acceleration[:, :3] = acceleration[:, :3] @ R.T
        return FrameDerivatives(value, velocity, acceleration, np.concatenate([masses[6:], turned]))

    def _wrench_rows(self, by_motion: list[Array], force: Array, carries: int) -> list[Array]:
        """Rows of the wrench in world axes about the reference, of the force (6,) on the root in its axes."""
        data = self._data
        R, p = data.oMi[self._root].rotation, data.oMi[self._root].translation
        out = []
        for S in by_motion:
            rows = np.concatenate([R @ S[:3], R @ S[3:6]])
            rows[3:] += so3.skew(p - self._reference(carries)) @ rows[:3]
            out.append(rows)
        nv = self._model.nv
        turns = np.zeros((3, nv))
        turns[:, 3:6] = np.eye(3)
        out[0][:3] -= R @ so3.skew(force[:3]) @ turns
        out[0][3:] -= R @ so3.skew(force[3:]) @ turns
        out[0][3:] -= so3.skew(p - self._reference(carries)) @ R @ so3.skew(force[:3]) @ turns
        moved = np.zeros((3, nv))  # the root from the reference
        moved[:, :3] = R
        moved -= self._reference_rates(carries)
        out[0][3:] -= so3.skew(R @ force[:3]) @ moved
        return out

    def _outside(self, force: Array, carries: int) -> list[Any]:
        """Pinocchio's external forces: a wrench (6,) on the root, in its axes, that acts on a foot."""
        data, foot = self._data, self._feet[carries]
        outside = [pin.Force.Zero() for _ in range(self._model.njoints)]
        outside[foot] = data.oMi[foot].actInv(data.oMi[self._root].act(pin.Force(force)))
        return outside

    def _feet_of(self, carries: int) -> list[tuple[int, Array, float]]:
        """Joint, offset (3,) and weight of the points whose mean is the reference."""
        sides = range(len(SIDES)) if carries == UNKNOWN else (carries,)
        return [(self._feet[side], self._soles[side], 1 / len(sides)) for side in sides]

    def _reference(self, carries: int) -> Array:
        points = self._feet_of(carries)
        return np.asarray(sum(weight * self._data.oMi[foot].act(at) for foot, at, weight in points))

    def _reference_rates(self, carries: int) -> Array:
        """(3, nv) derivatives of the reference."""
        total = np.zeros((3, self._model.nv))
        for foot, at, weight in self._feet_of(carries):
            J = pin.getJointJacobian(self._model, self._data, foot, pin.LOCAL)
            total += weight * self._data.oMi[foot].rotation @ (J[:3] - so3.skew(at) @ J[3:])
        return total

    def _by_masses(self, q: Array, v: Array, a: Array) -> Array:
        """(nv, G) derivatives of tau by relative changes of masses, of which the mean change is removed."""
        regressor = pin.computeJointTorqueRegressor(self._model, self._data, q, v, a)
        links = regressor.reshape(len(regressor), -1, 10)
        own = np.array([I.toDynamicParameters() for I in list(self._model.inertias)[1:]])
        by_link = np.einsum("vlp,lp->vl", links, own)
        by_segment = by_link @ self._shares
        masses = np.array([I.mass for I in list(self._model.inertias)[1:]]) @ self._shares
        return np.asarray(by_segment - by_segment.sum(axis=1, keepdims=True) * masses / masses.sum())


def _by_errors(derivatives: tuple[Array, Array, Array], v: Array, a: Array) -> list[Array]:
    """Derivatives by an error and its first two derivatives, of those by q, v and a."""
    by_q, by_v, by_a = derivatives
    nv = len(v)
    v_bracket, a_bracket = np.zeros((2, nv, nv))
    v_bracket[:6, :6], a_bracket[:6, :6] = _bracket(v[:6]), _bracket(a[:6])
    return [by_q + by_v @ v_bracket + by_a @ a_bracket, by_v + by_a @ v_bracket, np.array(by_a)]


def _bracket(twist: Array) -> Array:
    """(6, 6) matrix of the Lie bracket with a twist, linear before angular."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = so3.skew(twist[3:])
    out[:3, 3:] = so3.skew(twist[:3])
    return out


def _segment_shares(skeleton: SkeletonModel) -> tuple[tuple[str, ...], Array]:
    """De Leva's segments, and how much of the inertia of each of Pinocchio's links is of which (L, G)."""
    table = skeleton.table
    found = dict.fromkeys(name for joint in table.joints for name, _ in joint.mass_shares)
    shares = np.zeros((skeleton.model.njoints - 1, len(found)))
    for joint in table.joints:
        last = joint.dofs[-1].urdf if joint.dofs else "root_joint"
        masses = {name: share * mass_fraction(name, table.sex) for name, share in joint.mass_shares}
        for name, mass in masses.items():
            row = skeleton.model.getJointId(last) - 1
            shares[row, list(found).index(name)] += mass / sum(masses.values())
    return tuple(found), shares


@dataclass(frozen=True)
class ErrorSpectrum:
    """How fast errors change."""

    share: float  #: s, of the variance that is not constant
    seconds: float  #: l, standard deviation of the Gaussian autocorrelation, s


SPECTRA: Final = {
    "position": ErrorSpectrum(0.13, 0.16),
    "trunk": ErrorSpectrum(0.23, 0.14),
    "arm": ErrorSpectrum(0.91, 0.13),
    "hand": ErrorSpectrum(1, 0.047),
    "leg": ErrorSpectrum(1, 0.13),
    "foot": ErrorSpectrum(1, 0.098),
}
"""Of the root's position and of the turns of segments, by group."""
GROUPS: Final = {"upper arm": "arm", "forearm": "arm", "hand": "hand", "thigh": "leg", "shank": "leg", "foot": "foot"}
"""De Leva's segment -> group; all others are the trunk."""
UNOBSERVED: Final = 0.35
"""[rad] standard deviation of a joint without a covariance: the segment is kept in line with its parent."""
_SINGULAR: Final = 0.09
"""Smallest singular value of the axes of three revolutes, a posture within 5 degrees of a singular one."""
_IMPULSE: Final = 2.0  #: [s] on either side of an impulse in which the filter's response is computed
_CLOSEST: Final = 0.999  #: Largest correlation of the turns of a segment and its parent


@dataclass(frozen=True)
class PoseErrors:
    """Factors of the covariances of errors of the configuration, by independent causes."""

    factors: Array
    """(K, nv, n): root position in world, m; root turn in its own axes, rad; revolutes, rad."""
    groups: tuple[str, ...]
    """(n,) group in `SPECTRA` of each cause."""

    def gains(self, rate_hz: float) -> Array:
        """Return `error_gains` (n, 4) of the causes; rate_hz: of the motion, Hz."""
        by_group = {group: error_gains(rate_hz, SPECTRA[group]) for group in set(self.groups)}
        return np.array([by_group[group] for group in self.groups])


@lru_cache(maxsize=64)
def error_gains(rate_hz: float, spectrum: ErrorSpectrum) -> Array:
    """Return what becomes of an error of unit variance that is filtered and differentiated as a motion is.

    Args:
        rate_hz: of the motion, Hz.

    Returns:
        (4,) variances of the error, 1, of its first derivative, 1/s^2, and of its second, 1/s^4, and the
        covariance of the error and its second derivative, 1/s^2. The first derivative is uncorrelated with
        both, as in every stationary process.
    """
    half = int(np.ceil(_IMPULSE * rate_hz))
    times = np.arange(-half, half + 1) / rate_hz
    impulse = (np.arange(len(times)) == half).astype(float)
    value = smoothed(impulse, rate_hz, CUTOFF_HZ)
    velocity = np.gradient(value, times)
    responses = np.stack([value, velocity, np.gradient(velocity, times)])
    fast = toeplitz(np.exp(-0.5 * ((times - times[0]) / spectrum.seconds) ** 2))
    products = responses @ fast @ responses.T * spectrum.share
    return np.array([products[0, 0] + 1 - spectrum.share, products[1, 1], products[2, 2], products[0, 2]])


def pose_errors(skeleton: SkeletonModel, q: Array, confidence: Confidence, R: Array) -> PoseErrors:
    """Return the errors of some frames of a motion; NaN where the root has no covariance; q: (K, nq); R: (K, J, 3, 3)
    R_world_bone.
    """
    names, parents = skeleton.names, skeleton.parents
    K, n = len(q), 3 * (len(names) + 1)
    turns: Array = np.zeros((K, len(names), 3, n))  # of each segment in world, in its own axes
    factors: Array = np.zeros((K, skeleton.nv, n))
    factors[:, :3, :3] = _root_of(confidence.position_covariance[:, 0])
    for j, name in enumerate(names):
        own, parent = slice(3 * j + 3, 3 * j + 6), parents[j]
        in_world = confidence.turn(WORLD, name)
        if parent < 0:
            turns[:, j, :, own] = factors[:, 3:6, own] = _root_of(in_world)
            continue
        R_child_parent = np.swapaxes(R[:, j], -1, -2) @ R[:, parent]
        parents_turn = R_child_parent @ turns[:, parent]
        above = R_child_parent @ confidence.turn(WORLD, names[parent]) @ np.swapaxes(R_child_parent, -1, -2)
        follows, rest = _given_parent(in_world, above, confidence.turn(names[parent], name))
        turns[:, j] = follows @ parents_turn
        turns[:, j, :, own] += rest
        rows = 6 + np.array([skeleton.dof_names.index(dof.urdf) for dof in skeleton.table.joints[j].dofs])
        factors[:, rows] = _revolutes(skeleton, j, q) @ (turns[:, j] - parents_turn)
    segments = [max(joint.mass_shares, key=lambda share: share[1])[0] for joint in skeleton.table.joints]
    groups = ["position", *(GROUPS.get(segment, "trunk") for segment in segments)]
    return PoseErrors(factors, tuple(group for group in groups for _ in range(3)))


def _given_parent(child: Array, parent: Array, relative: Array) -> tuple[Array, Array]:
    """Regression (K, 3, 3) of a segment's turn on its parent's, and the root of the rest's covariance.

    All covariances (K, 3, 3) in the child's axes. Where one is unknown the child follows its parent.
    """
    follows = np.tile(np.eye(3), (len(child), 1, 1))
    known: Mask = np.asarray(np.isfinite(relative).all(axis=(1, 2)))
    rest = _root_of(np.where(known[:, None, None], relative, UNOBSERVED**2 * np.eye(3)))
    known &= np.isfinite(child + parent).all(axis=(1, 2))
    if known.any():
        root, above = _root_of(child[known]), _root_of(parent[known])
        cross = (child[known] + parent[known] - relative[known]) / 2
        U, s, Vt = np.linalg.svd(np.linalg.solve(root, np.swapaxes(np.linalg.solve(above, cross), -1, -2)))
        s = np.minimum(s, _CLOSEST)
        correlation = (U * s[:, None]) @ Vt
        follows[known] = root @ correlation @ np.linalg.inv(above)
        rest[known] = root @ (U * np.sqrt(1 - s**2)[:, None])
    return follows, rest


def _root_of(covariance: Array) -> Array:
    """Symmetric square roots of covariances (K, 3, 3), with no eigenvalue of zero; NaN where they are NaN."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    out = np.full_like(covariance, np.nan)
    values, axes = np.linalg.eigh(covariance[known])
    least = np.maximum(1e-6 * values[:, -1:], 1e-12)
    out[known] = (axes * np.sqrt(np.maximum(values, least))[:, None]) @ np.swapaxes(axes, -1, -2)
    return out


def _revolutes(skeleton: SkeletonModel, j: int, q: Array) -> Array:
    """(K, 3, 3) changes of a joint's three revolutes by a rotation vector in the child's axes.

    In a singular posture one combination of them does not turn the joint: it has no error.
    """
    joint = skeleton.table.joints[j]
    angles = q[:, [7 + skeleton.dof_names.index(dof.urdf) for dof in joint.dofs]]
    R_after, columns = np.tile(np.eye(3), (len(q), 1, 1)), []
    for axis, angle in zip(reversed(joint.axes), angles.T[::-1], strict=True):
        unit = np.eye(3)["xyz".index(axis)]
        columns.append(np.swapaxes(R_after, -1, -2) @ unit)
        R_after = so3.exp(angle[:, None] * unit) @ R_after
    turned = np.stack(columns[::-1], axis=-1)
    return np.asarray(np.linalg.pinv(turned, rcond=_SINGULAR))
