"""Errors of partly known, partly estimated variance: limits, and false positives at any level."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rtof_kin.clinical.comparison_change import MixedError

LEVELS = (0.05, 0.01, 0.002)


@pytest.mark.parametrize("dof", [1, 2, 5, 30])
@pytest.mark.parametrize("difference", [0.3, 2.0, 15.0])
def test_an_estimated_variance_alone_gives_student(dof: float, difference: float) -> None:
    error = MixedError(0.0, 4.0, dof)
    assert error.p(difference) == pytest.approx(2 * stats.t.sf(difference / 2, dof), rel=1e-6)
    assert error.half_width(0.05) == pytest.approx(2 * stats.t.isf(0.025, dof), rel=1e-5)
    assert error.effective_dof == dof


def test_a_known_variance_alone_is_normal() -> None:
    for error in (MixedError(4.0), MixedError(4.0, 0.0, 3.0), MixedError(3.0, 1.0)):
        assert error.half_width(0.05) == pytest.approx(2 * stats.norm.isf(0.025))
    assert MixedError(4.0, 1e-9, 2.0).p(3.0) == pytest.approx(2 * stats.norm.sf(1.5), rel=1e-5)


def test_both_parts_are_wider_than_each_and_narrower_than_their_sum() -> None:
    both, known, estimated = MixedError(2.0, 1.0, 3.0), MixedError(2.0), MixedError(0.0, 1.0, 3.0)
    own = [error.half_width(0.01) for error in (both, known, estimated)]
    assert max(own[1:]) < own[0] < sum(own[1:])
    assert both.p(own[0]) == pytest.approx(0.01, rel=1e-6)


def test_without_any_error_there_is_no_interval() -> None:
    assert np.isnan(MixedError().half_width(0.05))


@pytest.mark.parametrize("dof", [1, 2, 4, 10])
@pytest.mark.parametrize("known", [0.0, 0.1, 1.0, 10.0])
def test_false_positives_never_exceed_the_level(dof: float, known: float) -> None:
    rng, count = np.random.default_rng(5), 3000
    errors = rng.normal(0, np.sqrt(known + 1), count)
    estimates = rng.chisquare(dof, count) / dof
    p = np.array([MixedError(known, s, dof).p(e) for e, s in zip(errors, estimates, strict=True)])
    for level in LEVELS:
        assert np.mean(p < level) <= level + 3.5 * np.sqrt(level / count)


def test_satterthwaite_would_exceed_small_levels_by_far() -> None:
    rng, known, dof, count = np.random.default_rng(5), 0.1, 2.0, 100_000
    errors = rng.normal(0, np.sqrt(known + 1), count)
    estimates = rng.chisquare(dof, count) / dof
    variance = known + estimates
    p = 2 * stats.t.sf(np.abs(errors) / np.sqrt(variance), dof * (variance / estimates) ** 2)
    assert np.mean(p < 0.001) > 0.01
