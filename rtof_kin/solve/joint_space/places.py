"""Places of a detector's points in the segments of the person, from the residuals of a solved recording.

Each point has one constant offset o from its usual place, with the spread between persons as its prior:

::

    min_o  1/2 sum_t w_t |r_t - J_t o|^2 / (k sigma^2) + 1/2 o^T P^-1 o

r are the residuals (observed minus projected), J their slopes by the place, w robust weights, sigma the
standard deviation of a residual, and k the number of frames in a row that count as one, from the
residuals' autocorrelation. What the poses have already taken up of an offset stays there.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array, Mask

_NORMAL_MEDIAN: Final = 1.177
"""Median norm of a normal error in two dimensions, in standard deviations of an axis."""
_ROBUST: Final = 2.0
"""[sigma] Residual where the loss turns from square to linear."""
_LEAST_CORRELATION: Final = 0.05
"""Autocorrelation at which its sum ends."""


def estimated_places(residuals: Array, slopes: Array, weights: Array, covariance: Array) -> Array:
    """Return offsets (L, 3) of the points from their usual places, m.

    Args:
        residuals: (T, L, 2) observed minus projected, px. slopes: (T, L, 2, 3) px/m.
        weights: (T, L) of the observations, 0 where unseen. covariance: (L, 3, 3) of the places, m^2.
    """
    offsets = np.zeros((len(covariance), 3))
    for i, own in enumerate(covariance):
        seen = weights[:, i] > 0
        if not seen.any() or not own.any():
            continue
        r, J = residuals[:, i], slopes[:, i]
        size = max(float(np.median(np.linalg.norm(r[seen], axis=-1))) / _NORMAL_MEDIAN, 1e-6)
        robust = 1 / np.sqrt(1 + np.sum(r**2, axis=-1) / (_ROBUST * size) ** 2)
        w = np.where(seen, robust, 0.0) / (_frames_as_one(r, seen) * size**2)
        information = np.einsum("t,tik,til->kl", w, J, J)
        force = np.einsum("t,tik,ti->k", w, J, r)
        offsets[i] = np.linalg.solve(information + np.linalg.inv(own), force)
    return offsets


def _frames_as_one(residuals: Array, seen: Mask) -> float:
    """Number of frames in a row with the information of one: 1 + 2 sum of the autocorrelations.

    Args:
        residuals: (T, 2). seen: (T,).
    """
    x = np.where(seen[:, None], residuals - np.median(residuals[seen], axis=0), 0.0)
    transform = np.fft.rfft(x, 2 * len(x), axis=0)
    together = np.fft.rfft(seen.astype(float), 2 * len(x))
    product = np.fft.irfft((np.abs(transform) ** 2).sum(axis=1))[: len(x)]
    pairs = np.fft.irfft(np.abs(together) ** 2)[: len(x)]
    correlation = product / np.maximum(pairs, 1.0) / max(product[0] / pairs[0], 1e-12)
    low = np.flatnonzero(correlation < _LEAST_CORRELATION)
    stop = low[0] if len(low) else len(x)
    return float(1 + 2 * correlation[1:stop].sum())
