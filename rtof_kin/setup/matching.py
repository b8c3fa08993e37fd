"""Posterior of assignments of sensors to segments: each sensor on another segment, with a score for each.

The scores of single sensors and of pairs add up to the log-probability of an assignment. Gibbs chains (Geman
and Geman 1984) draw one sensor's segment at a time, exchanging it with the sensor that is there, and now and
then the sides of whole limbs; they cool down before they count, and start at the best assignment of the
single scores (Jonker and Volgenant 1987) and at random ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rtof_kin.core.array_types import Array

Labels = NDArray[np.intp]
_CHAINS, _COOLING, _SAMPLING = 32, 400, 500  # chains, steps of each
_HOTTEST = 10.0  # [-] temperature at the start
_IMPOSSIBLE = -1e4  # [nats]


@dataclass(frozen=True, eq=False)
class Matching:
    """Posterior of the assignments of S sensors to K segments."""

    best: Labels
    """(S,) segment of each sensor in the likeliest assignment."""
    probability: Array
    """(S, K) of each sensor on each segment."""
    likeliest: tuple[tuple[tuple[int, ...], float], ...]
    """Whole assignments and their probabilities, falling."""


def match(
    single: Array,
    pair: Array | None = None,
    *,
    allowed: NDArray[np.bool_] | None = None,
    mirrors: Sequence[Labels] = (),
    prior: Callable[[Labels], Array] | None = None,
    most: int = 5,
) -> Matching:
    """Sample assignments of each sensor to a segment of its own.

    Args:
        single: (S, K) scores, nats; S <= K. pair: (S, S, K, K) scores, symmetric, 0 of a sensor with itself.
        allowed: (S, K) segments that each sensor may be on; at least one assignment is possible.
        mirrors: permutations (K,) of segments that are proposed for all sensors at once.
        prior: log-probability (C,) of assignments (C, S), added. most: number of whole assignments returned.
    """
    S, K = single.shape
    single = np.where(np.ones((S, K), bool) if allowed is None else allowed, single, _IMPOSSIBLE)
    rng = np.random.default_rng(0)
    rows, (a, b) = np.arange(S), np.triu_indices(S, 1)

    def score(labels: Labels) -> Array:
        out = single[rows, labels].sum(axis=-1)
        if pair is not None:
            out = out + pair[a, b, labels[:, a], labels[:, b]].sum(axis=-1)
        return np.asarray(out if prior is None else out + prior(labels))

    at = _starts(rng, single)
    counts, seen = np.zeros((S, K)), set[tuple[int, ...]]()
    temperatures = np.append(np.geomspace(_HOTTEST, 1.0, _COOLING), np.ones(_SAMPLING))
    for step, temperature in enumerate(temperatures):
        s, counted = step % S, step >= _COOLING
        new = _moved(at, s, K)
        weight = _softmax(score(new.reshape(-1, S)).reshape(-1, K) / temperature)
        drawn = (weight.cumsum(axis=1) < rng.uniform(size=(len(at), 1))).sum(axis=1)
        at = new[np.arange(len(at)), np.minimum(drawn, K - 1)]
        if counted:
            counts[s] += weight.sum(axis=0)
        if len(mirrors) and s == 0:
            sides = np.stack([at, *(mirror[at] for mirror in mirrors)], axis=1)
            weight = _softmax(score(sides.reshape(-1, S)).reshape(len(at), -1) / temperature)
            drawn = (weight.cumsum(axis=1) < rng.uniform(size=(len(at), 1))).sum(axis=1)
            at = sides[np.arange(len(at)), np.minimum(drawn, len(mirrors))]
        if counted:
            seen.update(map(tuple, at.tolist()))
    return _summary(counts, np.array(sorted(seen)), score, most)


def _summary(counts: Array, seen: Labels, score: Callable[[Labels], Array], most: int) -> Matching:
    """Return the posterior from visits (S, K) and the assignments visited (N, S)."""
    scores = score(seen)
    share = np.exp(scores - scores.max())
    share /= share.sum()
    order = np.argsort(-scores)[:most]
    likeliest = tuple((tuple(int(k) for k in seen[i]), float(share[i])) for i in order)
    return Matching(seen[order[0]], counts / counts.sum(axis=1, keepdims=True), likeliest)


def _starts(rng: np.random.Generator, single: Array) -> Labels:
    S, K = single.shape
    starts = [linear_sum_assignment(-single)[1]]
    for _ in range(_CHAINS - 1):
        starts.append(linear_sum_assignment(rng.uniform(size=(S, K)) - np.where(single <= _IMPOSSIBLE, -1e3, 0))[1])
    return np.array(starts)


def _moved(at: Labels, s: int, K: int) -> Labels:
    """Return assignments (C, K, S) with sensor s on each segment, whose sensor takes its place."""
    segments = np.arange(K)
    new = np.repeat(at[:, None], K, axis=1)
    new = np.where(new == segments[:, None], at[:, s, None, None], new)
    new[:, :, s] = segments
    return new


def _softmax(scores: Array) -> Array:
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
