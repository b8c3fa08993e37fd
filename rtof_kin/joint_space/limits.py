"""Anatomical limits of the state: the URDF's angles of every moving joint, and their derivatives.

Where the middle one of a joint's three angles nears a right angle, the first and the third become one and
the same turn and mean nothing apart. So what is bounded are the angles themselves but for singular
postures: from 15 to 5 degrees before, the first and the third fade to the middle of their limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from rtof_kin import energies
from rtof_kin.compiled import Buffered
from rtof_kin.errors import ShapeError
from rtof_kin.joint_space.state import XYZ, StateSpace
from rtof_kin.lane_code import FrameFunction
from rtof_kin.lanes import Mapped

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_SINGULAR = np.sin(np.radians([5.0, 15.0]))


class Limits:
    """Lower and upper bounds of M angles.

    Attributes:
        names: M URDF joints. lower, upper: (M,) rad.
        functions: CasADi's, of one frame: (state, lower, upper) -> bounded angles (M); and with their
            derivatives by the rotation vector of the joint they belong to (3M).
    """

    def __init__(
        self, space: StateSpace, functions: list[Any] | None = None,
        code: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Collect the limits of the joints that move.

        Args:
            functions: compiled ones of a space like this, if there are.
            code: of `in_lanes`' functions, which are then called for several frames at once.

        Raises:
            ShapeError: a lower limit is not below its upper one.
        """
        self.space = space
        skeleton = space.skeleton
        joints = skeleton.table.joints
        names: list[str] = []
        self._of: list[int] = []
        for a, j in enumerate(space.joints[1:], start=1):
            axis = int(space.hinge_axis[a])
            for i, dof in enumerate(joints[j].dofs):
                if axis < 0 or XYZ.index(joints[j].axes[i]) == axis:
                    names.append(dof.urdf)
                    self._of.append(a)
        self.names = tuple(names)
        rows = [skeleton.dof_names.index(name) for name in names]
        self.lower, self.upper = skeleton.limits[rows].reshape(-1, 2).T
        wrong = np.flatnonzero(~(self.lower < self.upper))
        if len(wrong):
            name = names[int(wrong[0])]
            raise ShapeError(f"limits of {name} contradict each other: lower is not below upper")
        self._ball = space.hinge_axis[self._of] < 0
        self._columns = space.first[self._of][:, None] + np.arange(3) * self._ball[:, None]
        self.functions = self._functions() if functions is None else functions
        self._code = code
        self._known: tuple[Array, Array] | None = None
        self._mapped: dict[tuple[int, int], Callable[[Array], Array]] = {}

    def for_lanes(self) -> list[FrameFunction]:
        """The functions, as they are compiled for several frames at once."""
        return [FrameFunction(function, (1,)) for function in self.functions]

    def values(self, x: Array) -> Array:
        """What is bounded (T, M) of a state, rad: angles of that one of their two sets, and with those
        turns, that are nearest to the limits.

        Three angles say the same as (first + pi, pi - second, third + pi), and the limits of a shoulder
        reach into both sets.
        """
        return np.array(self._evaluate(0, x))

    def excess(self, values: Array) -> Array:
        """(T, M) rad by which angles leave their limits; negative below the lower one, 0 inside."""
        return np.asarray(values - np.minimum(np.maximum(values, self.lower), self.upper))

    def jacobian(self, x: Array) -> Array:
        """Derivatives (T, M, D) of the values at a state by a step."""
        J = np.zeros((len(x), len(self.names), self.space.size))
        rates = self._rates(x)
        M = np.arange(len(self.names))
        J[:, M[self._ball, None], self._columns[self._ball]] = rates[:, self._ball]
        J[:, M[~self._ball], self._columns[~self._ball, 0]] = rates[:, ~self._ball, 0]
        return J

    def force(self, x: Array, push: Array) -> Array:
        """J^T push (T, D) of forces (T, M) on the angles at a state, most of which are 0."""
        frame, m = np.nonzero(push)
        rates = self._rates(x)[frame, m] * push[frame, m, None]
        places, size = frame[:, None] * self.space.size + self._columns[m], len(x) * self.space.size
        summed = np.bincount(places.ravel(), rates.ravel(), size)
        return np.asarray(summed.reshape(len(x), -1))

    def curvature(self, x: Array, pushed: NDArray[np.bool_]) -> tuple[Index, Index, Index, Array]:
        """J^T J of the angles chosen (T, M): frames (n, 1, 1), rows (n, 3, 1), columns (n, 1, 3) and
        values (n, 3, 3) of blocks; some are at the same place."""
        frame, m = np.nonzero(pushed)
        rates, at = self._rates(x)[frame, m], self._columns[m]
        return (
            frame[:, None, None], at[:, :, None], at[:, None, :], rates[:, :, None] * rates[:, None, :]
        )  # fmt: skip

    # --- parts -----------------------------------------------------------------------------------

    def _rates(self, x: Array) -> Array:
        """(T, M, 3) derivatives by the rotation vector of the joint; of a hinge's, the first alone."""
        if self._known is None or self._known[0] is not x:
            self._known = x, self._evaluate(1, x).reshape(len(x), -1, 3)
        return self._known[1]

    def _evaluate(self, which: int, x: Array) -> Array:
        """(T, n) of a function."""
        key = which, len(x)
        if key not in self._mapped:
            self._mapped[key] = self._over(which, len(x))
        return self._mapped[key](x)

    def _over(self, which: int, frames: int) -> Callable[[Array], Array]:
        """A function over so many frames."""
        bounds = np.concatenate([self.lower, self.upper])
        if self._code is not None:
            given = self.for_lanes()[which]
            lanes = Mapped(self._code[given.function.name()], given, frames)
            return lambda x: lanes(x, bounds)[0]
        mapped = Buffered(self.functions[which].map(frames))
        mapped.inputs[1][:] = np.tile(bounds, frames)
        return lambda x: mapped(x.ravel())[0].reshape(frames, -1)

    def _functions(self) -> list[Any]:
        """The CasADi functions of one frame."""
        space, A = self.space, len(self.space.joints)
        x, bounds = ca.SX.sym("x", 3 + 4 * A), ca.SX.sym("b", len(self.names), 2)
        values, rates = [], []
        first = 0
        for a in sorted(set(self._of)):
            count = self._of.count(a)
            low_high = bounds[first : first + count, :]
            e, axes = ca.SX.sym("e", count), ca.DM(space.axes(a))
            turned = energies.quat_multiply(
                x[3 + 4 * a : 7 + 4 * a], ca.vertcat(1, axes @ e / 2)
            )
            own = self._bounded(a, turned, low_high)
            slope = ca.SX(count, 3)
            slope[:, :count] = ca.jacobian(own, e)
            zero = ca.SX.zeros(count, 1)
            values.append(ca.substitute(own, e, zero))
            rates.append(ca.vec(ca.substitute(slope, e, zero).T))
            first += count
        outputs = [ca.densify(ca.vertcat(*v)) if v else ca.SX(0, 1) for v in (values, rates)]
        option = {"cse": True}
        return [
            ca.Function("limited", [x, ca.vec(bounds)], outputs[:1], option),
            ca.Function("limited_slope", [x, ca.vec(bounds)], outputs[1:], option),
        ]

    def _bounded(self, a: int, q: Any, low_high: Any) -> Any:
        """Angles (1 or 3) of one joint of quaternion q, as `values` describes them."""
        lower, upper = low_high[:, 0], low_high[:, 1]
        middle = (lower + upper) / 2

        def near(angles: Any) -> Any:
            return angles - 2 * np.pi * ca.floor((angles - middle) / (2 * np.pi) + 0.5)

        axis = int(self.space.hinge_axis[a])
        if axis >= 0:
            return near(2 * ca.atan2(q[1 + axis], q[0]))
        order = self.space.skeleton.table.joints[self.space.joints[a]].axes
        angles = energies.intrinsic_angles(q, order)
        one, other = near(angles), near(np.pi + angles * ca.DM([1.0, -1.0, 1.0]))
        out_one, out_other = (
            ca.sum1(ca.fmax(v - upper, 0) + ca.fmax(lower - v, 0)) for v in (one, other)
        )
        angles = ca.if_else(out_other + 1e-9 < out_one, other, one)
        near_by, far = _SINGULAR
        along = ca.fmin((ca.fabs(ca.cos(angles[1])) - near_by) / (far - near_by), 1)
        faded = middle + along**2 * (3 - 2 * along) * (angles - middle)
        outer = ca.if_else(along > 0, faded, middle)
        return ca.vertcat(outer[0], angles[1], outer[2])
