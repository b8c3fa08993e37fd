"""The test of a difference: coverage and false alarms by Monte Carlo, Holm, and what is not tested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.comparison_change import (
    SHARED,
    Change,
    Made,
    Measured,
    MixedError,
    Repeats,
    Verdict,
    adjusted,
    change,
    error_of,
    shared_of,
)

RNG = np.random.default_rng(0)


def one(value: float, sigma: float = 0.0) -> Measured:
    return Measured(np.array([value]), sigma)


def with_p(p: float) -> Change:
    return Change("mean", 0.0, 1.0, MixedError(1.0), p)


def difference(a: Measured, b: Measured, repeats: Repeats = "none") -> Change:
    return change("mean", a.mean, b.mean, error_of(a, b, repeats))


def estimated(variance: float, dof: float, known: float = 0.0) -> MixedError:
    return MixedError(known, variance, dof)


def test_bands_of_both_add_as_independent_errors() -> None:
    found = difference(one(0.1, 0.03), one(0.2, 0.04))
    assert (found.difference, found.sigma) == pytest.approx((0.1, 0.05))
    assert found.p == pytest.approx(2 * stats.norm.sf(2.0))
    assert found.interval == pytest.approx((0.1 - 0.05 * 1.959964, 0.1 + 0.05 * 1.959964))


def test_constant_errors_of_stated_size_alarm_as_often_as_the_level() -> None:
    errors = RNG.normal(0, [0.03, 0.05], (2000, 2))
    found = [adjusted([difference(one(a, 0.03), one(b, 0.05))])[0] for a, b in errors]
    alarms = np.mean([one.verdict is Verdict.CHANGED for one in found])
    assert alarms == pytest.approx(0.05, abs=0.015)
    covered = np.mean([low <= 0 <= high for low, high in (one.interval for one in found)])
    assert covered == pytest.approx(0.95, abs=0.015)


def test_errors_that_two_recordings_share_cancel_and_the_interval_covers_a_planted_change() -> None:
    """Constants of the person's file are wrong alike in both; mounting and noise are not."""
    covered, sizes = [], []
    for _ in range(1500):
        constant = RNG.normal(0, np.sqrt(SHARED))
        a, b = (one(value + 0.04 * (constant + RNG.normal(0, np.sqrt(1 - SHARED))), 0.04) for value in (0.1, 0.3))
        errors = [error_of(a, b, "none", shared) for shared in (SHARED, 0.0)]
        (found,) = adjusted([change("mean", a.mean, b.mean, errors[0], independent=errors[1])])
        covered.append(found.interval[0] <= 0.2 <= found.interval[1])
        sizes.append((found.detectable, found.detectable_independent))
    assert np.mean(covered) == pytest.approx(0.95, abs=0.02)
    assert np.ptp(sizes, axis=0).max() < 1e-12
    assert sizes[0][0] / sizes[0][1] == pytest.approx(np.sqrt(1 - SHARED))


def test_a_smaller_error_shares_only_what_it_has() -> None:
    found = error_of(one(0.1, 0.01), one(0.2, 0.05), "none", 0.5)
    assert found.sigma == pytest.approx(np.sqrt(0.01**2 + 0.05**2 - 0.01 * 0.05))
    assert found.sigma > 0.05 - 0.01


def test_nothing_is_shared_unless_all_are_made_alike_with_a_known_person() -> None:
    rows, known = angle_table(SkeletonModel.default().table).rows, Made(("P07", "3f2a"))
    assert shared_of([known, known, known], rows) == dict.fromkeys((row.name for row in rows), SHARED)
    for other in (Made(("P07", "77d0")), replace(known, sensed=("Hips",)), None):
        assert shared_of([known, other], rows) == shared_of([other, known], rows) == {}
    assert shared_of([None, None], rows) == {}


@pytest.mark.parametrize(
    "calibrated, expected",
    [(False, {"right_hip_flexion", "spine_flexion", "pelvis_tilt"}), (True, {"spine_flexion", "pelvis_tilt"})],
)
def test_errors_of_mountings_are_not_shared(calibrated: bool, expected: set[str]) -> None:
    rows = angle_table(SkeletonModel.default().table).rows
    names = ("right_hip_flexion", "right_knee_flexion", "spine_flexion", "pelvis_tilt")
    own = [row for row in rows if row.name in names]
    made = Made(("P07",), ("RightUpLeg", "RightLeg"), calibrated)
    assert {*shared_of([made, made], own)} == expected
    trunk = replace(made, sensed=("RightUpLeg", "RightLeg", "Hips", "Spine3"))
    assert shared_of([trunk, trunk], own) == {}


def test_repeats_without_bands_are_tested_as_by_welch() -> None:
    a, b = RNG.normal(0, 1, 5), RNG.normal(1, 3, 8)
    found = difference(Measured(a, 0.0), Measured(b, 0.0), "independent")
    expected = stats.ttest_ind(b, a, equal_var=False)
    assert (found.p, found.error.dof) == pytest.approx((expected.pvalue, expected.df), rel=1e-6)
    interval = expected.confidence_interval(0.95)
    assert found.interval == pytest.approx((interval.low, interval.high), rel=1e-5)


def test_coverage_holds_with_a_constant_error_and_few_repeats() -> None:
    covered = 0
    for _ in range(1500):
        means = RNG.normal(0, [0.04, 0.02])
        a = Measured(means[0] + RNG.normal(0, 0.05, 3), 0.04)
        b = Measured(means[1] + RNG.normal(0, 0.05, 4), 0.02)
        low, high = difference(a, b, "independent").interval
        covered += low <= 0 <= high
    assert 0.94 <= covered / 1500 <= 0.98


def test_a_single_repeat_takes_the_spread_of_the_other() -> None:
    many = Measured(np.array([1.0, 1.2, 1.4]), 0.0)
    found = difference(Measured(np.array([0.9]), 0.0), many, "independent")
    assert found.sigma == pytest.approx(0.2 * np.sqrt(1 + 1 / 3))
    assert found.error.dof == pytest.approx(2)
    assert found.p == pytest.approx(2 * stats.t.sf(0.3 / found.sigma, 2), rel=1e-6)


def test_the_same_repeats_are_tested_as_pairs() -> None:
    depth, asymmetry = RNG.normal(80, 20, 6), RNG.normal(3, 1, 6)
    found = difference(Measured(depth, 0.0), Measured(depth + asymmetry, 0.0), "paired")
    expected = stats.ttest_rel(depth + asymmetry, depth)
    assert (found.p, found.error.dof) == pytest.approx((expected.pvalue, 5), rel=1e-6)
    assert found.p < 0.01
    assert difference(Measured(depth, 0.0), Measured(depth + asymmetry, 0.0), "independent").p > 0.3


def test_without_any_stated_error_nothing_is_tested() -> None:
    found = adjusted([difference(one(0.0), one(0.5)), with_p(0.03)])
    assert [c.verdict for c in found] == [Verdict.NOT_TESTED, Verdict.CHANGED]
    assert np.isnan(found[0].sigma)
    assert np.isnan(found[0].detectable)


def test_p_values_are_holms() -> None:
    found = adjusted([with_p(p) for p in (0.04, 0.001, 0.03, 0.015, 0.8)])
    assert [c.p_adjusted for c in found] == pytest.approx([0.09, 0.005, 0.09, 0.06, 0.8])
    assert [c.verdict is Verdict.CHANGED for c in found] == [False, True, False, False, False]


def test_a_difference_of_the_detectable_size_is_changed_whatever_the_others_show() -> None:
    still = [difference(one(0.0, 0.1), one(0.0, 0.1)) for _ in range(9)]
    detectable = adjusted(still)[0].detectable
    for size, verdict in ((1.001, Verdict.CHANGED), (0.999, Verdict.NOT_SHOWN)):
        moved = difference(one(0.0, 0.1), one(size * detectable, 0.1))
        assert adjusted([*still[1:], moved])[-1].verdict is verdict
        changed = [replace(other, p=1e-9) for other in still[1:]]
        if verdict is Verdict.CHANGED:
            assert adjusted([*changed, moved])[-1].verdict is verdict


LEVELS = (0.05, 0.01, 0.002)


@pytest.mark.parametrize("dof", [1, 2, 5, 30])
@pytest.mark.parametrize("difference", [0.3, 2.0, 15.0])
def test_an_estimated_variance_alone_gives_student(dof: float, difference: float) -> None:
    error = estimated(4.0, dof)
    assert error.p(difference) == pytest.approx(2 * stats.t.sf(difference / 2, dof), rel=1e-6)
    assert error.half_width(0.05) == pytest.approx(2 * stats.t.isf(0.025, dof), rel=1e-5)
    assert error.effective_dof == dof


def test_a_known_variance_alone_is_normal() -> None:
    for error in (MixedError(4.0), estimated(0.0, 3.0, 4.0)):
        assert error.half_width(0.05) == pytest.approx(2 * stats.norm.isf(0.025))
    assert estimated(1e-9, 2.0, 4.0).p(3.0) == pytest.approx(2 * stats.norm.sf(1.5), rel=1e-5)


def test_both_parts_are_wider_than_each_and_narrower_than_their_sum() -> None:
    both, known, other = estimated(1.0, 3.0, 2.0), MixedError(2.0), estimated(1.0, 3.0)
    own = [error.half_width(0.01) for error in (both, known, other)]
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
