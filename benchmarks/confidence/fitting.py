"""The inflation that scores best on reconstructions of known motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import norm

from benchmarks.confidence.cases import Case, Errors, errors
from rtof_kin.inflation import OTHER, SEEN, Inflation, Widening, seen_by, unsided

Array = NDArray[np.float64]
_LEAST = {"position": 1e-3, "relative": 1e-4, "turn": np.radians(0.1)}
"""Floors begin there: nothing is known better."""


def fitted(cases: Sequence[Case]) -> Inflation:
    """One widening for every joint and every pair by who saw it, right and left together."""
    found: dict[tuple[str, str], dict[str, list[Errors]]] = defaultdict(lambda: defaultdict(list))
    for case in cases:
        for kind, name, both in errors(case):
            if len(both.error):
                who = seen_by(kind, name, case.motion.skeleton.root, case.carriers)
                found[who, kind][unsided(name)].append(both)
    widenings: dict[str, dict[str, dict[str, Widening]]] = {who: {} for who in SEEN}
    for who, kinds in SEEN.items():
        for kind in kinds:
            own = found[who, kind]
            widenings[who][kind] = {name: _fitted(kind, parts) for name, parts in own.items()}
            everything = [both for parts in own.values() for both in parts]
            widenings[who][kind][OTHER] = _fitted(kind, everything)
    return Inflation(widenings)


def _fitted(kind: str, own: Sequence[Errors]) -> Widening:
    """Of one quantity: positions by one factor and one floor, turns by one of each axis."""
    error = np.concatenate([both.error for both in own])
    covariance = np.concatenate([both.covariance for both in own])
    if kind == "turn":
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        columns = [sharpest(error[:, i], variance[:, i], _LEAST[kind]) for i in range(3)]
        factor, floor = np.transpose(columns)
        return Widening(factor, floor)
    # Along the axes of the covariance, of which one is depth.
    variance, axes = np.linalg.eigh(covariance)
    along = np.einsum("nij,ni->nj", axes, error)
    factor, floor = sharpest(along.ravel(), variance.ravel(), _LEAST[kind])
    return Widening(np.full(3, factor), np.full(3, floor))


def sharpest(error: Array, variance: Array, least: float) -> tuple[float, float]:
    """Factor k >= 1 and floor b >= least with which normal errors (n,) of the variance
    ``k^2 variance + b^2`` score best by their continuous ranked probability (Gneiting & Raftery 2007,
    eq. 21): a proper score, in which a recording far out counts by its distance, not its square."""
    size, expected = np.sqrt(np.mean(error**2)) + least, np.sqrt(np.mean(variance))
    free = expected > 1e-6  # else the model has no such freedom, and the factor no meaning

    def score(logs: Array) -> float:
        sigma = np.sqrt(np.exp(2 * logs[0]) * variance + np.exp(2 * logs[1]))
        z = error / sigma
        ranked = sigma * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
        return float(np.mean(ranked) / size)

    bounds = [(0.0, np.log(30.0) if free else 0.0), (np.log(least), np.log(10 * size))]
    starts = [(0.0, np.log(size))]
    if free:
        starts.append((np.log(np.clip(size / expected, 1.0, 20.0)), np.log(max(least, size / 3))))
    found = min(
        (minimize(score, start, method="L-BFGS-B", bounds=bounds) for start in starts),
        key=lambda result: float(result.fun),
    )
    factor, floor = np.exp(found.x)
    return float(factor), float(floor)
