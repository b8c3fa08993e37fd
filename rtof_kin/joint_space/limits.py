"""Anatomical limits of the state: the URDF's angles of every moving joint, and their derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.errors import ShapeError
from rtof_kin.joint_space.state import XYZ, StateSpace

Array = NDArray[np.float64]
_SINGULAR = np.sin(np.radians(5.0))


class Limits:
    """Lower and upper bounds of M angles.

    Attributes:
        names: M URDF joints. lower, upper: (M,) rad.
    """

    def __init__(self, space: StateSpace) -> None:
        """Collect the limits of the joints that move.

        Raises:
            ShapeError: a lower limit is not below its upper one.
        """
        self.space = space
        joints = space.skeleton.table.joints
        names: list[str] = []
        bounds: list[tuple[float, float]] = []
        self._balls: dict[str, list[tuple[int, int]]] = {}
        self._hinges: list[tuple[int, int, int]] = []
        for a, j in enumerate(space.joints[1:], start=1):
            axis = int(space.hinge_axis[a])
            if axis < 0:
                self._balls.setdefault(joints[j].axes, []).append((a, len(names)))
            else:
                self._hinges.append((a, axis, len(names)))
            for i, dof in enumerate(joints[j].dofs):
                if axis < 0 or XYZ.index(joints[j].axes[i]) == axis:
                    names.append(dof.urdf)
                    bounds.append((float(joints[j].limits[i, 0]), float(joints[j].limits[i, 1])))
        self.names = tuple(names)
        self.lower, self.upper = np.array(bounds).reshape(-1, 2).T
        wrong = np.flatnonzero(~(self.lower < self.upper))
        if len(wrong):
            name = names[int(wrong[0])]
            raise ShapeError(f"limits of {name} contradict each other: lower is not below upper")

    def values(self, x: Array) -> Array:
        """Angles (T, M) of a state, rad: of their two sets and all turns, those nearest to the limits.

        Three angles say the same as (first + pi, pi - second, third + pi), and the limits of a shoulder
        reach into both sets.
        """
        q, values = self.space.rotations(x), np.zeros((len(x), len(self.names)))
        for a, axis, at in self._hinges:
            turn = 2 * np.arctan2(q[:, a, 1 + axis], q[:, a, 0])
            values[:, at] = self._near(turn, at)
        for order, places in self._balls.items():
            joints, first = (np.array(column) for column in zip(*places, strict=True))
            columns = first[:, None] + np.arange(3)
            one = so3.matrix_to_euler(order, so3.from_quat_wxyz(q[:, joints]))
            other = np.stack(
                [one[..., 0] + np.pi, np.pi - one[..., 1], one[..., 2] + np.pi], axis=-1
            )
            one, other = self._near(one, columns), self._near(other, columns)
            better = np.abs(self._outside(other, columns)).sum(axis=-1) + 1e-9 < np.abs(
                self._outside(one, columns)
            ).sum(axis=-1)
            values[:, columns] = np.where(better[..., None], other, one)
        return values

    def _near(self, angles: Array, columns: NDArray[np.intp] | int) -> Array:
        """Angles turned by whole turns to the middle of their limits."""
        middle = (self.lower[columns] + self.upper[columns]) / 2
        return np.asarray((angles - middle + np.pi) % (2 * np.pi) - np.pi + middle)

    def _outside(self, angles: Array, columns: NDArray[np.intp]) -> Array:
        over = np.maximum(angles - self.upper[columns], 0)
        return np.asarray(over + np.minimum(angles - self.lower[columns], 0))

    def jacobian(self, values: Array) -> Array:
        """Derivatives (T, M, D) of angles by a step; 0 within 5 degrees of a singular posture."""
        turns = np.zeros((*values.shape, 3 * len(self.space.joints)))
        for a, axis, at in self._hinges:
            turns[:, at, 3 * a + axis] = 1.0
        for order, places in self._balls.items():
            for (a, at), rates in zip(places, _rates(order, values, places), strict=True):
                turns[:, at : at + 3, 3 * a : 3 * a + 3] = rates
        root = np.zeros((*values.shape, 3))
        return np.concatenate([root, turns @ self.space.expand], axis=-1)

    def excess(self, values: Array) -> Array:
        """(T, M) rad by which angles leave their limits; negative below the lower one, 0 inside."""
        return self._outside(values, np.arange(len(self.names)))


def _rates(order: str, values: Array, places: list[tuple[int, int]]) -> Array:
    """(joints, T, 3, 3) derivative of intrinsic angles by a rotation vector in the turned frame."""
    angles = np.stack([values[:, at : at + 3] for _, at in places])
    first, second, third = (np.eye(3)[XYZ.index(axis)] for axis in order)
    R_third = so3.about_axis(order[2], angles[..., 2])
    R_second = so3.about_axis(order[1], angles[..., 1])
    columns = np.stack(
        [
            np.einsum("...ba,...cb,c->...a", R_third, R_second, first),
            np.einsum("...ba,b->...a", R_third, second),
            np.broadcast_to(third, angles.shape),
        ],
        axis=-1,
    )
    regular = np.abs(np.cos(angles[..., 1])) > _SINGULAR
    out = np.zeros_like(columns)
    out[regular] = np.linalg.inv(columns[regular])
    return out
