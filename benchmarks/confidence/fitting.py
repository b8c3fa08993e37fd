"""The inflation that scores best on reconstructions of known motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr

from benchmarks.confidence.cases import Case, Errors, errors
from rtof_kin.core.array_types import Array
from rtof_kin.solve.uncertainty import (
    DEPTHS,
    OTHER,
    SEEN,
    SHARES,
    UNITS,
    WHITE_FACTOR,
    CovarianceInflation,
    Widening,
    correlated_factor,
    seen_by,
    unsided,
)

_LEAST = {"position": 1e-3, "relative": 1e-4, "turn": np.radians(0.1)}
"""Floors begin there: nothing is known better."""
_MOST = 10_000
"""Errors, of three axes, that the factors of all joints together are found by."""
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
    shared: Array
    """(n, 3, p) what all joints have in common, for factors of 1: the mean square of the solution's
    difference from its start; of positions in world also the distance's."""


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
    depths: dict[str, float] = {}
    for who, kinds in SEEN.items():
        for kind in kinds:
            own = found[who, kind]
            everything = [sample for parts in own.values() for sample in parts]
            common = _shares(kind, everything)
            shares[who][kind] = float(common[0])
            if kind == "position":
                depths[who] = float(common[1])
            widenings[who][kind] = {name: _fitted(kind, parts, common) for name, parts in own.items()}
            widenings[who][kind][OTHER] = _fitted(kind, everything, common)
    return CovarianceInflation(widenings, shares, depths)


def _sample(kind: str, both: Errors, lasting: float, doubt: float) -> _Sample:
    """Turns by the segment's axes, positions along those of the covariance, of which one is depth."""
    shared = [both.apart] if both.depth is None else [both.apart, lasting**2 * both.depth]
    if kind == "turn":
        error, variance = both.error, np.diagonal(both.covariance, axis1=1, axis2=2)
        along = [np.diagonal(part, axis1=1, axis2=2) for part in shared]
    else:
        variance, axes = np.linalg.eigh(both.covariance)
        error = np.einsum("nij,ni->nj", axes, both.error)
        along = [np.einsum("nij,nik,nkj->nj", axes, part, axes) for part in shared]
    shape = error.shape
    return _Sample(
        error, np.maximum(variance, 0.0), np.full(shape, lasting), np.full(shape, doubt), np.stack(along, axis=-1)
    )


def _joined(own: Sequence[_Sample]) -> list[Array]:
    """(N, 3, ...) of every field of many samples."""
    return [np.concatenate([getattr(one, field.name) for one in own]) for field in fields(_Sample)]


def _shares(kind: str, own: Sequence[_Sample]) -> Array:
    """The factors (p,) of what all joints have in common: they score best with one factor and one floor."""
    *values, shared = (value[:: 1 + len(value) // _MOST] for value in _joined(own))  # they are much alike
    flat = shared.reshape(-1, shared.shape[-1])
    return sharpest(*(value.ravel() for value in values), least=_LEAST[kind], shared=flat)[2:]


def _fitted(kind: str, own: Sequence[_Sample], common: Array) -> Widening:
    """Fit one quantity: positions by one factor and one floor, rotations by one per axis."""
    *values, shared = _joined(own)
    axes = [slice(i, i + 1) for i in range(3)] if kind == "turn" else [slice(None)]
    found = [
        sharpest(
            *(value[:, axis].ravel() for value in values),
            least=_LEAST[kind],
            more=(shared[:, axis] @ common**2).ravel(),
        )
        for axis in axes
    ]
    factor, floor = np.transpose(found)
    return Widening(factor, floor) if kind == "turn" else Widening(factor[0], floor[0])


def sharpest(
    error: Array,
    variance: Array,
    lasting: Array,
    doubt: Array,
    *,
    least: float,
    shared: Array | None = None,
    more: Array | float = 0.0,
) -> Array:
    """Fit the factor k >= 1, the floor b >= least and the factors a of `shared` of normal errors (n,).

    The variance is ``K^2 variance + B^2 + a^2 shared + more``, see
    `rtof_kin.solve.uncertainty`; the score is the continuous ranked probability
    (Gneiting & Raftery 2007, eq. 21), robust to outliers.

    Args:
        shared: (n, p); none: p = 0.

    Returns:
        k, b, a (2 + p,).
    """
    shared = np.zeros((len(error), 0)) if shared is None else shared
    size, expected = np.sqrt(np.mean(error**2)) + least, np.sqrt(np.mean(variance))
    free = expected > 1e-6  # else the model has no such freedom, and the factor no meaning
    typical = np.sqrt(shared.mean(axis=0)) + _NOTHING

    def score(logs: Array) -> tuple[float, Array]:
        """The mean score, and its derivatives by the logarithms of all factors and the floor."""
        k, b, *a = np.exp(logs)
        factor, floor = correlated_factor(k, lasting), b * lasting * doubt
        parts = shared * np.square(a)
        sigma = np.sqrt(factor**2 * variance + floor**2 + parts.sum(axis=1) + more) + _NOTHING
        z = error / sigma
        ranked = sigma * (z * (2 * ndtr(z) - 1) + (np.sqrt(2) * np.exp(-(z**2) / 2) - 1) / np.sqrt(np.pi))
        by_sigma = (np.sqrt(2) * np.exp(-(z**2) / 2) - 1) / np.sqrt(np.pi) / sigma
        slope = 1.0 + (k > WHITE_FACTOR) * (lasting - 1.0)  # of the factor by k
        by_factor = factor * variance * k * slope
        rates = [np.mean(by_sigma * by_factor), np.mean(by_sigma * floor**2), *(by_sigma @ parts / len(z))]
        return float(np.mean(ranked) / size), np.array(rates) / size

    bounds = [(0.0, np.log(30.0) if free else 0.0), (np.log(least), np.log(10 * size))]
    bounds += [(np.log(1e-3 * size / one), np.log(3 * size / one)) for one in typical]
    others = list(np.log(size / 3 / typical))
    starts = [[0.0, np.log(size), *others]]
    if free:
        starts.append([np.log(np.clip(size / expected, 1.0, 20.0)), np.log(max(least, size / 3)), *others])
    found = min(
        (minimize(score, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts),
        key=lambda result: float(result.fun),
    )
    return np.asarray(np.exp(found.x))


def as_toml(inflation: CovarianceInflation) -> str:
    """The text of the inflation's file."""
    lines = [f"[{SHARES}]  # of the distance between solution and start"]
    for seen, shares in inflation.shares.items():
        entries = ", ".join(f"{kind} = {share:.3g}" for kind, share in shares.items())
        lines.append(f"{seen} = {{ {entries} }}")
    lines += ["", f"[{DEPTHS}]  # of the distance from the camera"]
    lines += [f"{seen} = {share:.3g}" for seen, share in inflation.depths.items()]
    lines.append("")
    for seen, kinds in SEEN.items():
        for kind in kinds:
            lines.append(f"[{seen}.{kind}]  # floor in {UNITS[kind]}")
            for name, w in inflation.widenings[seen][kind].items():
                lines.append(f'"{name}" = {{ factor = {_text(w.factor)}, floor = {_text(w.floor)} }}')
            lines.append("")
    return "\n".join(lines)


def _text(value: Array) -> str:
    rounded = [f"{max(float(f'{v:.3g}'), 0.0):g}" for v in value]
    return rounded[0] if len(set(rounded)) == 1 else f"[{', '.join(rounded)}]"
