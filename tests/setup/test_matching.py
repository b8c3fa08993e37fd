"""The posterior of assignments agrees with enumeration."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy.special import softmax

from rtof_kin.calibration.assignment import match


def planted(S: int, K: int) -> tuple[np.ndarray, np.ndarray]:
    """Random scores of single sensors and symmetric ones of pairs."""
    rng = np.random.default_rng(5)
    single, pair = 2 * rng.standard_normal((S, K)), rng.standard_normal((S, S, K, K))
    pair = (pair + pair.transpose(1, 0, 3, 2)) / 2
    pair[np.arange(S), np.arange(S)] = 0
    return single, pair


def test_probabilities_are_those_of_enumeration() -> None:
    single, pair = planted(3, 5)
    every = np.array(list(permutations(range(5), 3)))
    score = np.array(
        [
            sum(single[s, k] for s, k in enumerate(labels))
            + sum(pair[s, t, labels[s], labels[t]] for s in range(3) for t in range(s))
            for labels in every
        ]
    )
    exact = np.array([[softmax(score)[every[:, s] == k].sum() for k in range(5)] for s in range(3)])
    found = match(single, pair)
    np.testing.assert_allclose(found.probability, exact, atol=0.02)
    assert tuple(found.best) == tuple(every[score.argmax()])


def test_every_sensor_has_a_segment_of_its_own_that_it_is_allowed() -> None:
    single, pair = planted(4, 4)
    allowed = ~np.eye(4, dtype=bool)
    found = match(single, pair, allowed=allowed)
    assert sorted(found.best) == [0, 1, 2, 3]
    assert np.all(np.diag(found.probability) < 1e-6)


def test_sides_that_are_equally_likely_are_both_visited() -> None:
    pair = np.zeros((2, 2, 2, 2))
    pair[0, 1] = pair[1, 0] = 50 * (1 - np.eye(2))
    mirror = np.array([1, 0])
    found = match(np.zeros((2, 2)), pair, mirrors=[mirror])
    np.testing.assert_allclose(found.probability, 0.5, atol=0.1)


def test_a_prior_moves_the_answer() -> None:
    found = match(np.zeros((2, 3)), prior=lambda labels: np.where((labels == [2, 0]).all(axis=1), 20.0, 0.0))
    assert tuple(found.best) == (2, 0)
