"""Quadratic prior of the first frames of a window, from the frames before it.

Frames leave a window by marginalisation: all terms that contain the leaving frame are linearised at the
present states, robust weights included, and the frame is eliminated by the Schur complement. What remains is
an energy of the three frames that the jerk couples with it::

    E(x) = eta^T d + 1/2 d^T Lambda d        d = x - x_0 in tangent coordinates

(Sibley, Matthies & Sukhatme 2010; Dong-Si & Mourikis 2011). Linearisation points x_0 are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from rtof_kin.core import quaternions as quat
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import Factor, StoredFactor
from rtof_kin.core.numerics.levenberg_marquardt import STIFFNESS
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.energy.jerk import LAGS
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.joint_space.limits import Limits

MEMORY = LAGS - 1
"""Frames that a marginalised frame leaves a prior on."""
_DAMPING = 1e-6
"""Added to the diagonal of the eliminated frame: its root may be unobserved."""


@dataclass(frozen=True)
class MarginalPrior:
    """Energy of the first three frames of a window."""

    x: Array
    """(3, 3 + 4A) linearisation points."""
    precision: Array
    """(3D, 3D) Lambda."""
    slope: Array
    """(3D,) eta."""

    @classmethod
    def none(cls, space: StateSpace, x: Array) -> MarginalPrior:
        """Return a prior without information.

        Args:
            x: (3, 3 + 4A) any states.
        """
        size = MEMORY * space.size
        return cls(x, np.zeros((size, size)), np.zeros(size))

    def at(self, space: StateSpace, x: Array) -> tuple[float, Array]:
        """Return the energy and its gradient (3, D) by tangents at x.

        Args:
            x: (3, 3 + 4A).
        """
        d = space.difference(self.x, x).ravel()
        pulled = self.precision @ d
        force = (self.slope + pulled).reshape(MEMORY, -1)
        turns = (d.reshape(MEMORY, -1)[:, 3:] @ space.expand.T).reshape(MEMORY, -1, 3)
        torque = (force[:, 3:] @ space.expand.T).reshape(turns.shape)
        torque = np.einsum("taij,tai->taj", quat.right_jacobian_inverse(turns), torque)
        gradient = np.concatenate([force[:, :3], torque.reshape(MEMORY, -1) @ space.expand], axis=1)
        return float(d @ (self.slope + pulled / 2)), gradient


def marginalised(
    prior: MarginalPrior, leaving: FragmentEnergy, limits: Limits | None, x: Array, multipliers: Array
) -> MarginalPrior:
    """Return the prior of frames 1 to 3 after frame 0 has left.

    Args:
        prior: of frames 0 to 2. leaving: energy of frames 0 to 3 with the terms that contain frame 0 bound.
        x: (4, 3 + 4A) present states. multipliers: (4, M) of the limits.

    Raises:
        SolverError: the frame's Hessian is not positive definite.
    """
    space = leaving.space
    D, kept = space.size, MEMORY * space.size
    gradient = leaving.linearise(x)[1].ravel()
    H = leaving.hessian()
    H[:kept, :kept] += prior.precision
    gradient[:kept] += prior.at(space, x[:MEMORY])[1].ravel()
    if limits is not None:
        excess = limits.excess(limits.values(x[:1]) + multipliers[:1] / STIFFNESS)
        gradient[:D] += STIFFNESS * limits.force(x[:1], excess)[0]
        _, rows, columns, values = limits.curvature(x[:1], excess != 0)
        H[rows, columns] += STIFFNESS * values
    H[:D, :D] += _DAMPING * np.eye(D)
    factor, failed = lapack.dpotrf(H[:D, :D], lower=1)
    if failed:
        raise SolverError("the Hessian of the frame that leaves is not positive definite")
    right = np.concatenate([H[D:, :D], gradient[None, :D]]).T
    half, _ = lapack.dtrtrs(factor, right, lower=1)
    precision = H[D:, D:] - half[:, :-1].T @ half[:, :-1]
    slope = gradient[D:] - half[:, :-1].T @ half[:, -1]
    return MarginalPrior(x[1:].copy(), precision, slope)


class WindowEnergy:
    """The energy of a window with the prior of its first frames; see `levenberg_marquardt.Problem`.

    Attributes:
        energy: of the window's own terms. prior: of its first three frames.
    """

    def __init__(self, energy: FragmentEnergy, prior: MarginalPrior) -> None:
        self.energy, self.prior, self.space = energy, prior, energy.space
        self._known: tuple[Array, float, Array] | None = None

    def retract(self, x: Array, step: Array) -> Array:
        """Return the states after a step (N, D)."""
        return self.energy.retract(x, step)

    def total(self, x: Array) -> float:
        """Return the energy."""
        return self.energy.total(x) + self._at(x)[0]

    def gradient(self, x: Array) -> Array:
        """Return the gradient (N, D)."""
        gradient = self.energy.gradient(x)
        gradient[:MEMORY] += self._at(x)[1]
        return gradient

    def linearise(self, x: Array) -> tuple[float, Array]:
        """Return energy and gradient (N, D); keep the Hessian."""
        energy, gradient = self.energy.linearise(x)
        own, slope = self._at(x)
        self.energy.add_to_first(self.prior.precision)
        gradient[:MEMORY] += slope
        return energy + own, gradient

    def _at(self, x: Array) -> tuple[float, Array]:
        """The prior's energy and gradient, kept until another array is given."""
        if self._known is None or self._known[0] is not x:
            self._known = (x, *self.prior.at(self.space, x[:MEMORY]))
        return self._known[1:]

    def add_to_diagonal(self, frames: Index, rows: Index, columns: Index, values: Array) -> None:
        """Add to entries of the diagonal blocks of the Hessian."""
        self.energy.add_to_diagonal(frames, rows, columns, values)

    def factorise(self, damping: float) -> Factor | StoredFactor:
        """Return the Cholesky factor of the Hessian plus `damping` on its diagonal."""
        return self.energy.factorise(damping)
