"""Energy, gradient and Hessian of a fragment as functions of a frame t and its neighbours.

From values of the frames around t, which are zero beyond the ends, to the contribution at t. Step t leads from frame t
to t + 1, with its inverse right Jacobian; path residual t is that of frames t to t + 2 (of an acceleration: at frame
t + 1), jerk t that of frames t to t + 3. Columns of frame t of the Hessian have entries in the rows of t to t + 3. Only
entries that are not always zero are computed: paths couple limbs only through the trunk, and frames three apart couple
only the axes of one joint.

The jerk is that of the tangent coordinates: with v_t the step from frame t to t + 1, its energy is that of the second
differences of v. A step changes by L_t with the tangent of the later frame and by -L_t^T with that of the earlier one,
where L_t is the inverse right Jacobian of its rotation vector. Approximating L by 1 in the Hessian slows convergence of
slow motions of the whole fragment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtof_kin.core.array_types import Index
from rtof_kin.core.numerics.simd import GROUP, FrameFunction
from rtof_kin.core.packages import casadi as ca
from rtof_kin.solve import terms as residuals
from rtof_kin.solve.joint_space.energy import FrameEnergy
from rtof_kin.solve.joint_space.layout import LAGS
from rtof_kin.solve.joint_space.state import StateSpace


@dataclass(frozen=True)
class HessianColumns:
    """A function whose last output are entries of the Hessian."""

    frame: FrameFunction  #: Its last output is in groups of `GROUP` entries, one below the other in a column
    groups: Index
    """(groups, 2) first row, counted from the frame's first, and column. Rows above the diagonal are
    zero, whatever the matrix has there."""


def retract(space: StateSpace) -> FrameFunction:
    """Return the function (state, tangent) -> state after the step."""
    x, d = ca.SX.sym("x", 3 + 4 * len(space.joints)), ca.SX.sym("d", space.size)
    turns, parts = ca.DM(space.expand) @ d[3:], [x[:3] + d[:3]]
    for a in range(len(space.joints)):
        half = turns[3 * a : 3 * a + 3] / 2
        squared: Any = ca.sumsqr(half)
        near = squared < 1e-16
        angle = ca.sqrt(ca.if_else(near, 1, squared))
        turn = ca.vertcat(ca.cos(angle), ca.sin(angle) / angle * half)
        turn = ca.if_else(near, ca.vertcat(1, half), turn)
        q = residuals.quat_multiply(x[3 + 4 * a : 7 + 4 * a], turn)
        parts.append(q / ca.sqrt(ca.sumsqr(q)))
    return _function("retract", [x, d], [ca.vertcat(*parts)])


def step(space: StateSpace) -> FrameFunction:
    """Return the function (states of t and t + 1) -> step between them (D)."""
    x, y = (ca.SX.sym(name, 3 + 4 * len(space.joints)) for name in "xy")
    parts = [y[:3] - x[:3]]
    for a in range(len(space.joints)):
        q, r = (v[3 + 4 * a : 7 + 4 * a] for v in (x, y))
        turn = residuals.quat_multiply(residuals.quat_conjugate(q), r)
        turn = ca.if_else(turn[0] < 0, -1, 1) * turn
        squared: Any = ca.sumsqr(turn[1:])
        near = squared < 1e-18
        sine = ca.sqrt(ca.if_else(near, 1, squared))
        factor = ca.if_else(near, 2, 2 * ca.atan2(sine, turn[0]) / sine)
        parts.append(ca.DM(space.axes(a)).T @ (factor * turn[1:]))
    return _function("step", [x, y], [ca.vertcat(*parts)])


def inverse(space: StateSpace) -> FrameFunction:
    """Return the function (step) -> inverse right Jacobians (9 B) of its ball joints, column-major."""
    v, out = ca.SX.sym("v", space.size), []
    for columns in _balls(space):
        turn = v[columns]
        squared: Any = ca.sumsqr(turn)
        near = squared < 1e-6
        safe = ca.if_else(near, 1, squared)
        angle, K = ca.sqrt(safe), ca.skew(turn)
        far = 1 / safe - (1 + ca.cos(angle)) / (2 * angle * ca.sin(angle))
        out.append(ca.vec(ca.SX.eye(3) + K / 2 + ca.if_else(near, 1 / 12, far) * (K @ K)))
    return _function("inverse", [v], [ca.vertcat(*out)])


def motion(energy: FrameEnergy) -> FrameFunction:
    """Return the function of the paths' residuals at t to t + 2 and of the jerk of t to t + 3.

    Inputs: steps t, t + 1, t + 2; weight of the jerk; paths' points at t, t + 1, t + 2; measured derivatives and their
    weights; sigma (D) of the jerk; rate. Outputs: energies of each term with paths and of the jerk, slopes (P) of the
    paths' losses, derivatives of the energy by second differences of the steps (D) and by the paths' differences (3P).
    """
    size, P = energy.space.size, len(energy.paths)
    v, w_jerk = [ca.SX.sym(f"v{k}", size) for k in range(3)], ca.SX.sym("wj")
    p, a = [ca.SX.sym(f"p{k}", 3 * P) for k in range(3)], ca.SX.sym("a", 3 * P)
    w, sigma, rate = ca.SX.sym("w", P), ca.SX.sym("s", size), ca.SX.sym("f")
    jerk = residuals.step_jerk(ca.horzcat(*v), rate) / sigma
    values: dict[str, Any] = {}
    slopes, forces = [], []
    for s, path in enumerate(energy.paths):
        rows, difference = slice(3 * s, 3 * s + 3), residuals.DIFFERENCES[path.derivative][0]
        r = difference(ca.horzcat(*(q[rows] for q in p)), a[rows], rate)
        squared = w[s] * ca.sumsqr(r)
        values[path.term] = values.get(path.term, 0) + 0.5 * residuals.pseudo_huber(squared, path.robust)
        slopes.append(w[s] * residuals.pseudo_huber_weight(squared, path.robust))
        forces.append(slopes[-1] * r * rate**path.derivative)
    all_values = ca.vertcat(*values.values(), 0.5 * w_jerk * ca.sumsqr(jerk))
    outputs = [all_values, _stacked(slopes), w_jerk * jerk / sigma * rate**3, _stacked(forces)]
    return _function("motion", [*v, w_jerk, *p, a, w, sigma, rate], outputs, (9, 10))


def pulled(energy: FrameEnergy) -> FrameFunction:
    """Return the function (state, observation, constant, inputs of `_Neighbours`) -> gradient (D)."""
    around, frame = _Neighbours(energy), _frame_inputs(energy)
    gradient = energy.gradient(*frame, around.force()) + around.jerk_gradient()
    return _function("pulled", [*frame, *around.inputs()], [gradient], (2,))


def linear(energy: FrameEnergy) -> HessianColumns:
    """Return the function of the gradient (D), of the varying entries of the paths' Jacobian and of the
    Hessian's entries within frame t.

    Inputs: state, observation, constant; those of `_Neighbours`; slopes (P) of path residuals t - 2, t - 1, t;
    coefficients of the jerk (12); its sigma (D); rate.
    """
    around, frame, jerk = _Neighbours(energy), _frame_inputs(energy), _JerkBlocks(energy)
    slopes = [ca.SX.sym(f"u{k}", len(energy.paths)) for k in range(3)]
    rate = ca.SX.sym("f")
    _, gradient, H, _, J, _ = energy.full(*frame)
    A = ca.sparsify(J)
    gradient = gradient + A.T @ around.force() + around.jerk_gradient()
    H = ca.sparsify(H) + _product(energy, A, slopes, (2, 1, 0), 0, rate, A)
    H = ca.tril(H + jerk.block(0, around.inverses, around.inverses))
    groups, numbers = _grouped([H], 0)
    changing = _PathJacobian(energy).changing(J)
    inputs = [*frame, *around.inputs(), *slopes, jerk.coefficients, jerk.sigma, rate]
    outputs = [ca.densify(v) for v in (gradient, changing, numbers)]
    shared = (2, len(inputs) - 2, len(inputs) - 1)
    return HessianColumns(FrameFunction.of(ca.Function("linear", inputs, outputs), shared, placed=True), groups)


def coupled(energy: FrameEnergy) -> HessianColumns:
    """Return the function of the Hessian's entries one to three frames later.

    Inputs: varying entries of the paths' Jacobian of t, t + 1, t + 2; slopes of path residuals t - 1 and t; inverse
    right Jacobians of the steps t - 1 to t + 2; coefficients of the jerk; its sigma; rate.
    """
    J, jerk, rate = _PathJacobian(energy), _JerkBlocks(energy), ca.SX.sym("f")
    changing = [ca.SX.sym(f"J{k}", len(J.at)) for k in range(3)]
    slopes = [ca.SX.sym(f"u{k}", len(energy.paths)) for k in range(2)]
    L = [ca.SX.sym(f"L{k}", 9 * len(_balls(energy.space))) for k in range(LAGS)]
    A, turns = [J.filled(v) for v in changing], [_blocks(v) for v in L]
    turns.append([])
    parts = [jerk.block(k, turns[:2], turns[k : k + 2]) for k in range(1, LAGS)]
    parts[0] = parts[0] + _product(energy, A[1], slopes, (1, 0), 1, rate, A[0])
    parts[1] = parts[1] + _product(energy, A[2], slopes[1:], (0,), 2, rate, A[0])
    groups, numbers = _grouped(parts, energy.space.size)
    inputs = [*changing, *slopes, *L, jerk.coefficients, jerk.sigma, rate]
    shared = (len(inputs) - 2, len(inputs) - 1)
    function = ca.Function("coupled", inputs, [ca.densify(numbers)])
    return HessianColumns(FrameFunction.of(function, shared, placed=True), groups)


class _Neighbours:
    """Symbols for what frame t receives from its neighbours through paths and jerk.

    Attributes:
        inverses: inverse right Jacobians of steps t - 1 and t, 3 x 3 for each ball joint.
    """

    def __init__(self, energy: FrameEnergy) -> None:
        self._energy, self.space = energy, energy.space
        count, size = 9 * len(_balls(self.space)), 3 * len(energy.paths)
        self._forces = [ca.SX.sym(f"f{k}", size) for k in range(3)]
        self._tensions = [ca.SX.sym(f"e{k}", self.space.size) for k in range(4)]
        self._inverses = [ca.SX.sym(f"L{k}", count) for k in range(2)]
        self.inverses = [_blocks(v) for v in self._inverses]

    def inputs(self) -> list[Any]:
        """Return the symbols: derivatives by the differences of paths t - 2 to t and by second differences of steps
        t - 3 to t, and the inverse right Jacobians of steps t - 1 and t.
        """
        return [*self._forces, *self._tensions, *self._inverses]

    def force(self) -> Any:
        """Return the force (3P) on the paths' points at t."""
        c = [ca.DM(np.repeat([path.coefficients[k] for path in self._energy.paths], 3)) for k in range(3)]
        f = self._forces
        return c[2] * f[0] + c[1] * f[1] + c[0] * f[2]

    def jerk_gradient(self) -> Any:
        """Return the gradient (D) of the jerk's energy, through steps t - 1 and t."""
        e = self._tensions
        before, after = (e[k] - 2 * e[k + 1] + e[k + 2] for k in range(2))
        out: Any = before - after
        for columns, ending, beginning in zip(_balls(self.space), *self.inverses, strict=True):
            out[columns] = ending.T @ before[columns] - beginning @ after[columns]
        return out


class _PathJacobian:
    """Jacobian (3P, D) of the paths' points, split into constant and varying entries.

    Attributes:
        at: places of the varying entries in the matrix, column-major.
    """

    def __init__(self, energy: FrameEnergy) -> None:
        J = energy.full(*_frame_inputs(energy))[4]
        entries = [J.nz[k] for k in range(J.nnz())]
        self.at = [k for k, entry in enumerate(entries) if not entry.is_constant()]
        fixed = [float(entry) if entry.is_constant() else 0.0 for entry in entries]
        self._fixed = ca.reshape(ca.SX(fixed), *J.shape) if fixed else ca.SX(*J.shape)

    def changing(self, J: Any) -> Any:
        """Varying entries of a dense matrix."""
        return ca.vec(J)[self.at]

    def filled(self, changing: Any) -> Any:
        """The matrix of varying entries."""
        J = ca.vec(ca.SX(self._fixed))
        J[self.at] = changing
        return ca.sparsify(ca.reshape(J, *self._fixed.shape))


class _JerkBlocks:
    """Symbols for the jerk's coefficients (`fragment.jerk_coefficients`) and sigma, and its blocks."""

    def __init__(self, energy: FrameEnergy) -> None:
        self.space = energy.space
        self.coefficients, self.sigma = ca.SX.sym("c", 3 * LAGS), ca.SX.sym("s", self.space.size)

    def block(self, k: int, own: list[list[Any]], later: list[list[Any]]) -> Any:
        """(D, D) rows of frame t + k, columns of t; `own`: inverse right Jacobians of steps t - 1 and t; `later`: of
        steps t + k - 1 and t + k, the second one unused three frames later.
        """
        c = ca.vertsplit(self.coefficients)
        H = ca.diag(c[2 * LAGS + k] / self.sigma**2)
        for b, columns in enumerate(_balls(self.space)):
            ending, beginning = own[0][b], own[1][b].T
            block = later[0][b].T @ (c[k] * ending - c[LAGS + k] * beginning)
            if k + 1 < LAGS:
                block -= later[1][b] @ (c[k + 1] * ending - c[LAGS + k + 1] * beginning)
            H[columns, columns] = block / self.sigma[columns.start] ** 2
        return H


def _frame_inputs(energy: FrameEnergy) -> list[Any]:
    """Symbols for state, observation and constant of a frame."""
    return [ca.SX.sym(name, energy.value.nnz_in(i)) for i, name in enumerate(("x", "observed", "constant"))]


def _balls(space: StateSpace) -> list[slice]:
    """Tangent coordinates of the ball joints."""
    first = space.first[space.hinge_axis < 0]
    return [slice(int(i), int(i) + 3) for i in first]


def _blocks(v: Any) -> list[Any]:
    """3 x 3 matrices of a vector (9 B) of their columns."""
    return [ca.reshape(v[9 * b : 9 * b + 9], 3, 3) for b in range(v.numel() // 9)]


def _product(energy: FrameEnergy, A: Any, slopes: list[Any], at: Sequence[int], later: int, rate: Any, B: Any) -> Any:
    """A^T W B, rows of a frame `later` frames after that of the columns; `slopes`: (P) of the path residuals that have
    both frames; `at`: which of their three frames that of the columns is.
    """
    if not energy.paths:
        return ca.SX(A.shape[1], B.shape[1])
    powers = {order: rate ** (2 * order) for order in {path.derivative for path in energy.paths}}
    weights: Any = 0
    for slope, k in zip(slopes, at, strict=True):
        weights += ca.DM([path.coefficients[k] * path.coefficients[k + later] for path in energy.paths]) * slope
    every = ca.vertcat(*(powers[path.derivative] for path in energy.paths))
    return A.T @ (ca.diag(ca.vec(ca.repmat((weights * every).T, 3, 1))) @ B)


def _grouped(parts: Sequence[Any], first: int) -> tuple[Index, Any]:
    """Nonzero entries of blocks one below the other, in groups of `GROUP` rows of a column padded with zeros: (groups,
    2) first row and column, and the entries; `first`: row of the first block, counted from the first row of the frame.
    """
    size = parts[0].shape[1]
    all_rows = ca.vertcat(*parts)
    places, entries = [], []
    for c in range(size):
        column = all_rows[:, c]
        rows = sorted(column.sparsity().row())
        while rows:
            begin = max(min(rows[0], all_rows.shape[0] - GROUP), 0)
            places.append((first + begin, c))
            group = column[begin : begin + GROUP]
            entries += [group[i] for i in range(group.numel())] + [ca.SX(0)] * (GROUP - group.numel())
            rows = [r for r in rows if r >= begin + GROUP]
    return np.array(places).reshape(-1, 2), ca.vertcat(*entries)


def _stacked(parts: list[Any]) -> Any:
    return ca.vertcat(*parts) if parts else ca.SX(0, 1)


def _function(name: str, inputs: list[Any], outputs: list[Any], shared: tuple[int, ...] = ()) -> FrameFunction:
    return FrameFunction.of(ca.Function(name, inputs, [ca.densify(v) for v in outputs]), shared)
