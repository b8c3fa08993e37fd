"""Errors of one curve against another: RMSE, MAE, median, without offset, largest, correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.core.array_types import Array


@dataclass(frozen=True)
class CurveErrors:
    """Differences d = B - A of two curves over their common samples, rad."""

    rmse: float
    """Root mean square of d."""
    mae: float
    """Mean of its size."""
    median: float
    """Median of its size."""
    offset_removed: float
    """Root mean square of d without its mean."""
    largest: float
    """Difference of the largest size, with its sign."""
    at: float
    """Place of it on the axis: s, or share of the cycle or repetition."""
    correlation: float
    """Pearson's, of the curves; NaN if one is constant."""


def curve_errors(axis: Array, a: Array, b: Array) -> CurveErrors:
    """Compare two curves where both are known.

    Args:
        axis: (P,) of the samples. a, b: (P,) rad, with at least one common sample.
    """
    known = np.isfinite(a) & np.isfinite(b)
    difference = (b - a)[known]
    worst = int(np.abs(difference).argmax())
    return CurveErrors(
        rmse=float(np.sqrt(np.mean(difference**2))),
        mae=float(np.mean(np.abs(difference))),
        median=float(np.median(np.abs(difference))),
        offset_removed=float(np.std(difference)),
        largest=float(difference[worst]),
        at=float(axis[known][worst]),
        correlation=_correlation(a[known], b[known]),
    )


def _correlation(a: Array, b: Array) -> float:
    own, other = a - a.mean(), b - b.mean()
    size = float(np.sqrt(np.sum(own**2) * np.sum(other**2)))
    return float(np.sum(own * other) / size) if size > 1e-12 else float("nan")
