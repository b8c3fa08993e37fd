"""Posterior of assignments of sensors to segments: each sensor on another segment, with a score for each.

The scores of single sensors and of pairs add up to the log-probability of an assignment. Metropolis-
Hastings chains (Hastings 1970) place one sensor at a time, exchanging it with the sensor that is there, by
proposals in proportion to the probabilities of the outcomes (locally informed, Zanella 2020), and now and
then exchange the sides of whole limbs. They cool down before they count, and start at the best assignment
of the single scores (Jonker and Volgenant 1987) and at random ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp

from rtof_kin.core.array_types import Array

Labels = NDArray[np.intp]
Score = Callable[[Labels], Array]
"""Log-probabilities (C,) of assignments (C, S)."""
_CHAINS, _COOLING, _SAMPLING = 32, 300, 400  # chains, steps of each
_HOTTEST = 10.0  # [-] temperature at the start
_IMPOSSIBLE = -1e4  # [nats]


@dataclass(frozen=True, eq=False)
class Matching:
    """Posterior of the assignments of S sensors to K segments."""

    best: Labels
    """(S,) segment of each sensor in the likeliest assignment."""
    probability: Array
    """(S, K) of each sensor on each segment."""


def match(
    single: Array,
    pair: Array | None = None,
    *,
    allowed: NDArray[np.bool_] | None = None,
    mirrors: Sequence[Labels] = (),
    prior: Score | None = None,
) -> Matching:
    """Sample assignments of each sensor to a segment of its own.

    Args:
        single: (S, K) scores, nats; S <= K. pair: (S, S, K, K) scores, symmetric, 0 of a sensor with itself. allowed:
        (S, K) segments that each sensor may be on; at least one assignment is possible. mirrors: permutations (K,) of
        segments that are proposed for all sensors at once. prior: log-probability (C,) of assignments (C, S), added.
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
        at = _placed(rng, at, step % S, K, score, float(temperature))
        if len(mirrors) and step % S == 0:
            sides = np.asarray(mirrors)[rng.integers(len(mirrors), size=len(at))[:, None], at]
            better = np.log(rng.uniform(size=len(at))) < (score(sides) - score(at)) / temperature
            at = np.where(better[:, None], sides, at)
        if step >= _COOLING:
            np.add.at(counts, (rows, at), 1)
            seen.update(map(tuple, at.tolist()))
    every = np.array(sorted(seen))
    return Matching(every[score(every).argmax()], counts / counts.sum(axis=1, keepdims=True))


def _starts(rng: np.random.Generator, single: Array) -> Labels:
    S, K = single.shape
    starts = [linear_sum_assignment(-single)[1]]
    for _ in range(_CHAINS - 1):
        starts.append(linear_sum_assignment(rng.uniform(size=(S, K)) - np.where(single <= _IMPOSSIBLE, -1e3, 0))[1])
    return np.array(starts)


def _placed(rng: np.random.Generator, at: Labels, s: int, K: int, score: Score, temperature: float) -> Labels:
    """Return assignments (C, S) after a step that places sensor s."""

    def ways(of: Labels) -> tuple[Labels, Array]:
        """Return assignments (C, K, S) with sensor s on each segment, whose sensor takes its place, and their
        scores (C, K).
        """
        new = np.repeat(of[:, None], K, axis=1)
        new = np.where(new == np.arange(K)[:, None], of[:, s, None, None], new)
        new[:, :, s] = np.arange(K)
        return new, score(new.reshape(-1, of.shape[1])).reshape(-1, K) / temperature

    there, scores = ways(at)
    total = logsumexp(scores, axis=1)
    share = np.exp(scores - total[:, None]).cumsum(axis=1)
    drawn = np.minimum((share < rng.uniform(size=(len(at), 1))).sum(axis=1), K - 1)
    new = there[np.arange(len(at)), drawn]
    accepted = np.log(rng.uniform(size=len(at))) < total - logsumexp(ways(new)[1], axis=1)
    return np.where(accepted[:, None], new, at)
