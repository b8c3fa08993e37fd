"""How large errors of a kind are, learned from the recording: empirical Bayes for the unknowns' priors.

A prior says how large biases usually are. A recording whose landmarks are where they belong shows it: all
estimates are then smaller than that prior makes likely. What of them nobody observed (a bias away from
the middle of the picture looks like a person who stands nearer) is believed no more than what was.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_ROUNDS = 30
_ENOUGH = 1e-3
_LEAST = 0.05
"""Share of a prior's variance that is always left."""
_NOTHING = 1e-9
"""Size of estimates that nothing was seen of: they are as they should be."""


def learned_precision(
    given: Array, information: Array, slope: Array, y: Array, shrinking: Sequence[slice],
    overcount: float,
) -> Array:  # fmt: skip
    """The precision of the prior with which estimates are as large as they should be.

    With information D and precision P the estimate is A times the truth plus noise, A = (P + D)^-1 D; if
    errors that last make D count k times too much, its covariance is A P^-1 A^T + k A (P + D)^-1. The
    prior's variance of each kind is multiplied until its estimates are of that size (by moments; Morris
    1983).

    Args:
        given: (G, G) precision of the prior before. information: (G, G) the data's Hessian at y.
        slope: (G,) gradient of the data's energy at y (G,).
        shrinking: columns of the kinds that may turn out smaller.
        overcount: k.

    Returns:
        (G, G) `given` with the blocks of those kinds divided by their share, from 0.05 to 1.
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
    """Sum of squares of one kind, in variances of its prior; a little where there is nothing."""
    return float(np.diag(given)[own] @ squares[own]) + _NOTHING
