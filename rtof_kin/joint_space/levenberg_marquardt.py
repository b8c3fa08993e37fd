"""The real-time solver: Levenberg-Marquardt on the banded system, limits by augmented Lagrangian.

Damping is absolute and small: one relative to the diagonal would freeze the root's depth, because jerk
makes the diagonal huge. Where the last step came out as the model said it would, the next one uses the
factor that is there (a gradient costs a fifth of a Hessian with its factor).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.problem import Factor, JointProblem

Array = NDArray[np.float64]
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e6
_TRUSTED = (0.7, 1.4)
"""Actual over predicted decrease within which the factor is used once more."""
_STIFFNESS = 1 / np.radians(1.0) ** 2
"""Of the limits' penalty, 1/rad^2; multipliers make them exact."""
_LIMIT_TOLERANCE = np.radians(0.1)
_ROUNDS = 8


@dataclass(frozen=True)
class Solved:
    """Where a solver stopped."""

    x: Array
    """(N, 3 + 4A) the state."""
    iterations: int
    converged: bool
    """Whether the last predicted decrease was below the tolerance and the limits held."""
    multipliers: Array
    """(N, M) of the limits, positive at upper, negative at lower ones."""


class LevenbergMarquardt:
    """Solves one problem for any data bound to it. Keeps nothing from one call to the next."""

    def __init__(self, problem: JointProblem, limits: Limits | None) -> None:
        self.problem, self.limits = problem, limits

    def solve(
        self,
        x: Array,
        max_iterations: int,
        tolerance: float,
        multipliers: Array | None = None,
    ) -> Solved:
        """Minimise from a state.

        Args:
            tolerance: relative decrease of the energy, predicted for a step, below which it ends.
            multipliers: of an earlier solution, to go on with.
        """
        M = 0 if self.limits is None else len(self.limits.names)
        m = np.zeros((len(x), M)) if multipliers is None else multipliers
        iterations, converged, outside = 0, False, 0.0
        for _ in range(_ROUNDS):
            x, used, converged = self._minimise(x, m, max_iterations - iterations, tolerance)
            iterations += used
            m, outside = self._updated(x, m)
            if outside <= _LIMIT_TOLERANCE or iterations >= max_iterations:
                break
        return Solved(x, iterations, converged and outside <= _LIMIT_TOLERANCE, m)

    def _minimise(
        self, x: Array, m: Array, max_iterations: int, tolerance: float
    ) -> tuple[Array, int, bool]:
        """With fixed multipliers: the state, iterations, whether it converged."""
        problem, damping = self.problem, 1e-3
        factor: Factor | None = None
        energy = np.inf
        for iteration in range(max_iterations):
            fresh = factor is None
            if factor is None:
                value, gradient = problem.linearise(x)
                gradient = gradient + self._add_penalty(x, m)
                energy = value + self._penalty(x, m)
                factor = problem.factorise(damping)
            else:
                gradient = problem.gradient(x) + self._add_penalty(x, m, hessian=False)
            step = factor.solve(-gradient)
            predicted = -0.5 * float(np.sum(gradient * step))
            if predicted < tolerance * (1 + abs(energy)):
                return x, iteration, True
            candidate = problem.space.retract(x, step)
            after = problem.total(candidate) + self._penalty(candidate, m)
            ratio = (energy - after) / predicted
            if ratio > 1e-3:
                x, energy = candidate, after
                if not _TRUSTED[0] < ratio < _TRUSTED[1]:
                    factor = None
                if fresh and ratio > 0.5:
                    damping = max(damping / 10, _LEAST_DAMPING)
                continue
            factor = None
            if fresh:
                damping = max(damping, 1e-2) * 8
                if damping > _MOST_DAMPING:
                    return x, iteration, False
        return x, max_iterations, False

    # --- limits ----------------------------------------------------------------------------------

    def _violation(self, values: Array, m: Array) -> Array:
        """(N, M) excess shifted by the multipliers: what the penalty acts on."""
        assert self.limits is not None
        shifted = values + m / _STIFFNESS
        return self.limits.excess(shifted)

    def _penalty(self, x: Array, m: Array) -> float:
        if self.limits is None:
            return 0.0
        pushed = self._violation(self.limits.values(x), m)
        return float(0.5 * _STIFFNESS * np.sum(pushed**2) - 0.5 / _STIFFNESS * np.sum(m**2))

    def _add_penalty(self, x: Array, m: Array, hessian: bool = True) -> Array | float:
        """Its gradient; its Hessian goes onto the problem's diagonal blocks."""
        if self.limits is None:
            return 0.0
        values = self.limits.values(x)
        pushed = self._violation(values, m)
        if not pushed.any():
            return 0.0
        J = np.where((pushed != 0)[..., None], self.limits.jacobian(values), 0.0)
        if hessian:
            self.problem.add_to_diagonal(_STIFFNESS * np.swapaxes(J, 1, 2) @ J)
        return np.asarray(_STIFFNESS * np.einsum("tm,tmd->td", pushed, J))

    def _updated(self, x: Array, m: Array) -> tuple[Array, float]:
        """Multipliers after a minimisation, and how far limits or their multipliers are off, rad.

        A multiplier changes by the stiffness times the violation of its limit, or times the slack of a
        limit that is not reached though it still pushes.
        """
        if self.limits is None:
            return m, 0.0
        new = _STIFFNESS * self._violation(self.limits.values(x), m)
        return new, float(np.abs(new - m).max(initial=0.0)) / _STIFFNESS
