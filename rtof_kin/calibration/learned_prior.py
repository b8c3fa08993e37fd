"""Variance of a kind of error, learned from the recording: empirical Bayes for the unknowns' priors.

With small errors all estimates are smaller than their prior makes likely; a smaller prior also limits the
estimates of unobserved combinations (a radial bias looks like a nearer person).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array

_ROUNDS: Final = 30
_ENOUGH: Final = 1e-3
_LEAST: Final = 0.05
"""Smallest share of a prior's variance."""
_NOTHING: Final = 1e-9
"""Added to sums of squares, so that unobserved estimates have a ratio of 1."""


def learned_precision(
    given: Array, information: Array, slope: Array, y: Array, shrinking: Sequence[slice], overcount: float
) -> Array:
    """Return the precision (G, G) of the prior that matches the size of the estimates.

    With information D and precision P the estimate is A times the truth plus noise, A = (P + D)^-1 D; if
    autocorrelated errors make D k times too large, its covariance is A P^-1 A^T + k A (P + D)^-1. The prior's variance
    of each kind is multiplied, by 0.05 to 1, until its estimates are of that size (by moments; Morris 1983).

    Args:
        given: (G, G) precision before. information: (G, G) the data's Hessian at y.
        slope: (G,) gradient of the data's energy at y (G,). shrinking: columns of the kinds that may shrink.
    """
    shares, precision = np.ones(len(shrinking)), given
    for _ in range(_ROUNDS if shrinking else 0):
        inverse = np.linalg.inv(information + precision)
        estimate = y - inverse @ (slope + precision @ y)
        A = inverse @ information
        expected = np.diag(A @ np.linalg.inv(precision) @ A.T + overcount * A @ inverse)
        before = shares
        ratios = [_size(given, estimate**2, own) / _size(given, expected, own) for own in shrinking]
        shares = (before * ratios).clip(_LEAST, 1.0)
        precision = given.copy()
        for share, own in zip(shares, shrinking, strict=True):
            precision[own, own] /= share
        if np.all(np.abs(shares - before) < _ENOUGH):
            break
    return precision


def _size(given: Array, squares: Array, own: slice) -> float:
    """Sum of squares of one kind, in variances of its prior."""
    return float(np.diag(given)[own] @ squares[own]) + _NOTHING
