"""Anatomical limits of knees and elbows: the flexion of every hinge, between the URDF's bounds.

Ball joints are not limited. Bounds on their three Euler angles are no anatomy: they couple through the
sequence, jump where it is singular, and people leave them (a deep squat flexes the hip by 180 degrees).
A solver that holds them turns the pelvis, which carries no sensor, to keep a thigh that a sensor measured
within them (`benchmarks/results/limits.md`). The pose prior is what is known of ball joints.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import ShapeError
from rtof_kin.solve.energy.state import XYZ, StateSpace

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Limits:
    """Lower and upper bounds of M hinge angles.

    Attributes:
        names: M URDF joints. lower, upper: (M,) rad.
    """

    def __init__(self, space: StateSpace) -> None:
        """Collect the limits of the hinges that move.

        Raises:
            ShapeError: a lower limit is not below its upper one.
        """
        skeleton = space.skeleton
        names: list[str] = []
        self._cosine: list[int] = []
        self._sine: list[int] = []
        self._columns: list[int] = []
        for a, (j, axis) in enumerate(zip(space.joints, space.hinge_axis, strict=True)):
            if axis >= 0:
                joint = skeleton.table.joints[j]
                names.append(joint.dofs[joint.axes.index(XYZ[axis])].urdf)
                self._cosine.append(3 + 4 * a)
                self._sine.append(4 + 4 * a + int(axis))
                self._columns.append(int(space.first[a]))
        self.names, self._size = tuple(names), space.size
        rows = [skeleton.dof_names.index(name) for name in names]
        self.lower, self.upper = skeleton.limits[rows].reshape(-1, 2).T
        wrong = np.flatnonzero(~(self.lower < self.upper))
        if len(wrong):
            name = names[int(wrong[0])]
            raise ShapeError(f"limits of {name} contradict each other: lower is not below upper")

    def values(self, x: Array) -> Array:
        """Angles (T, M) of states (T, 3 + 4A), rad, within half a turn of the middle of their limits."""
        angles = 2 * np.arctan2(x[:, self._sine], x[:, self._cosine])
        middle = (self.lower + self.upper) / 2
        return np.asarray(angles - 2 * np.pi * np.floor((angles - middle) / (2 * np.pi) + 0.5))

    def excess(self, values: Array) -> Array:
        """(T, M) rad by which angles leave their limits; negative below the lower one, 0 inside."""
        return np.asarray(values - np.minimum(np.maximum(values, self.lower), self.upper))

    def jacobian(self, x: Array) -> Array:
        """Derivatives (T, M, D) of the values at a state by a step: each angle is a coordinate of it."""
        J = np.zeros((len(x), len(self.names), self._size))
        J[:, range(len(self.names)), self._columns] = 1.0
        return J

    def force(self, x: Array, push: Array) -> Array:
        """J^T push (T, D) of forces (T, M) on the angles at a state."""
        out = np.zeros((len(x), self._size))
        out[:, self._columns] = push
        return out

    def curvature(self, x: Array, pushed: NDArray[np.bool_]) -> tuple[Index, Index, Index, Array]:
        """Frames, rows, columns and values (n,) of the entries of J^T J of the angles chosen (T, M)."""
        frames, m = np.nonzero(pushed)
        at = np.array(self._columns, dtype=np.intp)[m]
        return frames, at, at, np.ones(len(frames))
