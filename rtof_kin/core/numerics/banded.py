"""Symmetric banded systems: Cholesky factorisation, and diagonal blocks of the inverse.

`Factor.inverse_diagonal` is Takahashi's recursion by blocks (Rue & Held 2005, section 2.3.1) from the last block column
of the factor to the first. With G = L_below L_tt^-1, where L_below are the blocks of column t below the diagonal, and
Z_window the part of the inverse Z that couples with it::

    Z_below = -Z_window G             Z_tt = L_tt^-T L_tt^-1 - G^T Z_below
"""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import lapack

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.c_compiler import SWITCH, built, native
from rtof_kin.core.resources import cache_folder


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of a system of n unknowns."""

    band: Array  #: (w, n) in LAPACK's lower band storage
    _compiled: tuple[Store, Array] | None = None  #: The `Store` whose code made it, and all of its numbers

    def solve(self, right: Array) -> Array:
        """Return the solution in the shape of the right-hand side, n numbers in any shape; another size raises
        `SolverError`.
        """
        if right.size != self.band.shape[1]:
            raise SolverError(f"{right.size} numbers for a system of {self.band.shape[1]}")
        if self._compiled is not None:
            store, factor = self._compiled
            return np.asarray(store._solve(factor, right.ravel()).reshape(right.shape))
        x, info = lapack.dpbtrs(self.band, right.ravel(), lower=1)
        if info:
            raise SolverError("the banded system could not be solved")
        return np.asarray(x.reshape(right.shape))

    def forward_columns(self, right: Array) -> Array:
        """Return the inverse of the factor L times right-hand sides (n, k), else `SolverError`: half of a solution."""
        if right.ndim != 2 or len(right) != self.band.shape[1]:
            raise SolverError(f"right-hand sides {right.shape} for a system of {self.band.shape[1]}")
        if right.size == 0:
            return np.zeros(right.shape)
        if self._compiled is not None:
            store, factor = self._compiled
            return store._forward(factor, right)
        x, info = lapack.dtbtrs(self.band, right, uplo="L")
        if info:
            raise SolverError("the banded system could not be solved")
        return np.asarray(x)

    def inverse_diagonal(self, size: int, lags: int, first: int = 0) -> Array:
        """Return the diagonal blocks (N - first, size, size) of the matrix's inverse from the block `first` on, where a
        block is coupled with the next lags - 1; a band that does not fit raises `SolverError`.
        """
        width, unknowns = self.band.shape
        band, D = width - 1, size
        frames = unknowns // D
        if unknowns % D or band >= lags * D:
            raise SolverError(f"{unknowns} unknowns with a band of {band}: not {lags} blocks of {D}")
        if self._compiled is not None:
            store, factor = self._compiled
            return store._inverse(factor, D, first, frames)
        out, window = np.empty((frames - first, D, D)), np.zeros((lags * D,) * 2)
        for t in range(frames - 1, first - 1, -1):
            columns = np.zeros((lags * D, D))
            for c, column in enumerate(self.band[:, t * D : (t + 1) * D].T):
                columns[c : c + width, c] = column[: lags * D - c]
            columns[(frames - t) * D :] = 0.0  # where the band has no entries
            inverse, _ = lapack.dtrtri(columns[:D], lower=1)
            G = columns[D:] @ inverse
            above = window[:-D, :-D] @ G  # -Z_below
            own = inverse.T @ inverse + G.T @ above
            out[t - first] = (own + own.T) / 2  # else rounding errors grow from frame to frame
            window[D:, D:] = window[:-D, :-D]
            window[:D, :D], window[D:, :D] = out[t - first], -above
            window[:D, D:] = window[D:, :D].T
        return out


def factorise(band: Array) -> Factor:
    """Factorise a positive definite matrix (n, w), else `SolverError`, in place; row c is column c from its diagonal
    down.
    """
    factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
    if info or not np.isfinite(factor[0]).all():
        raise SolverError("the fragment's Hessian is not positive definite")
    return Factor(factor)


class Store:
    """A symmetric banded matrix of n unknowns in LAPACK's storage, factorised by compiled code or by LAPACK.

    Attributes:
        entries: (n, step + 1), row c is column c of the matrix from its diagonal downwards; entries below the band or
            the last row stay zero.
        step: entry (i, j) of the matrix is element i + j * step of the flat storage.
    """

    def __init__(self, size: int, band: int, compiled: bool = True) -> None:
        """Allocate a matrix of `size` unknowns with `band` diagonals below the main one, for compiled code where there
        is any.
        """
        self._code: Any = _code() if compiled else None
        self.size, self.band = size, band
        wide, tile = (8, 8) if self._code is None else (self._code.banded_wide(), self._code.banded_tile())
        self._blocked = -(-size // wide) * wide
        self.step = -(-(band + tile) // wide) * wide
        self._all = _aligned((self._blocked + 1) * (self.step + 1))
        self._all[:] = 0.0
        rows = self._all[: self._blocked * (self.step + 1)].reshape(self._blocked, -1)
        rows[size:, 0] = 1.0
        self.entries, self._padding = rows[:size], band + tile

    def factorise(self, damping: float) -> Factor:
        """Factorise the matrix, which is kept; one that is not positive definite raises `SolverError`."""
        if self._code is None:
            band = self.entries[:, : self.band + 1].copy()
            band[:, 0] += damping
            return factorise(band)
        factor = _aligned(len(self._all))
        failed = self._code.banded_factorise(
            self._all.ctypes.data, factor.ctypes.data, self._blocked, self.band, self.step, damping
        )
        if failed:
            raise SolverError("the fragment's Hessian is not positive definite")
        band = factor[: self.size * (self.step + 1)].reshape(self.size, -1).T[: self.band + 1]
        return Factor(band, (self, factor))

    def _solve(self, factor: Array, right: Array) -> Array:
        x = np.zeros(self._blocked + self._padding)
        x[: self.size] = right
        self._code.banded_solve(factor.ctypes.data, x.ctypes.data, self._blocked, self.band, self.step)
        return x[: self.size]

    def _inverse(self, factor: Array, block: int, first: int, count: int) -> Array:
        out, side = np.empty((count - first, block, block)), self._code.banded_side(self.band)
        space = np.empty(side * (side + self._code.banded_wide()))
        sizes = self._blocked, self.band, self.step, block, first, count
        self._code.banded_inverse(factor.ctypes.data, space.ctypes.data, out.ctypes.data, *sizes)
        return out

    def _forward(self, factor: Array, right: Array) -> Array:
        tile = self._code.banded_tile()
        x = np.zeros((-(-right.shape[1] // tile), self._blocked, tile))
        for own, first in zip(x, range(0, right.shape[1], tile), strict=True):
            part = right[:, first : first + tile]
            own[: self.size, : part.shape[1]] = part
            self._code.banded_forward(factor.ctypes.data, own.ctypes.data, self._blocked, self.band, self.step)
        return np.asarray(np.moveaxis(x[:, : self.size], 0, 1).reshape(self.size, -1)[:, : right.shape[1]])


def _aligned(count: int) -> Array:
    """Return uninitialised numbers aligned to a cache line."""
    raw = np.empty(count + 8)
    first = -raw.ctypes.data // raw.itemsize % 8
    return raw[first : first + count]


def _code() -> Any:
    """Return ``banded.c`` compiled for this machine; None if impossible or slower than LAPACK."""
    return None if os.environ.get(SWITCH) == "never" else _opened(cache_folder())


@lru_cache
def _opened(cache: Path) -> Any:
    """Return the library of one cache folder; tried once per folder."""
    del cache  # the key of `lru_cache`
    text = Path(__file__).with_name("banded.c").read_text(encoding="utf-8")

    def loaded(library: Path) -> Any:
        opened = ctypes.CDLL(str(library))
        kinds = {"p": ctypes.c_void_p, "n": ctypes.c_longlong, "x": ctypes.c_double}
        given = {"factorise": "ppnnnx", "side": "n", "inverse": "pppnnnnnn", "solve": "ppnnn", "forward": "ppnnn"}
        for name, arguments in given.items():
            function = getattr(opened, f"banded_{name}")
            function.argtypes, function.restype = [kinds[kind] for kind in arguments], ctypes.c_longlong
        return opened

    code = built(text, lambda: text, loaded, ("-O3", *native()), "banded") if native() else None
    return code if code is not None and code.banded_wide() else None
