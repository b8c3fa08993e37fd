"""Hessian of a fragment as functions of a frame t and its neighbours, for SIMD code.

Columns of frame t have entries in the rows of frames t to t + 3. Only entries that are not always zero
are computed: accelerations couple limbs only through the trunk, and frames three apart couple only the
axes of one joint. `energy.problem` and `energy.jerk` have the same mathematics on whole arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from rtof_kin.core.array_types import Index
from rtof_kin.core.numerics.simd_codegen import GROUP, FrameFunction
from rtof_kin.solve.compiled.stencils import Neighbours, balls, blocks, frame_inputs
from rtof_kin.solve.energy.frame_energy import FrameEnergy
from rtof_kin.solve.energy.jerk import LAGS


@dataclass(frozen=True)
class HessianColumns:
    """A function whose last output are entries of the Hessian."""

    frame: FrameFunction
    """Its last output is in groups of `GROUP` entries, one below the other in a column."""
    groups: Index
    """(groups, 2) first row, counted from the frame's first, and column. Rows above the diagonal are
    zero, whatever the matrix has there."""


def linear(energy: FrameEnergy) -> HessianColumns:
    """Return the function of the gradient (D), of the varying entries of the sensors' Jacobian and of the
    Hessian's entries within frame t.

    Inputs: state, observation, constant; those of `Neighbours`; slopes (S) of the accelerations of
    frames t - 1, t, t + 1; coefficients of the jerk (12); its sigma (D); rate.
    """
    around, frame, jerk = Neighbours(energy), frame_inputs(energy), _JerkBlocks(energy)
    slopes = [ca.SX.sym(f"u{k}", len(energy.shape.sensors)) for k in range(3)]
    rate = ca.SX.sym("f")
    _, gradient, H, _, J, _ = energy.full(*frame)
    A = ca.sparsify(J)
    gradient = gradient + A.T @ around.force() + around.jerk_gradient()
    H = ca.sparsify(H) + _product(A, slopes[0] + 4 * slopes[1] + slopes[2], rate, A)
    H = ca.tril(H + jerk.block(0, around.inverses, around.inverses))
    groups, numbers = _grouped([H], 0)
    changing = _SensorJacobian(energy).changing(J)
    inputs = [*frame, *around.inputs(), *slopes, jerk.coefficients, jerk.sigma, rate]
    outputs = [ca.densify(v) for v in (gradient, changing, numbers)]
    shared = (2, len(inputs) - 2, len(inputs) - 1)
    function = ca.Function("linear", inputs, outputs)
    return HessianColumns(FrameFunction(function, shared, placed=True), groups)


def coupled(energy: FrameEnergy) -> HessianColumns:
    """Return the function of the Hessian's entries one to three frames later.

    Inputs: varying entries of the sensors' Jacobian of t, t + 1, t + 2; slopes of the accelerations of frames t and t
    + 1; inverse right Jacobians of the steps t - 1 to t + 2; coefficients of the jerk; its sigma; rate.
    """
    J, jerk, rate = _SensorJacobian(energy), _JerkBlocks(energy), ca.SX.sym("f")
    changing = [ca.SX.sym(f"J{k}", len(J.at)) for k in range(3)]
    slopes = [ca.SX.sym(f"u{k}", len(energy.shape.sensors)) for k in range(2)]
    L = [ca.SX.sym(f"L{k}", 9 * len(balls(energy.space))) for k in range(LAGS)]
    A, turns = [J.filled(v) for v in changing], [blocks(v) for v in L]
    turns.append([])
    weights = [-2 * (slopes[0] + slopes[1]), slopes[1]]
    parts = [jerk.block(k, turns[:2], turns[k : k + 2]) for k in range(1, LAGS)]
    for k, weight in enumerate(weights, start=1):
        parts[k - 1] = parts[k - 1] + _product(A[k], weight, rate, A[0])
    groups, numbers = _grouped(parts, energy.space.size)
    inputs = [*changing, *slopes, *L, jerk.coefficients, jerk.sigma, rate]
    function = ca.Function("coupled", inputs, [ca.densify(numbers)])
    shared = (len(inputs) - 2, len(inputs) - 1)
    return HessianColumns(FrameFunction(function, shared, placed=True), groups)


class _SensorJacobian:
    """Jacobian (3S, D) of the sensors' positions, split into constant and varying entries.

    Attributes:
        at: places of the varying entries in the matrix, column-major.
    """

    def __init__(self, energy: FrameEnergy) -> None:
        J = energy.full(*frame_inputs(energy))[4]
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
    """Symbols for the jerk's coefficients (`Jerk.coefficients`) and sigma, and its blocks."""

    def __init__(self, energy: FrameEnergy) -> None:
        self.space = energy.space
        self.coefficients, self.sigma = ca.SX.sym("c", 3 * LAGS), ca.SX.sym("s", self.space.size)

    def block(self, k: int, own: list[list[Any]], later: list[list[Any]]) -> Any:
        """(D, D) rows of frame t + k, columns of t.

        Args:
            own: inverse right Jacobians of steps t - 1 and t. later: of steps t + k - 1 and t + k, the
                second one unused three frames later.
        """
        c = ca.vertsplit(self.coefficients)
        H = ca.diag(c[2 * LAGS + k] / self.sigma**2)
        for b, columns in enumerate(balls(self.space)):
            ending, beginning = own[0][b], own[1][b].T
            block = later[0][b].T @ (c[k] * ending - c[LAGS + k] * beginning)
            if k + 1 < LAGS:
                block -= later[1][b] @ (c[k + 1] * ending - c[LAGS + k + 1] * beginning)
            H[columns, columns] = block / self.sigma[columns.start] ** 2
        return H


def _product(A: Any, slopes: Any, rate: Any, B: Any) -> Any:
    """A^T W B with a weight for each sensor."""
    weights = ca.vec(ca.repmat(slopes.T, 3, 1)) * rate**4
    return A.T @ (ca.diag(weights) @ B) if slopes.numel() else ca.SX(A.shape[1], B.shape[1])


def _grouped(parts: Sequence[Any], first: int) -> tuple[Index, Any]:
    """Nonzero entries of blocks one below the other, in groups of `GROUP` rows of a column padded with
    zeros: (groups, 2) first row and column, and the entries.

    Args:
        first: row of the first block, counted from the first row of the frame.
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
