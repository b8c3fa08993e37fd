"""Agreement and reliability against closed forms, planted variances and published numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rtof_kin.clinical.agreement import agreement_of, limits_of_agreement, multiple_correlation, reliability

PHASE = np.linspace(0, 2 * np.pi, 101)
WAVE = 0.5 * np.sin(PHASE)
SHROUT_FLEISS = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7.0]])
"""Table 2 of Shrout and Fleiss (1979): six people, four judges."""


def test_multiple_correlation_is_that_of_the_publication() -> None:
    assert multiple_correlation([(WAVE, WAVE), (2 * WAVE, 2 * WAVE)]) == pytest.approx(1.0)
    assert np.isnan(multiple_correlation([(WAVE, -WAVE)]))  # imaginary: they differ more than they move
    assert np.isnan(multiple_correlation([(np.ones(9), np.ones(9))]))
    rng = np.random.default_rng(1)
    Y = np.stack([np.stack([WAVE * k, WAVE * k + rng.normal(0.05, 0.1, 101)]) for k in (1, 2, 3)])
    G, P, F = Y.shape
    within = sum((Y[g, p, f] - Y[g, :, f].mean()) ** 2 for g in range(G) for p in range(P) for f in range(F))
    total = sum((Y[g, p, f] - Y[g].mean()) ** 2 for g in range(G) for p in range(P) for f in range(F))
    expected = np.sqrt(1 - (within / (G * F * (P - 1))) / (total / (G * (P * F - 1))))
    assert multiple_correlation([(one[0], one[1]) for one in Y]) == pytest.approx(expected)
    assert 0.9 < expected < 0.999


def test_an_offset_and_a_scale_come_out_in_their_own_figures() -> None:
    found = agreement_of([("a", WAVE, 0.1 * WAVE + 0.02), ("b", WAVE, -0.2 * WAVE + 0.02)])
    assert found.range_error == pytest.approx(0.15 * np.ptp(WAVE))
    rms = [np.sqrt(np.mean((k * WAVE + 0.02) ** 2)) / np.ptp(WAVE) for k in (0.1, -0.2)]
    assert found.nrmse == pytest.approx(np.mean(rms))
    assert found.bias == pytest.approx(0.02)
    assert found.range_bias == pytest.approx(-0.05 * np.ptp(WAVE))
    half = 1.96 * 0.3 * np.ptp(WAVE) / np.sqrt(2)  # two people, one curve each: the plain standard deviation
    assert found.range_limit_high - found.range_bias == pytest.approx(half, rel=1e-4)


def test_limits_are_those_of_repeated_differences_of_people() -> None:
    rng = np.random.default_rng(2)
    groups = [rng.normal(rng.normal(1.0, 3.0), 2.0, rng.integers(2, 7)) for _ in range(4000)]
    found = limits_of_agreement(groups)
    assert found[0] == pytest.approx(1.0, abs=0.1)
    assert found[2] - found[0] == pytest.approx(1.96 * np.sqrt(3.0**2 + 2.0**2), rel=0.02)
    small = [np.array([1.0, 2.0, 4.0]), np.array([0.0, 1.0]), np.array([7.0, 5.0, 6.0, 6.0])]
    d, sizes = np.concatenate(small), np.array([3, 2, 4])
    within = sum(np.sum((one - one.mean()) ** 2) for one in small) / (9 - 3)
    between = stats.f_oneway(*small).statistic * within
    variance = within + (between - within) / ((81 - np.sum(sizes**2)) / (2 * 9))  # Bland and Altman (2007), section 3
    expected = (d.mean(), d.mean() - 1.96 * np.sqrt(variance), d.mean() + 1.96 * np.sqrt(variance))
    np.testing.assert_allclose(limits_of_agreement(small), expected, rtol=1e-4)
    assert np.isnan(limits_of_agreement([np.array([1.0])])[1])


def test_reliability_has_the_published_coefficients_and_the_error_of_the_analysis() -> None:
    absolute, consistent = reliability(SHROUT_FLEISS, "ICC(2,1)"), reliability(SHROUT_FLEISS, "ICC(3,1)")
    assert (round(absolute.icc, 2), round(consistent.icc, 2)) == (0.29, 0.71)  # their table 4
    assert absolute.low < absolute.icc < absolute.high
    assert consistent.sem == pytest.approx(np.sqrt(1.02), abs=0.005)  # their table 3: EMS 1.02
    half = np.where(np.arange(6)[:, None] < 2, np.nan, SHROUT_FLEISS)
    assert reliability(half, "ICC(2,1)").why_not == "ICC(2,1): 4 people with all 4; 5 are needed"
    assert reliability(SHROUT_FLEISS[:, :1], "ICC(3,1)").why_not == "ICC(3,1): no second one"
