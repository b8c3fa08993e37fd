"""Symmetric systems that are banded in time: LAPACK's Cholesky factorisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from rtof_kin.errors import SolverError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Factor:
    """A factorised system of n unknowns."""

    band: Array

    def solve(self, right: Array) -> Array:
        """The solution, of the shape of the right-hand side: n numbers in any shape.

        Raises:
            SolverError: the right-hand side has another number of numbers.
        """
        if right.size != self.band.shape[1]:
            raise SolverError(f"{right.size} numbers for a system of {self.band.shape[1]}")
        x, info = lapack.dpbtrs(self.band, right.ravel(), lower=1)
        if info:
            raise SolverError("the banded system could not be solved")
        return np.asarray(x.reshape(right.shape))

    def solve_columns(self, right: Array) -> Array:
        """The solutions (n, k) for k right-hand sides (n, k).

        Raises:
            SolverError: the right-hand sides have another number of rows.
        """
        if right.ndim != 2 or len(right) != self.band.shape[1]:
            raise SolverError(f"right-hand sides {right.shape} for a system of {self.band.shape[1]}")
        if right.size == 0:
            return np.zeros(right.shape)
        x, info = lapack.dpbtrs(self.band, right, lower=1)
        if info:
            raise SolverError("the banded system could not be solved")
        return np.asarray(x)


def factorise(band: Array) -> Factor:
    """Factor of a positive definite matrix.

    Args:
        band: (n, w), row c holds column c of the matrix from its diagonal downwards; it is overwritten.

    Raises:
        SolverError: the matrix is not positive definite.
    """
    factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
    if info or not np.isfinite(factor[0]).all():
        raise SolverError("the fragment's Hessian is not positive definite")
    return Factor(factor)
