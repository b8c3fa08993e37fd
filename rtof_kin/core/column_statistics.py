"""Statistics of columns that arrive block after block, in bounded memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import ShapeError

KEPT_ROWS = 20_000
"""Largest number of rows kept for medians; beyond it every second row is dropped, evenly over time."""


class ColumnStatistics:
    """Mean, RMS, largest value with its time, and median of each of K columns; NaN does not count.

    Medians are exact up to `KEPT_ROWS` rows, then those of evenly spaced rows.
    """

    def __init__(self, columns: int, medians: bool = True) -> None:
        """Begin without rows."""
        self._medians = medians
        self.known = np.zeros(columns, dtype=np.int64)
        """(K,) number of finite values."""
        self.largest, self.largest_at = np.full(columns, np.nan), np.full(columns, np.nan)
        """(K,) largest values, and their times; NaN where nothing is known."""
        self._sum, self._squares = np.zeros(columns), np.zeros(columns)
        self._kept: list[Array] = []
        self._rows, self._step = 0, 1

    def add(self, times: Array, values: NDArray[Any]) -> None:
        """Add rows.

        Args:
            times: (T,) s. values: (T, K), numbers or a mask.

        Raises:
            ShapeError: another number of columns or rows.
        """
        if values.shape != (len(times), len(self.known)):
            raise ShapeError(f"statistics: expected ({len(times)}, {len(self.known)}), got {values.shape}")
        finite = np.isfinite(values)
        plain = np.where(finite, values, 0.0)
        self.known += finite.sum(axis=0)
        self._sum += plain.sum(axis=0)
        self._squares += (plain**2).sum(axis=0)
        if len(times):
            rows = np.where(finite, values, -np.inf).argmax(axis=0)
            top = values[rows, np.arange(values.shape[1])]
            better = np.isfinite(top) & ~(top <= self.largest)
            self.largest[better], self.largest_at[better] = top[better], times[rows[better]]
        if not self._medians:
            return
        self._kept.append(np.array(values[-self._rows % self._step :: self._step], dtype=float))
        self._rows += len(times)
        while -(-self._rows // self._step) > KEPT_ROWS:
            self._kept = [np.concatenate(self._kept)[::2].copy()]
            self._step *= 2

    @property
    def mean(self) -> Array:
        """(K,) means; NaN where nothing is known."""
        return _divided(self._sum, self.known)

    @property
    def rms(self) -> Array:
        """(K,) roots of the mean squares; NaN where nothing is known."""
        return np.asarray(np.sqrt(_divided(self._squares, self.known)))

    @property
    def mean_of_all(self) -> float:
        """Mean of all values; NaN where nothing is known."""
        return float(_divided(self._sum.sum(), self.known.sum()))

    @property
    def rms_of_all(self) -> float:
        """Root of the mean square of all values; NaN where nothing is known."""
        return float(np.sqrt(_divided(self._squares.sum(), self.known.sum())))

    @property
    def median(self) -> Array:
        """(K,) medians; NaN where nothing is known."""
        out, rows = np.full(len(self.known), np.nan), self._values()
        some = np.isfinite(rows).any(axis=0)
        out[some] = np.nanmedian(rows[:, some], axis=0)
        return out

    @property
    def median_of_all(self) -> float:
        """Median of all values; NaN where nothing is known."""
        rows = self._values()
        return float(np.nanmedian(rows)) if np.isfinite(rows).any() else float("nan")

    def _values(self) -> Array:
        return np.concatenate([np.empty((0, len(self.known))), *self._kept])


def _divided(sums: NDArray[Any], counts: NDArray[Any]) -> Array:
    some = counts > 0
    return np.where(some, sums / np.where(some, counts, 1), np.nan)
