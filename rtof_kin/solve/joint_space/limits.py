"""Anatomical limits of knees and elbows: the flexion of every hinge, between the URDF's bounds.

Ball joints are not limited. Bounds on their three Euler angles are not anatomical: they couple through
the sequence, jump where it is singular, and people exceed them. A solver that keeps them turns the pelvis
to hold a measured thigh within them (`benchmarks/results/limits.md`). Ball joints have the pose prior.
"""

from __future__ import annotations

import numpy as np

from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.energy.state import XYZ, StateSpace


class Limits:
    """Lower and upper bounds of M hinge angles; see `levenberg_marquardt.Limits`.

    Attributes:
        names: M URDF joints. lower, upper: (M,) rad.
        columns: (M,) tangent coordinate of each angle.
    """

    def __init__(self, space: StateSpace) -> None:
        """Collect the limits of the hinges that move.

        Raises:
            InvalidInputError: a lower limit is not below its upper one.
        """
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
