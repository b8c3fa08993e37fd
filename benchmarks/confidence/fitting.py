"""The inflation with which errors are likeliest, from reconstructions of known motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

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
        columns = [likeliest(error[:, i], variance[:, i], _LEAST[kind]) for i in range(3)]
        factor, floor = np.transpose(columns)
        return Widening(factor, floor)
    # Along the axes of the covariance, of which one is depth.
    variance, axes = np.linalg.eigh(covariance)
    along = np.einsum("nij,ni->nj", axes, error)
    factor, floor = likeliest(along.ravel(), variance.ravel(), _LEAST[kind])
    return Widening(np.full(3, factor), np.full(3, floor))


def likeliest(error: Array, variance: Array, least: float) -> tuple[float, float]:
    """Factor k and floor b of normal errors (n,) whose variance is ``k^2 variance + b^2``, b >= least."""

    def energy(logs: Array) -> float:
        total = np.exp(2 * logs[0]) * variance + np.exp(2 * logs[1])
        return float(np.mean(np.log(total) + error**2 / total))

    size, expected = np.sqrt(np.mean(error**2)) + least, np.sqrt(np.mean(variance))
    if expected < 1e-6:  # the model has no such freedom
        return 1.0, float(size)
    bounds = [(0.0, np.log(30.0)), (np.log(least), np.log(10 * size))]
    starts = [(np.log(np.clip(size / expected, 1.0, 20.0)), np.log(max(least, size / 3)))]
    starts.append((0.0, np.log(max(least, size))))
    found = min(
        (minimize(energy, start, method="L-BFGS-B", bounds=bounds) for start in starts),
        key=lambda result: float(result.fun),
    )
    factor, floor = np.exp(found.x)
    return float(factor), float(floor)
