"""Real-time solver: Levenberg-Marquardt on a banded system, limits by augmented Lagrangian.

Damping is absolute and small: relative to the diagonal, which jerk makes huge, it would freeze the root's depth. If the
decrease of the last step was close to the predicted one, the next step reuses the factor (a gradient costs a quarter of
a Hessian with its factor), even if multipliers or weights have changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, cast

import numpy as np

from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import Factor

_LEAST_DAMPING: Final = 1e-6
_MOST_DAMPING: Final = 1e6
_TRUSTED: Final = (0.5, 2.0)  #: Ratio of actual to predicted decrease within which the factor is reused
_FAR: Final = 0.1  #: Predicted decrease, as a share of the energy, of a step so long that its factor is not reused
_SLOW: Final = 0.5  #: Largest ratio of predicted decreases, of a step with a reused factor to the step before
STIFFNESS: Final = 1 / np.radians(1.0) ** 2  #: Penalty of the limits, 1/rad^2; multipliers make them exact
_USUAL_TOLERANCE: Final = 1e-4
_LIMIT_TOLERANCE: Final = np.radians(0.1)
"""Violation of limits, rad, allowed at the usual tolerance of the energy; scales with its square root."""
_EARLY: Final = 10.0  #: Multipliers are updated if the predicted decrease is below this many tolerances

_CAUTION: Final = 4.0
"""Factor on the decrease expected after a step: its own times the relative error of the prediction."""


class Problem(Protocol):
    """An energy of a state x, with a banded Hessian."""

    def retract(self, x: Array, step: Array) -> Array:
        """Return the state after a step."""

    def total(self, x: Array) -> float:
        """Return the energy."""

    def gradient(self, x: Array) -> Array:
        """Return the gradient by a step from x."""

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient, and store the Hessian."""

    def factorise(self, damping: float) -> Factor:
        """Factorise the stored Hessian plus a damping on its diagonal."""


class LimitedProblem(Problem, Protocol):
    """A problem whose Hessian can be extended by that of limits."""

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the stored Hessian, within frames."""


class Limits(Protocol):
    """Inequalities on M angles of a state (N, ...)."""

    names: tuple[str, ...]

    def values(self, x: Array) -> Array:
        """Return the angles (N, M), rad."""

    def excess(self, values: Array) -> Array:
        """Return the signed violations (N, M) of angles, rad."""

    def force(self, x: Array, push: Array) -> Array:
        """Return the gradient of forces (N, M) on the angles."""

    def curvature(self, x: Array, pushed: Mask) -> tuple[Index, Index, Index, Array]:
        """Return the Hessian entries of half the sum of squares of the selected angles (N, M)."""


@dataclass(frozen=True)
class Solved:
    """Result of a minimisation."""

    x: Array  #: (N, 3 + 4A) state
    iterations: int
    converged: bool
    """True if the predicted decrease of a next step was below the tolerance and the limits were satisfied."""
    multipliers: Array  #: (N, M) of the limits, positive at upper, negative at lower ones
    out_of_iterations: bool = False
    """True if it stopped at its iteration limit. Neither this nor converged: no step lowers the energy."""


@dataclass
class _Run:
    """State of a minimisation."""

    x: Array
    m: Array  #: (N, M) multipliers
    energy: float
    damping: float = 1e-3
    factor: Factor | None = None  #: Factor to be reused; None if the Hessian has to be computed
    updated: bool = False  #: True if multipliers were updated since the last step
    promised: float = np.inf  #: Predicted decrease of the last step
    iterations: int = 0


class LevenbergMarquardt:
    """Solver of one problem for any data bound to it; keeps no state between calls."""

    def __init__(self, problem: Problem, limits: Limits | None = None) -> None:
        """Take a problem, a `LimitedProblem` where there are limits of its states."""
        self.problem, self.limits = problem, limits
        self._known: tuple[Array, Array, Array | None] | None = None

    def solve(
        self,
        x: Array,
        max_iterations: int,
        tolerance: float,
        multipliers: Array | None = None,
        reweigh: Callable[[Array], bool] | None = None,
    ) -> Solved:
        """Minimise from an initial state. `SolverError`: the energy of the initial state is not finite, or no damping
        makes its Hessian positive definite.

        Args:
            x: (N, ...) initial state.
            tolerance: relative predicted decrease of the energy at which it stops; limits are satisfied to 0.1 degrees,
                and closer below 1e-4.
            multipliers: (N, M) of an earlier solution.
            reweigh: called with the initial and every new state; may change the weights of the problem, and returns
                whether it did.
        """
        M = 0 if self.limits is None else len(self.limits.names)
        m = np.zeros((len(x), M)) if multipliers is None else multipliers
        if reweigh is not None:
            reweigh(x)
        run = _Run(x, m, self._energy(x, m))
        if not np.isfinite(run.energy):
            raise SolverError("the energy of the starting state is not finite")
        converged: bool | None = None
        while converged is None and run.iterations < max_iterations:
            run.iterations += 1
            converged = self._iterate(run, tolerance, reweigh)
        m, ran_out = self._updated(run.x, run.m)[0], converged is None
        return Solved(run.x, run.iterations, bool(converged), m, ran_out)

    def _iterate(self, run: _Run, tolerance: float, reweigh: Callable[[Array], bool] | None) -> bool | None:
        """Try one step; return True if converged, False if no step lowers the energy, else None."""
        fresh = run.factor is None
        gradient = self.linearise(run.x, run.m, hessian=fresh)
        factor = run.factor or self._factorise(run)
        if factor is None:
            return None
        step = factor.solve(-gradient)
        predicted = -0.5 * float(np.sum(gradient * step))
        enough = tolerance * (1 + abs(run.energy)) + 1e-300
        allowed = _LIMIT_TOLERANCE * min(1.0, np.sqrt(tolerance / _USUAL_TOLERANCE))
        if predicted < _EARLY * enough and not run.updated:
            new, outside = self._updated(run.x, run.m)
            if predicted < enough and outside <= allowed:
                run.iterations -= 1
                self._polish(run, step, allowed)
                return True
            run.updated = bool(outside > allowed)
            if run.updated:
                run.m, run.energy = new, self._energy(run.x, new)
                return None
        candidate = self.problem.retract(run.x, step)
        after = self._energy(candidate, run.m)
        ratio = (run.energy - after) / predicted
        if not ratio > 1e-3:
            run.factor = None
            return False if fresh and not _increase_damping(run) else None
        slow = predicted > _FAR * abs(run.energy) if fresh else predicted > _SLOW * run.promised
        if slow or not _TRUSTED[0] < ratio < _TRUSTED[1]:
            run.factor = None
        run.x, run.energy, run.updated, run.promised = candidate, after, False, predicted
        if fresh and ratio > 0.5:
            run.damping = max(run.damping / 10, _LEAST_DAMPING)
        if reweigh is not None and reweigh(run.x):
            run.factor, run.energy = None, self._energy(run.x, run.m)
        elif predicted < _EARLY * enough and _CAUTION * abs(1 - ratio) * predicted < enough:
            return True if self._updated(run.x, run.m)[1] <= allowed else None
        return None

    def _polish(self, run: _Run, step: Array, allowed: float) -> None:
        """Take the last step, too small to be needed, if it lowers the energy and keeps the limits."""
        candidate = self.problem.retract(run.x, step)
        after = self._energy(candidate, run.m)
        if after < run.energy and self._updated(candidate, run.m)[1] <= allowed:
            run.x, run.energy = candidate, after

    def _factorise(self, run: _Run) -> Factor | None:
        """Factorise the Hessian; if it is not positive definite, increase the damping and return None."""
        try:
            run.factor = self.problem.factorise(run.damping)
        except SolverError:
            if not _increase_damping(run):
                raise
        return run.factor

    # --- limits ----------------------------------------------------------------------------------

    def _pushed(self, x: Array, m: Array) -> Array | None:
        """Return the excess (N, M) of the angles shifted by the multipliers, on which the penalty acts; None where
        nothing is beyond its limit.
        """
        if self.limits is None:
            return None
        if self._known is None or self._known[0] is not x or self._known[1] is not m:
            pushed = self.limits.excess(self.limits.values(x) + m / STIFFNESS)
            self._known = x, m, pushed if pushed.any() else None
        return self._known[2]

    def _energy(self, x: Array, m: Array) -> float:
        energy, pushed = self.problem.total(x), self._pushed(x, m)
        if pushed is not None:
            energy += 0.5 * STIFFNESS * float(np.vdot(pushed, pushed))
        return float(energy - 0.5 / STIFFNESS * np.vdot(m, m))

    def linearise(self, x: Array, m: Array, hessian: bool = True) -> Array:
        """Return the gradient (N, D) with the force of the limits; the problem stores the whole Hessian if asked to."""
        gradient = self.problem.linearise(x)[1] if hessian else self.problem.gradient(x)
        if (pushed := self._pushed(x, m)) is None:
            return gradient
        assert self.limits is not None
        if hessian:
            frames, rows, columns, squares = self.limits.curvature(x, pushed != 0)
            cast(LimitedProblem, self.problem).add_to_diagonal(frames, rows, columns, STIFFNESS * squares)
        return np.asarray(gradient + STIFFNESS * self.limits.force(x, pushed))

    def _updated(self, x: Array, m: Array) -> tuple[Array, float]:
        """Return updated multipliers, and the largest violation of a limit or of complementarity, rad. A multiplier
        changes by the stiffness times the violation of its limit, or times the slack of an inactive limit with a
        multiplier.
        """
        pushed = self._pushed(x, m)
        new = np.zeros_like(m) if pushed is None else STIFFNESS * pushed
        return new, float(np.abs(new - m).max(initial=0.0)) / STIFFNESS


def _increase_damping(run: _Run) -> bool:
    """Increase the damping; return False beyond its largest value."""
    run.damping = max(run.damping, 1e-2) * 8
    return run.damping <= _MOST_DAMPING
