"""Symmetric systems that are banded in time: LAPACK's Cholesky factorisation."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from rtof_kin.compiled import SWITCH, built, cache_folder, native
from rtof_kin.errors import ShapeError, SolverError

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


class Store:
    """A symmetric band of n unknowns as LAPACK stores it, and compiled code that factorises it.

    Attributes:
        entries: (n, step + 1), row c holds column c of the matrix from its diagonal downwards; what is
            below the band or the last row stays zero.
        step: so that entry (i, j) is ``flat[i + j * step]`` of all of them, one after the other.
    """

    def __init__(self, size: int, band: int) -> None:
        """Room for a matrix with so many diagonals below the main one.

        Raises:
            ShapeError: there is no compiled code (`available`).
        """
        code = _code()
        if code is None:
            raise ShapeError("banded systems are not compiled here; use `factorise`")
        self._code, self.size, self.band = code, size, band
        wide, tile = code.banded_wide(), code.banded_tile()
        self._blocked = -(-size // wide) * wide
        self.step = -(-(band + tile) // wide) * wide
        self._all = _aligned((self._blocked + 1) * (self.step + 1))
        self._all[:] = 0.0
        rows = self._all[: self._blocked * (self.step + 1)].reshape(self._blocked, -1)
        rows[size:, 0] = 1.0
        self.entries, self._padding = rows[:size], band + tile

    @staticmethod
    def available() -> bool:
        """Whether there is compiled code for this machine."""
        return _code() is not None

    def factorise(self, damping: float) -> StoredFactor:
        """Factor of the matrix plus `damping` on its diagonal; the matrix stays.

        Raises:
            SolverError: it is not positive definite.
        """
        factor = _aligned(len(self._all))
        failed = self._code.banded_factorise(
            self._all.ctypes.data, factor.ctypes.data, self._blocked, self.band, self.step, damping
        )
        if failed:
            raise SolverError("the fragment's Hessian is not positive definite")
        return StoredFactor(factor, self.size, self._solve)

    def _solve(self, factor: Array, right: Array) -> Array:
        x = np.zeros(self._blocked + self._padding)
        x[: self.size] = right
        self._code.banded_solve(
            factor.ctypes.data, x.ctypes.data, self._blocked, self.band, self.step
        )
        return x[: self.size]


@dataclass(frozen=True)
class StoredFactor:
    """A factorised `Store`, of which it keeps nothing but the layout."""

    _factor: Array
    _size: int
    _solved: Any

    def solve(self, right: Array) -> Array:
        """As `Factor.solve`."""
        if right.size != self._size:
            raise SolverError(f"{right.size} numbers for a system of {self._size}")
        return np.asarray(self._solved(self._factor, right.ravel()).reshape(right.shape))

    def solve_columns(self, right: Array) -> Array:
        """As `Factor.solve_columns`."""
        if right.ndim != 2 or len(right) != self._size:
            raise SolverError(f"right-hand sides {right.shape} for a system of {self._size}")
        out = np.empty(right.shape[::-1])
        for i, column in enumerate(np.ascontiguousarray(right.T)):
            out[i] = self._solved(self._factor, column)
        return out.T


def _aligned(count: int) -> Array:
    """Numbers, not set, from the beginning of a cache line."""
    raw = np.empty(count + 8)
    first = -raw.ctypes.data // raw.itemsize % 8
    return raw[first : first + count]


def _code() -> Any:
    """``banded.c`` compiled for this machine; None where it cannot be, or would be slower than LAPACK."""
    return None if os.environ.get(SWITCH) == "never" else _opened(cache_folder())


@lru_cache
def _opened(cache: Path) -> Any:
    """The same from one cache, tried once."""
    text = Path(__file__).with_name("banded.c").read_text(encoding="utf-8")

    def loaded(library: Path) -> Any:
        opened = ctypes.CDLL(str(library))
        pointer, count = ctypes.c_void_p, ctypes.c_longlong
        opened.banded_factorise.argtypes = [pointer, pointer, count, count, count, ctypes.c_double]
        opened.banded_factorise.restype = count
        opened.banded_solve.argtypes = [pointer, pointer, count, count, count]
        opened.banded_solve.restype = None
        return opened

    code = built(text, lambda: text, loaded, ("-O3", *native()), "banded") if native() else None
    return code if code is not None and code.banded_wide() else None
