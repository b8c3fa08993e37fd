"""The inflation that scores best on reconstructions of known motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import ndtr

from benchmarks.confidence.cases import Case, Errors, errors
from rtof_kin.core.array_types import Array
from rtof_kin.solve.uncertainty.covariance_inflation import (
    OTHER,
    SEEN,
    WHITE_FACTOR,
    CovarianceInflation,
    Widening,
    correlated_factor,
    seen_by,
    unsided,
)

_LEAST = {"position": 1e-3, "relative": 1e-4, "turn": np.radians(0.1)}
"""Floors begin there: nothing is known better."""
_LARGEST_SHARE = 2.0
_MOST = 20_000
"""Errors that the share, one number, is found by."""
_NOTHING = 1e-9
"""m or rad: keeps a standard deviation positive where neither the model nor the recording has any."""


@dataclass(frozen=True)
class _Sample:
    """Errors (n, 3) of one quantity in one recording, along axes in which they are independent."""

    error: Array
    variance: Array
    """(n, 3) of the Hessian."""
    lasting: Array
    """(n, 3) `ResidualStatistics.autocorrelation`."""
    doubt: Array
    """(n, 3) `ResidualStatistics.torso_factor`."""
    apart: Array
    """(n, 3) mean square of the solution's difference from its start."""


def fitted(cases: Sequence[Case]) -> CovarianceInflation:
    """One widening for every joint and every pair by who saw it, right and left together."""
    found: dict[tuple[str, str], dict[str, list[_Sample]]] = defaultdict(lambda: defaultdict(list))
    for case in cases:
        stated = case.circumstances
        for kind, name, both in errors(case):
            if len(both.error):
                who = seen_by(kind, name, case.motion.skeleton.root, stated.sensors)
                sample = _sample(kind, both, stated.autocorrelation, stated.torso_factor(kind, who))
                found[who, kind][unsided(name)].append(sample)
    widenings: dict[str, dict[str, dict[str, Widening]]] = {who: {} for who in SEEN}
    shares: dict[str, dict[str, float]] = {who: {} for who in SEEN}
    for who, kinds in SEEN.items():
        for kind in kinds:
            own = found[who, kind]
            everything = [sample for parts in own.values() for sample in parts]
            share = shares[who][kind] = _share(kind, everything)
            widenings[who][kind] = {name: _fitted(kind, parts, share) for name, parts in own.items()}
            widenings[who][kind][OTHER] = _fitted(kind, everything, share)
    return CovarianceInflation(widenings, shares)


def _sample(kind: str, both: Errors, lasting: float, doubt: float) -> _Sample:
    """Turns by the segment's axes, positions along those of the covariance, of which one is depth."""
    if kind == "turn":
        error, variance = both.error, np.diagonal(both.covariance, axis1=1, axis2=2)
        apart = np.diagonal(both.apart, axis1=1, axis2=2)
    else:
        variance, axes = np.linalg.eigh(both.covariance)
        error = np.einsum("nij,ni->nj", axes, both.error)
        apart = np.einsum("nij,nik,nkj->nj", axes, both.apart, axes)
    shape = error.shape
    return _Sample(error, np.maximum(variance, 0.0), np.full(shape, lasting), np.full(shape, doubt), apart)


def _joined(own: Sequence[_Sample]) -> list[Array]:
    """(N, 3) of every field of many samples."""
    return [np.concatenate([getattr(one, field.name) for one in own]) for field in fields(_Sample)]


def _share(kind: str, own: Sequence[_Sample]) -> float:
    """The share of all errors of one kind together: it scores best with one factor and one floor."""
    values = [value.ravel() for value in _joined(own)]
    values = [value[:: 1 + len(value) // _MOST] for value in values]  # they are much alike
    found = minimize_scalar(
        lambda share: sharpest(*values[:4], share**2 * values[4], least=_LEAST[kind])[2],
        bounds=(0.0, _LARGEST_SHARE), method="bounded", options={"xatol": 0.05},
    )  # fmt: skip
    return float(found.x)


def _fitted(kind: str, own: Sequence[_Sample], share: float) -> Widening:
    """Fit one quantity: positions by one factor and one floor, rotations by one per axis."""
    *values, apart = _joined(own)
    values.append(share**2 * apart)
    if kind == "turn":
        found = [sharpest(*(value[:, i] for value in values), least=_LEAST[kind])[:2] for i in range(3)]
    else:
        found = [sharpest(*(value.ravel() for value in values), least=_LEAST[kind])[:2]]
    factor, floor = np.transpose(found)
    return Widening(factor, floor) if kind == "turn" else Widening(factor[0], floor[0])


def sharpest(
    error: Array, variance: Array, lasting: Array, doubt: Array, more: Array, least: float
) -> tuple[float, float, float]:
    """Fit the factor k >= 1 and the floor b >= least of normal errors (n,), and with their score.

    The variance is ``K^2 variance + B^2 + more``, see `rtof_kin.solve.uncertainty.covariance_inflation`; the
    score is the continuous ranked probability (Gneiting & Raftery 2007, eq. 21), robust to outliers.
    """
    size, expected = np.sqrt(np.mean(error**2)) + least, np.sqrt(np.mean(variance))
    free = expected > 1e-6  # else the model has no such freedom, and the factor no meaning

    def score(logs: Array) -> tuple[float, Array]:
        """The mean score, and its derivatives by the logarithms of factor and floor."""
        k, b = np.exp(logs)
        factor, floor = correlated_factor(k, lasting), b * lasting * doubt
        sigma = np.sqrt(factor**2 * variance + floor**2 + more) + _NOTHING
        z = error / sigma
        ranked = sigma * (z * (2 * ndtr(z) - 1) + (np.sqrt(2) * np.exp(-(z**2) / 2) - 1) / np.sqrt(np.pi))
        by_sigma = (np.sqrt(2) * np.exp(-(z**2) / 2) - 1) / np.sqrt(np.pi) / sigma
        slope = 1.0 + (k > WHITE_FACTOR) * (lasting - 1.0)  # of the factor by k
        by_factor = factor * variance * k * slope
        rates = [np.mean(by_sigma * by_factor), np.mean(by_sigma * floor**2)]
        return float(np.mean(ranked) / size), np.array(rates) / size

    bounds = [(0.0, np.log(30.0) if free else 0.0), (np.log(least), np.log(10 * size))]
    starts = [(0.0, np.log(size))]
    if free:
        starts.append((np.log(np.clip(size / expected, 1.0, 20.0)), np.log(max(least, size / 3))))
    found = min(
        (minimize(score, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts),
        key=lambda result: float(result.fun),
    )
    factor, floor = np.exp(found.x)
    return float(factor), float(floor), float(found.fun)
