"""The inflation that scores best on reconstructions of known motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtr

from benchmarks.confidence.cases import Case, Errors, errors
from rtof_kin.inflation import OTHER, SEEN, Inflation, Widening, factor_where, seen_by, unsided

Array = NDArray[np.float64]
_LEAST = {"position": 1e-3, "relative": 1e-4, "turn": np.radians(0.1)}
"""Floors begin there: nothing is known better."""
_NOTHING = 1e-9
"""m or rad: keeps a standard deviation positive where neither the model nor the recording has any."""


@dataclass(frozen=True)
class _Sample:
    """Errors (n, 3) of one quantity in one recording, along axes in which they are independent."""

    error: Array
    variance: Array
    """(n, 3) of the Hessian."""
    lasting: Array
    """(n, 3) `Circumstances.lasting`."""
    doubt: Array
    """(n, 3) `Circumstances.doubt`."""


def fitted(cases: Sequence[Case]) -> Inflation:
    """One widening for every joint and every pair by who saw it, right and left together."""
    found: dict[tuple[str, str], dict[str, list[_Sample]]] = defaultdict(lambda: defaultdict(list))
    for case in cases:
        told = case.circumstances
        for kind, name, both in errors(case):
            if len(both.error):
                who = seen_by(kind, name, case.motion.skeleton.root, told.sensors)
                sample = _sample(kind, both, told.lasting, told.doubt(kind, who))
                found[who, kind][unsided(name)].append(sample)
    widenings: dict[str, dict[str, dict[str, Widening]]] = {who: {} for who in SEEN}
    for who, kinds in SEEN.items():
        for kind in kinds:
            own = found[who, kind]
            widenings[who][kind] = {name: _fitted(kind, parts) for name, parts in own.items()}
            everything = [sample for parts in own.values() for sample in parts]
            widenings[who][kind][OTHER] = _fitted(kind, everything)
    return Inflation(widenings)


def _sample(kind: str, both: Errors, lasting: float, doubt: float) -> _Sample:
    """Turns by the segment's axes, positions along those of the covariance, of which one is depth."""
    if kind == "turn":
        error, variance = both.error, np.diagonal(both.covariance, axis1=1, axis2=2)
    else:
        variance, axes = np.linalg.eigh(both.covariance)
        error = np.einsum("nij,ni->nj", axes, both.error)
    return _Sample(
        error, np.maximum(variance, 0.0), np.full(error.shape, lasting), np.full(error.shape, doubt)
    )


def _fitted(kind: str, own: Sequence[_Sample]) -> Widening:
    """Of one quantity: positions by one factor and one floor, turns by one of each axis."""
    fields = ("error", "variance", "lasting", "doubt")
    values = [np.concatenate([getattr(sample, field) for sample in own]) for field in fields]
    if kind == "turn":
        found = [sharpest(*(value[:, i] for value in values), least=_LEAST[kind]) for i in range(3)]
    else:
        found = [sharpest(*(value.ravel() for value in values), least=_LEAST[kind])]
    factor, floor = np.transpose(found)
    return Widening(factor, floor) if kind == "turn" else Widening(factor[0], floor[0])


def sharpest(
    error: Array, variance: Array, lasting: Array, doubt: Array, least: float
) -> tuple[float, float]:
    """Factor k >= 1 and floor b >= least with which normal errors (n,) of the widened variance
    ``K^2 variance + B^2`` (`rtof_kin.inflation`) score best by their continuous ranked probability
    (Gneiting & Raftery 2007, eq. 21): a proper score, in which a recording far out counts by its
    distance, not its square."""
    size, expected = np.sqrt(np.mean(error**2)) + least, np.sqrt(np.mean(variance))
    free = expected > 1e-6  # else the model has no such freedom, and the factor no meaning

    def score(logs: Array) -> float:
        factor, floor = factor_where(np.exp(logs[0]), lasting), np.exp(logs[1]) * lasting * doubt
        sigma = np.sqrt(factor**2 * variance + floor**2) + _NOTHING
        z = error / sigma
        ranked = sigma * (z * (2 * ndtr(z) - 1) + (np.sqrt(2) * np.exp(-(z**2) / 2) - 1) / np.sqrt(np.pi))
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
