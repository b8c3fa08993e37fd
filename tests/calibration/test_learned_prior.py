"""Priors learned from estimates: planted sizes, and what the data say nothing of."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.shared_fragments import learned_precision

Array = NDArray[np.float64]
KIND, OTHER = slice(0, 40), slice(40, 46)
G, SIGMA = 46, np.repeat([6.0, 0.05], [40, 6])
GIVEN = np.diag(1 / SIGMA**2)


def information(rng: np.random.Generator, unseen: int = 4) -> Array:
    """Of many directions, but of a few nothing."""
    axes = np.linalg.qr(rng.normal(size=(G, G)))[0]
    known = np.r_[np.zeros(unseen), rng.uniform(0.3, 30, G - unseen)]
    return (axes * known) @ axes.T / SIGMA[:, None] / SIGMA


def learned(share: float, seed: int, overcount: float = 1.0) -> tuple[Array, Array]:
    """What is learned where errors are of a share of their variance; the information."""
    rng = np.random.default_rng(seed)
    D = information(rng)
    truth = SIGMA * rng.normal(size=G)
    truth[KIND] *= np.sqrt(share)
    L = np.linalg.cholesky(D + 1e-12 * GIVEN)
    slope = -D @ truth - np.sqrt(overcount) * L @ rng.normal(size=G)  # at zero
    return learned_precision(GIVEN, D, slope, np.zeros(G), [KIND], overcount), D


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("overcount", [1.0, 3.0])
def test_smaller_variance_is_learned(share: float, overcount: float) -> None:
    found = [1 / learned(share, seed, overcount)[0][0, 0] / SIGMA[0] ** 2 for seed in range(30)]
    assert np.mean(found) == pytest.approx(share, rel=0.25)


def test_correct_prior_is_nearly_unchanged() -> None:
    found = [1 / learned(1.0, seed)[0][0, 0] / SIGMA[0] ** 2 for seed in range(30)]
    assert np.mean(found) > 0.85
    assert max(found) <= 1 + 1e-12  # nobody learns that errors are larger


def test_other_kinds_keep_their_prior() -> None:
    precision, _ = learned(0.1, 0)
    np.testing.assert_array_equal(precision[OTHER, OTHER], GIVEN[OTHER, OTHER])
    np.testing.assert_array_equal(precision[KIND, OTHER], 0)


def test_no_information_leaves_the_prior_unchanged() -> None:
    precision = learned_precision(GIVEN, np.zeros((G, G)), np.zeros(G), np.zeros(G), [KIND], 3.0)
    np.testing.assert_allclose(precision, GIVEN)


def test_result_does_not_depend_on_the_linearisation_point() -> None:
    rng = np.random.default_rng(3)
    D, slope, y = information(rng), rng.normal(size=G), SIGMA * rng.normal(size=G)
    at_zero = learned_precision(GIVEN, D, slope, np.zeros(G), [KIND], 2.0)
    elsewhere = learned_precision(GIVEN, D, slope + D @ y, y, [KIND], 2.0)
    np.testing.assert_allclose(elsewhere, at_zero, rtol=1e-6)
