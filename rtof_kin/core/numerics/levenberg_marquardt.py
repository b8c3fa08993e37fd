"""The real-time solver: Levenberg-Marquardt on the banded system, limits by augmented Lagrangian.

Damping is absolute and small: one relative to the diagonal would freeze the root's depth, because jerk
makes the diagonal huge. Where the last step came out as the model said it would, the next one uses the
factor that is there (a gradient costs a quarter of a Hessian with its factor), also when multipliers or
weights have changed meanwhile: the next step's outcome tells whether it still serves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast, overload

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import SolverError

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e6
_TRUSTED = (0.5, 2.0)
"""Actual over predicted decrease within which the factor is used once more."""
_SLOW = 0.5
"""Share of the decrease promised before that a step on an old factor may promise at most."""
_STIFFNESS = 1 / np.radians(1.0) ** 2
"""Of the limits' penalty, 1/rad^2; multipliers make them exact."""
_USUAL_TOLERANCE, _LIMIT_TOLERANCE = 1e-4, np.radians(0.1)
"""How far limits may be off where the energy's tolerance is the usual one; less with its square root."""
_EARLY = 10.0
"""Multipliers are updated when a step promises less than this many tolerances."""


class Factor(Protocol):
    """A factorised Hessian."""

    def solve(self, right: Array) -> Array:
        """The step for a right-hand side."""


class Problem(Protocol):
    """An energy of some state, with its Hessian as a band."""

    def retract(self, x: Array, step: Array) -> Array:
        """The state after a step."""

    def total(self, x: Array) -> float:
        """The energy."""

    def gradient(self, x: Array) -> Array:
        """Of the energy by a step from x."""

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Energy and gradient; the Hessian is kept."""

    def factorise(self, damping: float) -> Factor:
        """The Hessian kept, plus a damping on its diagonal."""


class LimitedProblem(Problem, Protocol):
    """One whose Hessian takes that of limits on top."""

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the Hessian kept, within frames."""


class Limits(Protocol):
    """Inequalities on M angles of a state (N, ...)."""

    names: tuple[str, ...]

    def values(self, x: Array) -> Array:
        """(N, M)."""

    def excess(self, values: Array) -> Array:
        """(N, M) by which they leave their limits."""

    def force(self, x: Array, push: Array) -> Array:
        """Gradient of forces (N, M) on them."""

    def curvature(self, x: Array, pushed: NDArray[np.bool_]) -> tuple[Index, Index, Index, Array]:
        """Entries of the Hessian of half the sum of squares of those chosen."""


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
    out_of_iterations: bool = False
    """Whether it stopped at its iteration limit; not converged without, no step lowered the energy."""


class LevenbergMarquardt:
    """Solves one problem for any data bound to it. Keeps nothing from one call to the next."""

    @overload
    def __init__(self, problem: Problem) -> None: ...

    @overload
    def __init__(self, problem: LimitedProblem, limits: Limits | None) -> None: ...

    def __init__(self, problem: Problem, limits: Limits | None = None) -> None:
        """Take a problem, and the limits that its states shall keep."""
        self.problem, self.limits = problem, limits
        self._angles: tuple[Array, Array] | None = None

    def solve(
        self,
        x: Array,
        max_iterations: int,
        tolerance: float,
        multipliers: Array | None = None,
        reweigh: Callable[[Array], bool] | None = None,
    ) -> Solved:
        """Minimise from a state.

        Args:
            tolerance: relative decrease of the energy, predicted for a step, below which it ends; limits
                are kept to a tenth of a degree, and closer where it is below 1e-4.
            multipliers: of an earlier solution, to go on with.
            reweigh: called with the start and every new state; may change the problem's weights, and
                returns whether it did.

        Raises:
            SolverError: the energy of the start is not finite, or no damping makes its Hessian positive
                definite.
        """
        problem, damping, factor, updated = self.problem, 1e-3, None, False
        M = 0 if self.limits is None else len(self.limits.names)
        m = np.zeros((len(x), M)) if multipliers is None else multipliers
        promised = np.inf
        allowed = _LIMIT_TOLERANCE * min(1.0, np.sqrt(tolerance / _USUAL_TOLERANCE))
        if reweigh is not None:
            reweigh(x)
        energy = self._energy(x, m)
        if not np.isfinite(energy):
            raise SolverError("the energy of the starting state is not finite")
        iteration, out_of_iterations = 0, False
        for iteration in range(max_iterations):
            fresh = factor is None
            gradient = self.linearise(x, m) if factor is None else self._gradient(x, m)
            if factor is None:
                try:
                    factor = problem.factorise(damping)
                except SolverError:  # not positive definite
                    damping = max(damping, 1e-2) * 8
                    if damping > _MOST_DAMPING:
                        raise
                    continue
            step = factor.solve(-gradient)
            predicted = -0.5 * float(np.sum(gradient * step))
            small = predicted / (tolerance * (1 + abs(energy)) + 1e-300)
            if small < _EARLY and not updated:
                new, outside = self._updated(x, m)
                if small < 1 and outside <= allowed:
                    return Solved(x, iteration, True, new)
                updated = outside > allowed
                if updated:
                    m, energy = new, self._energy(x, new)
                    continue
            candidate = problem.retract(x, step)
            after = self._energy(candidate, m)
            ratio = (energy - after) / predicted
            if not ratio > 1e-3:
                factor = None
                if fresh:
                    damping = max(damping, 1e-2) * 8
                    if damping > _MOST_DAMPING:
                        break
                continue
            x, energy, updated = candidate, after, False
            if not _TRUSTED[0] < ratio < _TRUSTED[1] or (not fresh and predicted > _SLOW * promised):
                factor = None
            promised = predicted
            if fresh and ratio > 0.5:
                damping = max(damping / 10, _LEAST_DAMPING)
            if reweigh is not None and reweigh(x):
                factor, energy = None, self._energy(x, m)
        else:
            iteration, out_of_iterations = max_iterations, True
        new, _ = self._updated(x, m)
        return Solved(x, iteration, False, new, out_of_iterations)

    # --- limits ----------------------------------------------------------------------------------

    def _pushed(self, x: Array, m: Array) -> Array:
        """(N, M) excess of the angles shifted by the multipliers: what the penalty acts on."""
        assert self.limits is not None
        if self._angles is None or self._angles[0] is not x:
            self._angles = x, self.limits.values(x)
        return self.limits.excess(self._angles[1] + m / _STIFFNESS)

    def _energy(self, x: Array, m: Array) -> float:
        energy = self.problem.total(x)
        if self.limits is None:
            return energy
        pushed = self._pushed(x, m)
        return energy + float(0.5 * _STIFFNESS * np.sum(pushed**2) - 0.5 / _STIFFNESS * np.sum(m**2))

    def linearise(self, x: Array, m: Array) -> Array:
        """Gradient (N, D) with the limits' force at multipliers (N, M); the Hessian, with that of the
        limits, is kept by the problem.
        """
        _, gradient = self.problem.linearise(x)
        if self.limits is None or not (pushed := self._pushed(x, m)).any():
            return gradient
        frames, rows, columns, squares = self.limits.curvature(x, pushed != 0)
        cast(LimitedProblem, self.problem).add_to_diagonal(frames, rows, columns, _STIFFNESS * squares)
        return np.asarray(gradient + _STIFFNESS * self.limits.force(x, pushed))

    def _gradient(self, x: Array, m: Array) -> Array:
        gradient = self.problem.gradient(x)
        if self.limits is None or not (pushed := self._pushed(x, m)).any():
            return gradient
        return np.asarray(gradient + _STIFFNESS * self.limits.force(x, pushed))

    def _updated(self, x: Array, m: Array) -> tuple[Array, float]:
        """Multipliers after a minimisation, and how far limits or their multipliers are off, rad.

        A multiplier changes by the stiffness times the violation of its limit, or times the slack of a
        limit that is not reached though it still pushes.
        """
        if self.limits is None:
            return m, 0.0
        new = _STIFFNESS * self._pushed(x, m)
        return new, float(np.abs(new - m).max(initial=0.0)) / _STIFFNESS
