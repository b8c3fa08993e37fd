"""Scores of stated errors: ROC, calibration, rank correlation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc
from scipy.stats import chi2, rankdata

from rtof_kin.core.array_types import Array, Mask

Ints = NDArray[np.int64]
NOMINAL = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)
_BINS = 10


def area(score: Array, bad: Mask) -> float:
    """Area under the ROC curve: how often a bad one has the larger score, ties half; NaN where all or
    none is bad.

    Args:
        score: (n,). bad: (n,).
    """
    n = int(bad.sum())
    if n in (0, len(bad)):
        return float("nan")
    return float((rankdata(score)[bad].sum() - n * (n + 1) / 2) / (n * (len(bad) - n)))


def area_within(score: Array, bad: Mask, stratum: Ints) -> float:
    """The same counting only pairs of one stratum (n,) of whole numbers."""
    won, pairs = 0.0, 0
    for own in _strata(stratum):
        n = int(bad[own].sum()) * int((~bad[own]).sum())
        if n:
            won, pairs = won + n * area(score[own], bad[own]), pairs + n
    return won / pairs if pairs else float("nan")


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's, of (n,) and (n,); NaN where one of them is constant."""
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def rank_correlation_within(a: Array, b: Array, stratum: Ints) -> float:
    """Its mean over strata, weighted by their sizes."""
    found = [(rank_correlation(a[own], b[own]), len(own)) for own in _strata(stratum)]
    known = [(value, weight) for value, weight in found if np.isfinite(value)]
    if not known:
        return float("nan")
    values, weights = np.transpose(known)
    return float(np.average(values, weights=weights))


def _strata(stratum: Ints) -> list[Ints]:
    order = np.argsort(stratum, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(stratum[order])) + 1)


def probability_above(threshold: float, sigma: Array, freedom: Array) -> Array:
    """That an error's size is larger than a threshold, as stated: its square is nearly
    ``sigma^2 / freedom`` times a chi-square variable."""
    return np.asarray(gammaincc(freedom / 2, threshold**2 * freedom / (2 * sigma**2)))


def calibration(probability: Array, bad: Mask) -> list[tuple[float, float, int]]:
    """Mean probability stated, share that is bad, and count, in tenths of the probability."""
    bins = np.minimum((probability * _BINS).astype(int), _BINS - 1)
    found = []
    for k in range(_BINS):
        own = bins == k
        if own.any():
            found.append((float(probability[own].mean()), float(bad[own].mean()), int(own.sum())))
    return found


def calibration_error(probability: Array, bad: Mask) -> float:
    """Expected calibration error: the mean difference of what is stated and what is."""
    table = np.array(calibration(probability, bad))
    return float(np.average(np.abs(table[:, 0] - table[:, 1]), weights=table[:, 2]))


def quantile(share: float, freedom: Array) -> Array:
    """Quantiles of chi-square variables, interpolated between a thousand degrees of freedom."""
    known = np.linspace(0.9, 3.1, 1000)
    return np.asarray(np.interp(freedom, known, chi2.ppf(share, known)))


def interval_error(error: Array, sigma: Array, freedom: Array) -> float:
    """The mean difference of the shares that intervals are meant to cover and that they cover."""
    covered = [np.mean(error**2 * freedom / sigma**2 <= quantile(share, freedom)) - share for share in NOMINAL]
    return float(np.mean(np.abs(covered)))


def bootstrap(units: Ints, figure: Callable[[Ints], float], draws: int = 60) -> tuple[float, float]:
    """95 % interval of a figure when units are drawn anew.

    Args:
        units: (n,) which unit each sample is of. figure: of the samples (m,) with these indices.
    """
    own = _strata(units)
    rng, found = np.random.default_rng(0), []
    for _ in range(draws):
        drawn = rng.integers(len(own), size=len(own))
        found.append(figure(np.concatenate([own[k] for k in drawn])))
    known = [value for value in found if np.isfinite(value)]
    if not known:
        return float("nan"), float("nan")
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)


def roc(score: Array, bad: Mask, points: int = 101) -> tuple[Sequence[float], Sequence[float]]:
    """False and true positive rates of the ROC curve at that many thresholds."""
    false = np.linspace(0, 1, points)
    cut = np.quantile(score[~bad], 1 - false)
    order = np.sort(score[bad])
    true = 1 - np.searchsorted(order, cut, side="left") / max(len(order), 1)
    return false.tolist(), true.tolist()
