"""Change over visits: verdicts, directions, families of measures, and planted walking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from clinical_support import squatting
from follow_support import visit, walk_at
from numpy.typing import NDArray
from scipy import stats

from rtof_kin.clinical import comparison_change
from rtof_kin.clinical.comparison_change import Measured, MixedError
from rtof_kin.clinical.follow_up import (
    Followed,
    FollowUp,
    Outcome,
    Repeated,
    follow_measures,
    follow_up,
    mean_square_within,
    measurement_errors,
    shown_mostly,
)
from rtof_kin.clinical.visits import Better, Measure, Setup, Visit, incomparable, measures_of, trial
from rtof_kin.core.errors import InvalidInputError, UnknownNameError

ANGLE = Measure("right_knee_flexion_range", "deg")
COMMON = comparison_change.SHARED
BEFORE, SAME, AFTER = visit("before", 1.0), visit("same", 1.0, first=3), visit("after", 1.4, first=1)


def values(*trials: float, band: float = 0.0) -> Measured:
    return Measured(np.array(trials), band)


def one(*visits: Measured | None, better: Better | None = None, name: str = "x_range") -> Followed:
    directions: dict[str, Better] = {} if better is None else {name: better}
    series = {Measure(name, "deg"): visits}
    return follow_measures(series, 0, Repeated.TRIALS, directions)[0]


# --- verdicts ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "better, outcome",
    [(None, Outcome.CHANGED), ("up", Outcome.IMPROVED), ("down", Outcome.WORSE), ("zero", Outcome.WORSE)],
)
def test_a_change_is_judged_by_the_declared_direction(better: Better | None, outcome: Outcome) -> None:
    found = one(values(1.0, 1.01, 0.99), values(1.5, 1.51, 1.49), better=better)
    assert found.outcome(1) is outcome


@pytest.mark.parametrize(
    "after, outcome",
    [
        (0.02, Outcome.IMPROVED),
        (-0.3, Outcome.IMPROVED),
        (-0.98, Outcome.CHANGED),
        (-2.0, Outcome.WORSE),
        (1.0, Outcome.NOT_SHOWN),
    ],
)
def test_towards_zero_needs_to_show_which_is_nearer(after: float, outcome: Outcome) -> None:
    found = one(values(1.0, 1.05, 0.95), values(after - 0.05, after, after + 0.05), better="zero")
    assert found.outcome(1) is outcome


def test_errors_that_visits_share_count_double_in_which_is_nearer_to_zero() -> None:
    """A bias of 5 makes 12 and -4 of 7 and -9: the change is shown, but not which is nearer to zero."""
    found = one(values(12.0, band=2.5), values(-4.0, band=2.5), better="zero")
    assert found.changes[1] is not None
    assert abs(found.changes[1].a + found.changes[1].b) > found.changes[1].detectable
    assert found.outcome(1) is Outcome.CHANGED


def test_not_shown_states_what_would_have_been() -> None:
    found = one(values(1.0, 1.2, 0.8), values(1.1, 1.3, 0.9))
    change = found.changes[1]
    assert change is not None
    assert found.outcome(1) is Outcome.NOT_SHOWN
    assert change.detectable == pytest.approx(change.error.half_width(0.05))
    assert found.mostly(1) > change.detectable > abs(change.difference)


def test_a_visit_without_the_measure_is_not_tested() -> None:
    found = one(values(1.0, 1.2), None, values(1.1, 1.3))
    assert found.outcome(1) is Outcome.NOT_TESTED
    assert np.isnan(found.estimates[1])
    assert found.changes[2] is not None


def test_angles_are_taken_within_half_a_turn_of_the_baseline() -> None:
    found = one(values(3.1, 3.12), values(-3.1, -3.08), name="heading_mean")
    assert found.changes[1] is not None
    assert found.changes[1].difference == pytest.approx(2 * np.pi - 6.2)


def test_a_visit_without_bands_takes_those_of_the_others() -> None:
    found = one(values(1.0, 1.2, band=0.3), values(1.1, 1.3))
    assert found.sigmas[1] == pytest.approx(found.sigmas[0])


# --- families ------------------------------------------------------------------------------------


class Shares(NamedTuple):
    """How the variance of planted errors is divided; the rest is independent from trial to trial."""

    all_visits: float = 0.0
    visit: float = 1.0

    @property
    def trial(self) -> float:
        return 1.0 - self.all_visits - self.visit


@pytest.mark.parametrize("band, shares", [(0.0, Shares()), (0.5, Shares(0.2, 0.4))])
def test_one_false_verdict_in_a_family_has_at_most_the_level(band: float, shares: Shares) -> None:
    """25 measures of three visits with two trials each, no change at all."""
    rng, alarms, count = np.random.default_rng(3), 0, 200
    for _ in range(count):
        series: dict[Measure, list[Measured | None]] = {}
        for number in range(25):
            always = rng.normal(0, band * np.sqrt(shares.all_visits))
            common = rng.normal(0, band * np.sqrt(shares.visit), (3, 1))
            own = rng.normal(0, np.hypot(1.0, band * np.sqrt(shares.trial)), (3, 2))
            series[Measure(f"m{number}_range", "deg")] = [Measured(row, band) for row in always + common + own]
        found = follow_measures(series, 0, Repeated.TRIALS, {})
        alarms += any(one.outcome(v) is Outcome.CHANGED for one in found for v in (1, 2))
    assert alarms / count <= 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / count)


# --- walking -------------------------------------------------------------------------------------


def test_faster_walking_improved_and_the_same_is_not_shown() -> None:
    found = follow_up([BEFORE, SAME, AFTER], names=["gait_speed", "gait_cadence"])
    speed, cadence = {m.measure.name: m for m in found.measures}["gait_speed"], found.measures[0]
    assert speed.estimates == pytest.approx([1.0, 1.0, 1.4], abs=0.03)
    assert [speed.outcome(v) for v in (1, 2)] == [Outcome.NOT_SHOWN, Outcome.IMPROVED]
    assert cadence.measure.name == "gait_cadence"
    assert found.by == "cycle"
    assert found.repeated is Repeated.TRIALS
    assert not found.incomparable


def test_the_stride_has_a_band_and_times_have_none() -> None:
    own = {m.name: value for m, value in measures_of(BEFORE.trials[0], "cycle").items()}
    assert own["right_stride_length"].band_sigma == pytest.approx(0.01 * np.sqrt(2), rel=0.01)
    assert own["gait_speed"].band_sigma == pytest.approx(0.01 * np.sqrt(2) / 1.2, rel=0.03)
    assert own["right_stride_time"].band_sigma == 0
    assert own["stride_length_symmetry"].band_sigma == pytest.approx(0.02 / 1.2, rel=0.03)
    assert own["stride_time_symmetry"].band_sigma == 0
    assert own["right_knee_flexion_mean"].band_sigma == pytest.approx(np.radians(2.0), rel=0.2)


def test_an_angle_stands_for_all_its_measures() -> None:
    found = follow_up([BEFORE, AFTER], names=["right_knee_flexion"])
    ends = {one.measure.name.rpartition("_")[2] for one in found.measures}
    assert ends == {"mean", "range", "max", "min"}
    knee = {one.measure.name.rpartition("_")[2]: one.estimates for one in found.measures}
    assert knee["range"] == pytest.approx(knee["max"] - knee["min"])


def test_single_trials_test_angles_but_not_gait() -> None:
    visits = [replace(v, trials=v.trials[:1]) for v in (BEFORE, AFTER)]
    found = follow_up(visits, names=["gait_speed", "right_knee_flexion_range"])
    outcomes = {one.measure.name: one.outcome(1) for one in found.measures}
    assert found.repeated is Repeated.STRIDES
    assert outcomes["gait_speed"] is Outcome.NOT_TESTED
    assert outcomes["right_knee_flexion_range"] is not Outcome.NOT_TESTED
    assert "two trials" in next(one for one in found.measures if one.measure.is_gait).why_not


def test_on_a_treadmill_there_is_no_speed() -> None:
    walks = [
        Visit(name, tuple(trial(f"{n}", walk_at(1.2, n, treadmill=True)) for n in numbers))
        for name, numbers in (("a", (0, 1)), ("b", (2, 3)))
    ]
    names = {one.measure.name for one in follow_up(walks).measures}
    assert "gait_cadence" in names
    assert not names & {"gait_speed", "right_stride_length", "stride_length_symmetry"}


def test_squats_are_measured_by_repetition() -> None:
    visits = [
        Visit(name, (trial("s", squatting(count, depth)),)) for name, count, depth in (("a", 3, 0.3), ("b", 4, 0.4))
    ]
    found = follow_up(visits, names=["right_knee_flexion_range"])
    assert (found.by, found.kind) == ("repetition", "squat")
    assert found.measures[0].estimates[1] > found.measures[0].estimates[0]


def test_another_movement_is_a_cause() -> None:
    squats = Visit("squats", (trial("s", squatting(3)),))
    found = follow_up([BEFORE, squats])
    assert found.by == "range"
    assert any("squats: another movement: not gait" in cause for cause in found.incomparable)
    with pytest.raises(InvalidInputError, match="no gait in squats"):
        follow_up([BEFORE, squats], by="cycle")


def test_a_trial_that_is_not_gait_is_left_out_and_said() -> None:
    mixed = Visit("mixed", (*AFTER.trials, trial("s", squatting(3))))
    found = follow_up([BEFORE, mixed], names=["gait_speed"])
    assert any("mixed, s: left out, not gait" in cause for cause in found.incomparable)
    after = found.measures[0].visits[1]
    assert after is not None
    assert len(after.values) == 2


def test_wrong_input_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="two visits"):
        follow_up([BEFORE])
    with pytest.raises(InvalidInputError, match="is the same motion as before, walk0"):
        follow_up([BEFORE, Visit("copy", (BEFORE.trials[0],))])
    with pytest.raises(UnknownNameError, match="gait_speed"):
        follow_up([BEFORE, AFTER], names=["gait_sped"])
    with pytest.raises(UnknownNameError, match="gait_speed"):
        follow_up([BEFORE, AFTER], better={"gait_spee": "up"})


# --- setups --------------------------------------------------------------------------------------


def with_setup(base: Visit, name: str, setup: Setup) -> Visit:
    return Visit(name, tuple(replace(one, setup=setup) for one in base.trials))


@pytest.mark.parametrize(
    "other, words",
    [
        ({"sensors": ("LeftLeg",)}, "other sensors (without RightLeg)"),
        ({"points": ("Hips", "Nose")}, "another detector's points (with Nose)"),
        ({"software": "rtof_kin 2"}, "another version (rtof_kin 2)"),
        ({"mode": "rto"}, "another mode of reconstruction (rto)"),
        ({"subject": "P2"}, "another person (P2)"),
        ({"model": "lifter mine"}, "another lifter or other settings (lifter mine)"),
        ({"protocol": "run"}, "another task (run)"),
        ({"view": 1.6}, "another camera view (filmed 92 deg further around the person)"),
        ({"camera_distance": 6.0}, "another camera view (camera distance 6.0 m rather than 4.0 m)"),
        ({"camera_height": 2.0}, "another camera view (camera height 2.0 m rather than 1.0 m)"),
        ({"cameras": 2}, "another camera view (2 cameras rather than 1)"),
    ],
)
def test_another_setup_is_a_cause(other: dict[str, object], words: str) -> None:
    setup = Setup(
        "P1",
        "",
        "walk",
        "rtof",
        "rtof_kin 1",
        "lifter detections",
        ("LeftLeg", "RightLeg"),
        ("Hips",),
        1,
        1.0,
        4.0,
        0.0,
    )
    first = with_setup(BEFORE, "a", setup)
    causes = incomparable([first, with_setup(AFTER, "b", replace(setup, **other))], 0)  # type: ignore[arg-type]
    assert causes == (f"b: {words} than a",)
    assert not incomparable([first, with_setup(AFTER, "b", setup)], 0)


def test_failed_audits_and_other_bodies_are_causes() -> None:
    failed = with_setup(AFTER, "b", Setup(failed="wrong camera"))
    assert incomparable([BEFORE, failed], 0)[0] == "b: the audit of walk1, walk2 failed (wrong camera)"
    taller = walk_at(1.2, 4)
    lengths = {name: 1.1 * length for name, length in taller.skeleton.bone_lengths.items()}
    skeleton = taller.skeleton.with_bone_lengths(lengths)
    grown = Visit("c", (trial("t", replace(taller, skeleton=skeleton)),))
    causes = incomparable([BEFORE, grown], 0)
    assert any("other body lengths" in cause for cause in causes)


Array = NDArray[np.float64]
RNG = np.random.default_rng(11)
SEEDED = RNG.bit_generator.state
SHARED = Shares(all_visits=0.3, visit=0.4)


@pytest.fixture(autouse=True)
def same_draws() -> None:
    """Every test has the same draws, alone and among others."""
    RNG.bit_generator.state = SEEDED


def planted(trials: Sequence[int], change: float, band: float, person: float, shares: Shares) -> list[Measured]:
    """Visits of one person, the last with another true value; their bands are right."""
    always = RNG.normal(0, band * np.sqrt(shares.all_visits))
    out = []
    for number, count in enumerate(trials):
        visit = RNG.normal(0, band * np.sqrt(shares.visit))
        own = RNG.normal(0, np.hypot(person, band * np.sqrt(shares.trial)), count)
        mean = change if number == len(trials) - 1 else 0.0
        out.append(Measured(40.0 + mean + always + visit + own, band))
    return out


def error_of_change(a: Measured, b: Measured, *others: Measured) -> MixedError:
    return measurement_errors([a, *others, b]).of_means(a, b)


def p_of(visits: Sequence[Measured]) -> float:
    first, *others, last = visits
    return error_of_change(first, last, *others).p(last.mean - first.mean)


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
    errors = measurement_errors(visits)
    assert errors.bands.sigma == pytest.approx(np.sqrt(12.5))
    assert errors.bands.mdc95 == pytest.approx(1.959964 * np.sqrt(2) * errors.bands.sigma)
    assert (errors.trials.sigma, errors.trials.dof) == (pytest.approx(np.sqrt(2)), 2)
    assert errors.trials.mdc95 == pytest.approx(stats.t.isf(0.025, 2) * np.sqrt(2) * np.sqrt(2), rel=1e-5)
    assert errors.both.sigma == pytest.approx(np.sqrt(12.5 + 2 / 2))
    assert errors.both.mdc95 > errors.bands.mdc95


def test_without_repeats_or_bands_nothing_is_stated() -> None:
    one, two = Measured(np.array([40.0]), 0.0), Measured(np.array([45.0]), 0.0)
    errors = measurement_errors([one, two])
    assert all(np.isnan(own.sigma) for own in (errors.bands, errors.trials, errors.both))


def test_trials_do_not_make_errors_smaller_that_they_share() -> None:
    many = [Measured(RNG.normal(40, 1, 500), 3.0) for _ in range(2)]
    assert measurement_errors(many).both.sigma == pytest.approx(3.0, rel=0.01)


# --- planted errors ------------------------------------------------------------------------------


def test_the_stated_variance_of_a_change_is_the_planted_one() -> None:
    """No error is counted twice and none is lost, where trials share all errors of measurement."""
    draws = [planted((4, 4), 0.0, 3.0, 2.0, Shares()) for _ in range(2500)]
    changes = [b.mean - a.mean for a, b in draws]
    stated = [error_of_change(a, b).sigma ** 2 for a, b in draws]
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
    for shares in (SHARED, Shares()):
        p = [p_of(planted(trials, 0.0, 2.0, person, shares)) for _ in range(count)]
        assert np.mean(np.array(p) < 0.05) <= 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / count)


def test_the_stated_error_is_never_less_than_the_errors_whatever_their_shares() -> None:
    for shares in (Shares(), SHARED, Shares(0.0, 0.0), Shares(1.0, 0.0)):
        draws = [planted((3, 3), 0.0, 3.0, 1.0, shares) for _ in range(800)]
        spread = np.std([b.mean - a.mean for a, b in draws])
        stated = np.mean([measurement_errors([a, b]).both.sigma for a, b in draws])
        assert stated * np.sqrt(2) >= 0.95 * spread


@pytest.mark.parametrize("trials, person", [((1, 1), 0.0), ((2, 2), 1.0), ((3, 1), 4.0)])
def test_intervals_of_a_known_person_hold_where_the_stated_share_is_shared(
    trials: tuple[int, ...], person: float
) -> None:
    count, alone, covered = 700, [], []
    for _ in range(count):
        a, b = planted(trials, 5.0, 2.0, person, Shares(COMMON, 1 - COMMON))
        errors = measurement_errors([a, b], COMMON)
        known = errors.of_means(a, b, shared=COMMON)
        covered.append(abs(b.mean - a.mean - 5.0) <= known.half_width(0.05))
        alone.append(known.half_width(0.05) / errors.of_means(a, b).half_width(0.05))
        assert errors.bands.mdc95 == pytest.approx(1.959964 * np.sqrt(2 - 2 * COMMON) * errors.bands.sigma)
    assert np.mean(covered) >= 0.95 - 3.5 * np.sqrt(0.05 * 0.95 / count)
    assert np.max(alone) < 1
    assert np.min(alone) > np.sqrt(1 - COMMON) - 1e-6


KNOWN: dict[str, Any] = {"mode": "rtof", "software": "1", "sensors": ("LeftArm",), "person": ("P07", "3f2a")}


def followed(**other: Any) -> FollowUp:
    visits = [visit("a", 1.0, **KNOWN), visit("b", 1.0, first=2, **(KNOWN | other))]
    return follow_up(visits, names=["right_knee_flexion_mean", "gait_speed"])


def test_a_known_person_needs_a_smaller_change_of_angles_and_it_is_said_by_how_much() -> None:
    (angle, speed), (apart, _) = (found.measures for found in (followed(), followed(person=("P07", "77d0"))))
    changes = [one.changes[1] for one in (angle, speed, apart)]
    own, moved, independent = (change for change in changes if change is not None)
    assert own.detectable < own.detectable_independent == pytest.approx(independent.detectable)
    assert own.p < independent.p
    assert angle.errors.bands.sigma == apart.errors.bands.sigma  # of a visit
    assert angle.errors.bands.mdc95 == pytest.approx(np.sqrt(1 - COMMON) * apart.errors.bands.mdc95)
    assert np.isnan(moved.detectable_independent)  # of bands of strides it was not measured


@pytest.mark.parametrize("other", [{"person": ("P08", "3f2a")}, {"person": ()}, {"sensors": ()}, {"failed": "fail"}])
def test_visits_share_errors_only_where_nothing_else_differs(other: dict[str, Any]) -> None:
    assert followed().shared["right_knee_flexion"] == COMMON
    assert followed(**other).shared == {}


@pytest.mark.parametrize("trials", [(3, 3, 3), (6, 6)])
def test_power_is_as_predicted(trials: tuple[int, ...]) -> None:
    def found(change: float) -> float:
        p = [p_of(planted(trials, change, 2.0, 1.0, Shares())) for _ in range(800)]
        return float(np.mean(np.array(p) < 0.05))

    needed, mostly, stated = [], [], []
    for _ in range(150):
        first, *others, last = planted(trials, 0.0, 2.0, 1.0, Shares())
        error = error_of_change(first, last, *others)
        stated.append(measurement_errors([first, *others, last]).both.mdc95)
        needed.append(error.half_width(0.05))
        mostly.append(shown_mostly(error, needed[-1]))
    assert found(float(np.mean(mostly))) == pytest.approx(0.8, abs=0.06)
    assert found(float(np.mean(needed))) == pytest.approx(0.5, abs=0.06)
    assert np.mean(stated) == pytest.approx(np.mean(needed), rel=0.02)
