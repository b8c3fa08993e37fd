"""State of the joint-space solver: the root's position and a quaternion for every moving joint.

A step is a tangent vector: the root's displacement in world (m) and, for each joint, a rotation vector in
its own frame (rad; one number for a hinge). No posture is singular.

Anatomical limits of knees and elbows: the flexion of every hinge, between the URDF's bounds. Ball joints are not
limited. Bounds on their three Euler angles are not anatomical: they couple through the sequence, jump where it is
singular, and people exceed them. A solver that keeps them turns the pelvis to hold a measured thigh within them
(`benchmarks/results/limits.md`). Ball joints have the pose prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import InvalidInputError

XYZ: Final = "xyz"


class StateSpace:
    """Moving joints of a skeleton, and conversion between states and poses.

    A state x (T, 3 + 4A) is the root's position and A quaternions w x y z; a tangent d is (T, D).

    Attributes:
        joints: indices of the A joints that move, root first. names: their names.
        hinge_axis: (A,) index of a hinge's axis, -1 for a ball joint.
        expand: (3A, D - 3) from tangents to rotation vectors of all joints.
        first: (A,) first tangent coordinate of each joint's rotation.
    """

    def __init__(self, skeleton: SkeletonModel, moving: Sequence[str], hinged: bool) -> None:
        """Collect the moving joints.

        Args:
            moving: names of joints that turn; the root always does.
            hinged: whether knees and elbows turn about one axis only.
        """
        self.skeleton = skeleton
        self.joints = [j for j, name in enumerate(skeleton.names) if name in moving or j == 0]
        self.names = tuple(skeleton.names[j] for j in self.joints)
        self.hinge_axis = np.full(len(self.joints), -1)
        if hinged:
            for j in set(hinges(skeleton)) & set(self.joints):
                joint = skeleton.table.joints[j]
                flexion = next(i for i, d in enumerate(joint.dofs) if d.clinical.endswith("flexion"))
                self.hinge_axis[self.joints.index(j)] = XYZ.index(joint.axes[flexion])
        kept = [3 * a + c for a, axis in enumerate(self.hinge_axis) for c in (range(3) if axis < 0 else (axis,))]
        self.expand = np.eye(3 * len(self.joints))[:, kept]
        self.size = 3 + len(kept)
        self._widths = np.where(self.hinge_axis < 0, 3, 1)
        self.first = 3 + np.cumsum(self._widths) - self._widths

    def axes(self, a: int) -> Array:
        """Return the axes (3, 1 or 3) of the a-th moving joint, in its own frame."""
        axis = int(self.hinge_axis[a])
        return np.eye(3) if axis < 0 else np.eye(3)[:, [axis]]

    def columns(self, joint: int) -> slice:
        """Return the tangent coordinates of a moving joint; the root's include its position."""
        a = self.joints.index(joint)
        first = int(self.first[a])
        return slice(0 if joint == 0 else first, first + (3 if self.hinge_axis[a] < 0 else 1))

    def from_poses(self, p_root: Array, R_world_bone: Array) -> Array:
        """Return the states (T, 3 + 4A) of poses, without rotations of fixed joints or off a hinge's axis.

        A hinge gets the angle of its bone in the plane of the hinge: the shank's own twist, which a lifter
        may have wrong by half a turn, says nothing of flexion.

        Args:
            p_root: (T, 3) m. R_world_bone: (T, J, 3, 3).
        """
        local = kinematics.local_rotations(self.skeleton.parents, R_world_bone)[:, self.joints]
        q = so3.to_quat_wxyz(local)
        for a in np.flatnonzero(self.hinge_axis >= 0):
            axis, child = self.hinge_axis[a], kinematics.children_of(self.skeleton.parents, self.joints[a])[0]
            across = [(axis + 1) % 3, (axis + 2) % 3]
            rest = self.skeleton.joint_offsets[child]
            bent = (local[:, a] @ rest)[:, across]
            half = (np.arctan2(bent[:, 1], bent[:, 0]) - np.arctan2(*rest[across[::-1]])) / 2
            q[:, a] = 0.0
            q[:, a, 0], q[:, a, 1 + axis] = np.cos(half), np.sin(half)
        return np.concatenate([p_root, q.reshape(len(q), -1)], axis=1)

    def rotations(self, x: Array) -> Array:
        """Return the quaternions (T, A, 4), w x y z, of states."""
        return x[:, 3:].reshape(len(x), -1, 4)

    def retract(self, x: Array, d: Array) -> Array:
        """Return the states after tangent steps d (T, D)."""
        turn = quat.exp((d[:, 3:] @ self.expand.T).reshape(len(x), -1, 3))
        q = quat.multiply(self.rotations(x), turn)
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        return np.concatenate([x[:, :3] + d[:, :3], q.reshape(len(x), -1)], axis=1)

    def difference(self, x: Array, y: Array) -> Array:
        """Return the tangents (T, D) that lead from states x (T, 3 + 4A) to states y, m and rad."""
        turns = quat.log(quat.multiply(quat.conjugate(self.rotations(x)), self.rotations(y)))
        return np.concatenate([y[:, :3] - x[:, :3], turns.reshape(len(x), -1) @ self.expand], axis=1)

    def low_passed(self, x: Array, rate_hz: float, cutoff_hz: float) -> Array:
        """Return low-pass filtered states. x: (T, 3 + 4A). cutoff_hz: -3 dB frequency."""
        if len(x) < 4 or cutoff_hz >= rate_hz / 2:
            return x
        q = self.rotations(x)
        turned = np.sum(q[1:] * q[:-1], axis=-1) < 0  # the same rotation with the other sign
        sign = np.cumprod(np.where(turned, -1.0, 1.0), axis=0)
        q = np.concatenate([q[:1], q[1:] * sign[..., None]])
        q = signals.low_pass(q, rate_hz, cutoff_hz)
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        p = signals.low_pass(x[:, :3], rate_hz, cutoff_hz)
        return np.concatenate([p, q.reshape(len(x), -1)], axis=1)

    def blend(self, x: Array, y: Array, weight_x: Array, weight_y: Array) -> Array:
        """Return means (T, 3 + 4A) of two sequences of states weighted by (T,), rotations on the shorter arc."""
        q, r = self.rotations(x), self.rotations(y)
        r = np.where(np.sum(q * r, axis=-1, keepdims=True) < 0, -r, r)
        share = (weight_y / (weight_x + weight_y))[:, None]
        p = (1 - share) * x[:, :3] + share * y[:, :3]
        q = (1 - share[..., None]) * q + share[..., None] * r
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        return np.concatenate([p, q.reshape(len(x), -1)], axis=1)

    def carried_on(self, x: Array, frame: int, known: Array) -> Array:
        """Return states (T, 3 + 4A) moved and turned alike so that one frame becomes a known state (3 + 4A,)."""
        q, r = self.rotations(x), self.rotations(known[None])[0]
        turn = quat.multiply(quat.conjugate(q[frame]), r)
        moved = x[:, :3] + known[:3] - x[frame, :3]
        return np.concatenate([moved, quat.multiply(q, turn[None]).reshape(len(x), -1)], axis=1)

    def poses(self, x: Array) -> tuple[Array, Array]:
        """Return joint positions (T, J, 3), m, and segment orientations (T, J, 3, 3) of states."""
        skeleton = self.skeleton
        R = np.tile(np.eye(3), (len(x), len(skeleton.names), 1, 1))
        R[:, self.joints] = so3.from_quat_wxyz(self.rotations(x))
        R = kinematics.world_rotations(skeleton.parents, R)
        p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, x[:, :3], R)
        return p, R

    @cached_property
    def _turning(self) -> tuple[Index, Array, Mask]:
        """Joint and axis (3, D - 3) in its frame of each rotation coordinate; segments (J, D - 3) turned."""
        owners = np.repeat(self.joints, self._widths)
        axes = np.concatenate([self.axes(a) for a in range(len(self.joints))], axis=1)
        beyond = np.eye(len(self.skeleton.parents), dtype=bool)
        for j, parent in enumerate(self.skeleton.parents):
            if parent >= 0:
                beyond[j] |= beyond[parent]
        return owners, axes, beyond[:, owners]

    def _axes_in_world(self, R: Array) -> Array:
        """Axis (T, D - 3, 3) of each rotation coordinate in world."""
        owners, axes, _ = self._turning
        return np.asarray(np.einsum("tdij,jd->tdi", R[:, owners], axes))

    def turn_rates(self, R: Array) -> Array:
        """Return derivatives (T, J, D - 3, 3) of segments' rotation vectors in world, at R, by the rotations."""
        return np.where(self._turning[2][..., None], self._axes_in_world(R)[:, None], 0.0)

    def point_rates(self, p: Array, R: Array, joints: Sequence[int], points: Array) -> Array:
        """Return derivatives (T, K, 3, D) of points (T, K, 3), m, on segments by the tangent, at p and R."""
        (T, K, _), (owners, _, moves) = points.shape, self._turning
        cross = so3.skew(self._axes_in_world(R)).transpose(0, 3, 2, 1)  # of axis x (point - center)
        out = np.empty((T, K, 3, self.size))
        out[..., :3] = np.eye(3)
        moved = np.einsum("tkid,tdk->tid", cross, p[:, owners])
        np.subtract((points @ cross.reshape(T, 3, -1)).reshape(T, K, 3, -1), moved[:, None], out=out[..., 3:])
        out[..., 3:] *= moves[list(joints), None]
        return out


class Limits:
    """Lower and upper bounds of M hinge angles; see `levenberg_marquardt.Limits`.

    Attributes:
        names: M URDF joints. lower, upper: (M,) rad.
        columns: (M,) tangent coordinate of each angle.
    """

    def __init__(self, space: StateSpace) -> None:
        """Collect the limits of the hinges that move. `InvalidInputError`: a lower limit is not below its upper one."""
        skeleton = space.skeleton
        hinges = np.flatnonzero(space.hinge_axis >= 0)
        axes = space.hinge_axis[hinges]
        self._cosine, self._sine, self.columns = 3 + 4 * hinges, 4 + 4 * hinges + axes, space.first[hinges]
        joints = [skeleton.table.joints[space.joints[a]] for a in hinges]
        self.names = tuple(
            joint.dofs[joint.axes.index(XYZ[axis])].urdf for joint, axis in zip(joints, axes, strict=True)
        )
        self._size = space.size
        rows = [skeleton.dof_names.index(name) for name in self.names]
        self.lower, self.upper = skeleton.limits[rows].reshape(-1, 2).T
        for name in np.array(self.names)[~(self.lower < self.upper)]:
            raise InvalidInputError(f"limits of {name} contradict each other: lower is not below upper")

    def values(self, x: Array) -> Array:
        """Return the angles (T, M) of states, rad, within half a turn of the middle of their limits."""
        angles = 2 * np.arctan2(x[:, self._sine], x[:, self._cosine])
        middle = (self.lower + self.upper) / 2
        return np.asarray(angles - 2 * np.pi * np.floor((angles - middle) / (2 * np.pi) + 0.5))

    def excess(self, values: Array) -> Array:
        """Return the violations (T, M), rad: negative below the lower limit, 0 inside."""
        return np.asarray(values - np.minimum(np.maximum(values, self.lower), self.upper))

    def within(self, x: Array) -> Array:
        """Return states (T, 3 + 4A) with the angles beyond a limit moved onto it.

        So no hinge of an initial guess passes through a whole turn, which no step of a solver undoes.
        """
        half = np.minimum(np.maximum(self.values(x), self.lower), self.upper) / 2
        out = x.copy()
        out[:, self._cosine], out[:, self._sine] = np.cos(half), np.sin(half)
        return out

    def force(self, x: Array, push: Array) -> Array:
        """Return J^T push (T, D) of forces (T, M) on the angles."""
        out = np.zeros((len(x), self._size))
        out[:, self.columns] = push
        return out

    def curvature(self, x: Array, pushed: Mask) -> tuple[Index, Index, Index, Array]:  # noqa: ARG002
        """Return frames, rows, columns and values (n,) of J^T J of the angles chosen (T, M)."""
        frames, m = np.nonzero(pushed)
        at = np.asarray(self.columns[m], dtype=np.intp)
        return frames, at, at, np.ones(len(frames))
