"""Standard errors and minimal detectable changes: closed forms, and visits with planted errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from rtof_kin.clinical.comparison_change import Measured
from rtof_kin.clinical.follow_up import (
    BandShares,
    MeasurementErrors,
    mean_square_within,
    measurement_errors,
    shown_mostly,
)
from rtof_kin.core.errors import InvalidInputError

Array = NDArray[np.float64]
RNG = np.random.default_rng(11)
SEEDED = RNG.bit_generator.state
SHARED = BandShares(all_visits=0.3, visit=0.4)


@pytest.fixture(autouse=True)
def same_draws() -> None:
    """Every test has the same draws, alone and among others."""
    RNG.bit_generator.state = SEEDED


def planted(trials: Sequence[int], change: float, band: float, person: float, shares: BandShares) -> list[Measured]:
    """Visits of one person, the last with another true value; their bands are right."""
    always = RNG.normal(0, band * np.sqrt(shares.all_visits))
    out = []
    for number, count in enumerate(trials):
        visit = RNG.normal(0, band * np.sqrt(shares.visit))
        own = RNG.normal(0, np.hypot(person, band * np.sqrt(shares.trial)), count)
        mean = change if number == len(trials) - 1 else 0.0
        out.append(Measured(40.0 + mean + always + visit + own, band))
    return out


def p_of(visits: Sequence[Measured], shares: BandShares) -> float:
    errors = measurement_errors(visits, shares)
    return errors.of_change(visits[0], visits[-1]).p(visits[-1].mean - visits[0].mean)


# --- closed forms --------------------------------------------------------------------------------


def test_two_trials_of_each_visit_give_the_sd_of_differences_over_root_two() -> None:
    """de Vet et al. 2006: the SEM of agreement of two measurements without a systematic difference."""
    first, second = RNG.normal(30, 4, (2, 9))
    variance, dof = mean_square_within([np.array(pair) for pair in zip(first, second, strict=True)])
    assert variance == pytest.approx(np.mean((second - first) ** 2) / 2)
    assert dof == 9


def test_mean_square_within_is_that_of_an_analysis_of_variance() -> None:
    groups = [RNG.normal(mean, 2, n) for mean, n in ((30, 3), (35, 4), (28, 2))]
    variance, dof = mean_square_within(groups)
    every = np.concatenate(groups)
    between = sum(len(g) * (np.mean(g) - every.mean()) ** 2 for g in groups) / 2
    assert dof == 6
    assert stats.f_oneway(*groups).statistic == pytest.approx(between / variance)


def test_the_three_standard_errors_and_their_minimal_detectable_changes() -> None:
    visits = [Measured(np.array([39.0, 41.0]), 3.0), Measured(np.array([49.0, 51.0]), 4.0)]
    errors = measurement_errors(visits, BandShares())
    assert errors.bands.sem == pytest.approx(np.sqrt(12.5))
    assert errors.bands.mdc95 == pytest.approx(1.959964 * np.sqrt(2) * errors.bands.sem)
    assert (errors.trials.sem, errors.trials.dof) == (pytest.approx(np.sqrt(2)), 2)
    assert errors.trials.mdc95 == pytest.approx(stats.t.isf(0.025, 2) * np.sqrt(2) * np.sqrt(2), rel=1e-5)
    assert errors.both.sem == pytest.approx(np.sqrt(12.5 + 2 / 2))
    assert errors.both.mdc95 > errors.bands.mdc95


def test_without_repeats_or_bands_nothing_is_stated() -> None:
    one, two = Measured(np.array([40.0]), 0.0), Measured(np.array([45.0]), 0.0)
    errors = measurement_errors([one, two], BandShares())
    assert all(np.isnan(sem.sem) for sem in (errors.bands, errors.trials, errors.both))
    assert not errors.of_change(one, two).sigma


def test_trials_do_not_make_errors_smaller_that_they_share() -> None:
    many = [Measured(RNG.normal(40, 1, 500), 3.0) for _ in range(2)]
    assert measurement_errors(many, BandShares()).both.sem == pytest.approx(3.0, rel=0.01)
    own = BandShares(visit=0.0)  # independent from trial to trial: all but the band that trials do not show
    assert measurement_errors(many, own).both.sem == pytest.approx(np.sqrt(8.0), rel=0.02)


@pytest.mark.parametrize("all_visits, visit", [(-0.1, 1.0), (0.7, 0.5), (float("nan"), 0.1)])
def test_shares_beyond_a_whole_are_refused(all_visits: float, visit: float) -> None:
    with pytest.raises(InvalidInputError, match="shares of the bands"):
        BandShares(all_visits, visit)


# --- planted errors ------------------------------------------------------------------------------


def test_the_planted_sem_is_recovered() -> None:
    draws = [planted((3, 3, 3), 0.0, 3.0, 1.5, SHARED) for _ in range(2000)]
    found = [mean_square_within([one.values for one in visits])[0] for visits in draws]
    assert np.mean(found) == pytest.approx(1.5**2 + 0.3 * 3.0**2, rel=0.05)


@pytest.mark.parametrize("shares", [BandShares(), SHARED, BandShares(0.5, 0.5), BandShares(0.3, 0.5)])
def test_the_stated_variance_of_a_change_is_the_planted_one(shares: BandShares) -> None:
    """No error is counted twice and none is lost, where the shares are right."""
    draws = [planted((4, 4), 0.0, 3.0, 2.0, shares) for _ in range(2500)]
    changes = [b.mean - a.mean for a, b in draws]
    stated = [measurement_errors([a, b], shares).of_change(a, b).sigma ** 2 for a, b in draws]
    assert np.mean(stated) == pytest.approx(np.var(changes), rel=0.08)


@pytest.mark.parametrize(
    "trials, person",
    [
        ((1, 1), 0.0),
        ((2, 2), 0.0),
        ((2, 2), 1.0),
        ((2, 2), 4.0),
        ((3, 1), 1.0),
        ((3, 1), 4.0),
        ((3, 3, 3), 1.0),
        ((2, 5), 4.0),
    ],
)
def test_false_changes_are_at_most_five_per_cent(trials: tuple[int, ...], person: float) -> None:
    count = 700
    for shares, declared in ((SHARED, SHARED), (SHARED, BandShares()), (BandShares(), BandShares())):
        p = [p_of(planted(trials, 0.0, 2.0, person, shares), declared) for _ in range(count)]
        assert np.mean(np.array(p) < 0.05) <= 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / count)


def test_the_default_never_states_less_than_the_errors_whatever_their_shares() -> None:
    for shares in (BandShares(), SHARED, BandShares(0.0, 0.0), BandShares(1.0, 0.0)):
        draws = [planted((3, 3), 0.0, 3.0, 1.0, shares) for _ in range(800)]
        spread = np.std([b.mean - a.mean for a, b in draws])
        stated = np.mean([measurement_errors([a, b], BandShares()).both.sem for a, b in draws])
        assert stated * np.sqrt(2) >= 0.95 * spread


@pytest.mark.parametrize("trials", [(3, 3, 3), (6, 6)])
def test_power_is_as_predicted(trials: tuple[int, ...]) -> None:
    def found(change: float) -> float:
        p = [p_of(planted(trials, change, 2.0, 1.0, SHARED), SHARED) for _ in range(800)]
        return float(np.mean(np.array(p) < 0.05))

    errors: list[MeasurementErrors] = []
    needed, mostly = [], []
    for _ in range(150):
        visits = planted(trials, 0.0, 2.0, 1.0, SHARED)
        errors.append(measurement_errors(visits, SHARED))
        error = errors[-1].of_change(visits[0], visits[-1])
        needed.append(error.half_width(0.05))
        mostly.append(shown_mostly(error, needed[-1]))
    assert found(float(np.mean(mostly))) == pytest.approx(0.8, abs=0.06)
    assert found(float(np.mean(needed))) == pytest.approx(0.5, abs=0.06)
    assert np.mean([one.both.mdc95 for one in errors]) == pytest.approx(np.mean(needed), rel=0.02)
