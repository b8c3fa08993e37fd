"""A fragment with unknowns of its own: scale, delay, heading, mounting, places of landmarks.

They are the same in all frames, so they border the Hessian's band:

::

    [A   C] [dx]   [b_x]
    [C^T H] [dy] = [b_y]

The band is solved for the G columns of C once per factor, W = A^-1 C, and for one right-hand side per
step, z = A^-1 b_x; then (H - C^T W) dy = b_y - C^T z, of the size of the unknowns alone, and
dx = z - W dy (block elimination; Boyd & Vandenberghe 2004, app. C.4). A state and its unknowns are one
flat vector, so that `LevenbergMarquardt` solves such a problem as any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from rtof_kin.core.errors import ShapeError, SolverError
from rtof_kin.core.numerics import banded
from rtof_kin.core.numerics.levenberg_marquardt import Limits
from rtof_kin.solve.energy.problem import JointProblem

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class BorderedFactor:
    """A factorised Hessian with its border. Keeps nothing of the problem that made it."""

    band: banded.Factor
    columns: Array
    """(N D, G) of the unknowns."""
    solved: Array
    """(N D, G) the band's solutions for them."""
    corner: Array
    """(G, G) lower Cholesky factor of what elimination of the states leaves."""

    def solve(self, right: Array) -> Array:
        """The step (N D + G,) for a right-hand side."""
        size = len(self.columns)
        z = self.band.solve(right[:size])
        dy = cho_solve((self.corner, True), right[size:] - self.columns.T @ z)
        return np.concatenate([z - self.solved @ dy, dy])


class BorderedProblem:
    """The energy of a `JointProblem` by its states and unknowns, with a normal prior about zero on those.

    ::

        E(x, y) = E(x; y) + 1/2 sum (y / sigma)^2

    States are flat: `pack` and `unpack`. A `levenberg_marquardt.LimitedProblem`.
    """

    def __init__(self, problem: JointProblem, sigma: ArrayLike) -> None:
        """Move the unknowns of a problem too.

        Args:
            sigma: (G,) standard deviations of the unknowns, in the units and the order of
                `frame_energy.UNKNOWNS` and `Shape.columns`.

        Raises:
            ShapeError: sigma is not of that length, or not positive and finite.
        """
        self.problem, self.sigma = problem, np.array(sigma, dtype=float)
        shape = problem.energy.shape
        if self.sigma.shape != (shape.unknown_count,):
            raise ShapeError(
                f"sigma {self.sigma.shape}: give one for each of the {shape.unknown_count} unknowns "
                f"({', '.join(shape.unknowns) or 'none'})"
            )
        if not (np.isfinite(self.sigma).all() and (self.sigma > 0).all()):
            i = int(np.flatnonzero(~(np.isfinite(self.sigma) & (self.sigma > 0)))[0])
            name = next(n for n, part in shape.columns.items() if part.start <= i < part.stop)
            raise ShapeError(
                f"sigma[{i}] ({name}) is {self.sigma[i]}: give a positive, finite standard deviation; "
                f"what is known exactly is left out of the unknowns"
            )
        self._flat = np.zeros(0)
        self._parts: tuple[Array, Array] = np.zeros(0), np.zeros(0)

    # --- states ----------------------------------------------------------------------------------

    def pack(self, x: Array, y: ArrayLike) -> Array:
        """States (N, 3 + 4A) and unknowns (G,) as one vector."""
        return np.concatenate([x.ravel(), np.asarray(y, dtype=float)])

    def unpack(self, flat: Array) -> tuple[Array, Array]:
        """States (N, 3 + 4A) and unknowns (G,) of one vector, as views."""
        if self._flat is not flat:  # the problem knows a state again by its identity
            size = len(flat) - len(self.sigma)
            self._flat, self._parts = flat, (flat[:size].reshape(self.problem.frames, -1), flat[size:])
        return self._parts

    def retract(self, flat: Array, step: Array) -> Array:
        """The state after a step (N D + G,)."""
        x, y = self.unpack(flat)
        size = len(step) - len(y)
        return self.pack(self.problem.retract(x, step[:size].reshape(len(x), -1)), y + step[size:])

    # --- the energy ------------------------------------------------------------------------------

    def total(self, flat: Array) -> float:
        """The energy with the unknowns' prior."""
        x, y = self._at(flat)
        return self.problem.total(x) + 0.5 * float(np.sum((y / self.sigma) ** 2))

    def gradient(self, flat: Array) -> Array:
        """(N D + G,) of the energy."""
        x, y = self._at(flat)
        g, by_y = self.problem.gradients(x)
        return np.concatenate([g.ravel(), by_y + y / self.sigma**2])

    def linearise(self, flat: Array) -> tuple[float, Array]:
        """Energy and gradient (N D + G,); the Hessian is kept for `factorise`."""
        x, y = self._at(flat)
        energy, g = self.problem.linearise(x)
        by_y, columns, corner = self.problem.border()
        self._columns = columns.reshape(-1, len(y))
        self._corner = corner + np.diag(1 / self.sigma**2)
        prior = 0.5 * float(np.sum((y / self.sigma) ** 2))
        return energy + prior, np.concatenate([g.ravel(), by_y + y / self.sigma**2])

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the states' diagonal blocks of the Hessian kept."""
        self.problem.add_to_diagonal(frames, rows, columns, values)

    def factorise(self, damping: float) -> BorderedFactor:
        """The Hessian kept, plus `damping` on its diagonal.

        Raises:
            SolverError: it is not positive definite.
        """
        band = self.problem.factorise(damping)
        solved = band.solve_columns(self._columns)
        schur = self._corner + damping * np.eye(len(self._corner)) - self._columns.T @ solved
        try:
            corner, _ = cho_factor(schur, lower=True)
        except (np.linalg.LinAlgError, ValueError) as error:  # the latter where it is not finite
            raise SolverError("the unknowns' Hessian is not positive definite") from error
        return BorderedFactor(band, self._columns, solved, corner)

    def _at(self, flat: Array) -> tuple[Array, Array]:
        """States and unknowns, of which the problem now has the latter."""
        x, y = self.unpack(flat)
        self.problem.set_unknowns(y)
        return x, y


class BorderedLimits:
    """Limits on the states of a `BorderedProblem`, as a `levenberg_marquardt.Limits`.

    `LevenbergMarquardt.solve` takes its state's length for N: give it multipliers (N, M) to begin with.
    """

    def __init__(self, problem: BorderedProblem, limits: Limits) -> None:
        """Limits of the problem's states."""
        self._problem, self._limits, self.names = problem, limits, limits.names

    def values(self, x: Array) -> Array:
        """(N, M)."""
        return self._limits.values(self._problem.unpack(x)[0])

    def excess(self, values: Array) -> Array:
        """(N, M) by which they leave their limits."""
        return self._limits.excess(values)

    def force(self, x: Array, push: Array) -> Array:
        """Gradient (N D + G,) of forces (N, M) on them."""
        states, y = self._problem.unpack(x)
        return np.concatenate([self._limits.force(states, push).ravel(), np.zeros(len(y))])

    def curvature(self, x: Array, pushed: NDArray[np.bool_]) -> tuple[Index, Index, Index, Array]:
        """Entries of the Hessian of half the sum of squares of those chosen."""
        return self._limits.curvature(self._problem.unpack(x)[0], pushed)
