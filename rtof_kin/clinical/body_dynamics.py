"""`BodyDynamics`: inverse dynamics of one frame, its derivatives, and what the wrench from outside is about.

``tau = M(q) a + h(q, v)`` (Pinocchio's recursive Newton-Euler). The first six rows are the wrench that the motion
needs from outside. A foot that bears it all, and nothing else, turns them to zero and changes the torques of its leg.

The wrench is given in world axes about a reference under the feet: the middle between heel and toe of the
foot that bears the load, else the mean of those of both feet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rtof_kin.body.body_mass import mass_fraction
from rtof_kin.body.rigid_bodies import pin
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, AngleTable, angle_table
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

UNKNOWN: Final = -1
"""Neither foot is known to bear all load."""
MASS_SIGMA: Final = 0.1
"""Standard deviation of the mass of a segment, relative to it, with body mass known."""


@dataclass(frozen=True)
class FrameDynamics:
    """Inverse dynamics of one frame."""

    tau: Array
    """(nv,) N m, with the foot's wrench if one foot bears all."""
    root_wrench: Array
    """(6,) from outside: force, N, and moment about the root, N m, world axes."""
    left: Array
    """(6,) the part of it that no foot bears."""
    wrench: Array
    """(6,) as `root_wrench`, the moment about the reference."""
    reference: Array
    """(3,) m, world."""


@dataclass(frozen=True)
class FrameDerivatives:
    """How torques and the wrench of a frame change, to first order. Rows: nv - 6 torques, then the wrench
    (6,) about the reference; columns: as the rows of `PoseErrors.factors`.
    """

    value: Array
    """(nv, nv) by an error."""
    velocity: Array
    """(nv, nv) by its first derivative."""
    acceleration: Array
    """(nv, nv) by its second derivative."""
    masses: Array
    """(nv, G) by relative changes of the masses of `BodyDynamics.segments`, body mass unchanged."""


class BodyDynamics:
    """Inverse dynamics of a body.

    Attributes:
        skeleton: with the subject's mass. segments: G of de Leva's segments; right and left are one.
    """

    def __init__(self, skeleton: SkeletonModel):
        """Prepare the body.

        Args:
            skeleton: with the subject's mass.
        """
        self.skeleton = skeleton
        self._model, self._data = skeleton.model, skeleton.model.createData()
        self._root = self._model.getJointId("root_joint")
        table = angle_table(skeleton.table)
        self._feet = [_link_joint(skeleton, table.segments[f"{side} foot"]) for side in SIDES]
        self._soles = [sole_middle(skeleton, table, side) for side in SIDES]
        self.segments, self._shares = _segment_shares(skeleton)

    def at(self, q: Array, v: Array, a: Array, carries: int) -> FrameDynamics:
        """Return torques and wrench.

        Args:
            q, v, a: (nq,), (nv,), (nv,). carries: the foot that bears all load, by `SIDES`, or `UNKNOWN`.
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


def sole_middle(skeleton: SkeletonModel, table: AngleTable, side: str) -> Array:
    """Return the middle (3,) between heel and toe in the foot's link frame, m.

    Args:
        side: of `SIDES`.
    """
    points = [skeleton.landmarks[table.segments[f"{side} {word}"]][1] for word in ("heel", "toe")]
    return np.asarray(np.mean(points, axis=0))


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


def _link_joint(skeleton: SkeletonModel, name: str) -> int:
    """Pinocchio's index of the last of the three revolutes of a joint, which carries its link."""
    joint = skeleton.table.joints[skeleton.names.index(name)]
    return int(skeleton.model.getJointId(joint.dofs[-1].urdf))


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
