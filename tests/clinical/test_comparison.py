"""Comparison of two motions on each axis: planted differences, sides, turns, gaps and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import limb, posture, walk
from comparison_support import angles_of, one
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from report_support import certain_to

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.comparison import (
    AngleComparison,
    Comparison,
    agreement,
    choose_axis,
    compare,
    compare_sides,
    compared,
    sides_of,
)
from rtof_kin.clinical.comparison_change import SHARED, Made, Verdict
from rtof_kin.clinical.comparison_samples import align
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
KNEE, HIP = "right_knee_flexion", "right_hip_flexion"
TIMES = np.arange(300) / 60
WAVE = 30 + 20 * np.sin(2 * np.pi * TIMES)


def of(found: Comparison, name: str) -> AngleComparison:
    return next(angle for angle in found.angles if angle.name == name)


def walking(sigma: float | None = 2.0, side_changed: float = 1.0) -> Motion:
    """Real walking with bands; the right knee's flexion scaled."""
    motion = walk()
    if side_changed != 1.0:
        q = np.array(motion.q)
        q[:, 7 + motion.skeleton.dof_names.index("RightLeg_y")] *= side_changed
        p, R = motion.skeleton.forward_kinematics(q)
        motion = replace(motion, q=q, poses=replace(motion.poses, p_world_joint=p, R_world_bone=R))
    return motion if sigma is None else replace(motion, confidence=certain_to(sigma, motion))


# --- in time -------------------------------------------------------------------------------------


def test_planted_offset_gives_all_errors() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE + 9}, 2.0)
    knee = of(compare(a, b, "time"), KNEE)
    mean, motion = knee.changes
    assert np.degrees([mean.a, mean.b, mean.difference]) == pytest.approx([30, 39, 9], abs=0.1)
    assert np.degrees(mean.sigma) == pytest.approx(2 * np.sqrt(2))
    assert np.degrees(motion.difference) == pytest.approx(0, abs=1e-9)
    assert np.degrees(motion.sigma) == pytest.approx(4.0)
    assert (mean.verdict, motion.verdict) == (Verdict.CHANGED, Verdict.NOT_SHOWN)
    assert knee.verdict is Verdict.CHANGED
    assert knee.largest is mean
    errors = knee.errors
    assert errors is not None
    sizes = np.degrees([errors.rmse, errors.mae, errors.median, errors.largest])
    assert sizes == pytest.approx([9, 9, 9, 9])
    assert errors.offset_removed == pytest.approx(0, abs=1e-9)
    assert errors.correlation == pytest.approx(1)


def test_errors_are_those_of_the_definition() -> None:
    difference = np.random.default_rng(0).normal(3, 2, len(TIMES))
    a, b = one("a", TIMES, {KNEE: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE + difference}, 2.0)
    errors = of(compare(a, b, "time"), KNEE).errors
    assert errors is not None
    assert np.degrees(errors.rmse) == pytest.approx(np.sqrt(np.mean(difference**2)))
    assert np.degrees(errors.mae) == pytest.approx(np.mean(np.abs(difference)))
    assert np.degrees(errors.median) == pytest.approx(np.median(np.abs(difference)))
    assert np.degrees(errors.offset_removed) == pytest.approx(difference.std())
    worst = np.abs(difference).argmax()
    assert np.degrees(errors.largest) == pytest.approx(difference[worst])
    assert errors.at == TIMES[worst]
    assert errors.correlation == pytest.approx(np.corrcoef(WAVE, WAVE + difference)[0, 1])


@given(turns=st.integers(-3, 3), offset=st.floats(-170, 170))
def test_whole_turns_do_not_count(turns: int, offset: float) -> None:
    a, b = one("a", TIMES, {KNEE: WAVE}), one("b", TIMES, {KNEE: WAVE + offset + 360 * turns})
    mean = of(compare(a, b, "time"), KNEE).changes[0]
    assert np.degrees(mean.difference) == pytest.approx(offset, abs=1e-9)


def test_more_frames_do_not_make_a_mean_more_certain() -> None:
    few, many = np.arange(20) / 60, np.arange(2000) / 60
    sigmas = [
        of(compare(one("a", t, {KNEE: 20.0}, 3.0), one("b", t, {KNEE: 21.0}, 4.0), "time"), KNEE).changes[0].sigma
        for t in (few, many)
    ]
    assert np.degrees(sigmas) == pytest.approx([5.0, 5.0])


def test_only_samples_usable_in_both_are_compared() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE + 1}, 2.0)
    values, trusted, singular = (np.array(x) for x in (a.angles.values, b.angles.known, b.angles.singular))
    values[:30], trusted[30:60], singular[60:90] = np.nan, False, True
    spoiled = np.array(b.angles.values)
    spoiled[30:90] += 1.0
    a = replace(a, angles=replace(a.angles, values=values))
    b = replace(b, angles=replace(b.angles, values=spoiled, trusted=trusted, singular=singular))
    knee = of(compare(a, b, "time"), KNEE)
    assert knee.share == pytest.approx(210 / 300)
    assert knee.errors is not None
    assert np.degrees(knee.errors.rmse) == pytest.approx(1.0)


def test_shift_moves_the_clock_of_b() -> None:
    later = one("b", TIMES + 100, {KNEE: WAVE}, 2.0)
    a = one("a", TIMES, {KNEE: WAVE}, 2.0)
    found = compare(a, later, "time", shift=-100.0)
    knee = of(found, KNEE)
    assert knee.errors is not None
    assert np.degrees(knee.errors.rmse) < 1e-6
    with pytest.raises(InvalidInputError, match=r"no instant in common.*--align"):
        compare(a, later, "time")


def test_another_rate_is_interpolated_but_no_gap_is() -> None:
    times = np.arange(500) / 100
    slow = one("b", times, {KNEE: 30 + 20 * np.sin(2 * np.pi * times)}, 2.0)
    gap = np.array(slow.angles.values)
    gap[200:250] = np.nan
    slow = replace(slow, angles=replace(slow.angles, values=gap))
    knee = of(compare(one("a", TIMES, {KNEE: WAVE}, 2.0), slow, "time"), KNEE)
    assert knee.errors is not None
    assert np.degrees(knee.errors.rmse) < 0.05
    assert knee.share == pytest.approx(0.9, abs=0.01)


def test_without_bands_of_one_the_other_alone_counts() -> None:
    mean = of(compare(one("a", TIMES, {KNEE: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE}), "time"), KNEE).changes[0]
    assert np.degrees(mean.sigma) == pytest.approx(2.0)
    neither = of(compare(one("a", TIMES, {KNEE: WAVE}), one("b", TIMES, {KNEE: WAVE}), "time"), KNEE)
    assert neither.verdict is Verdict.NOT_TESTED


def test_range_of_a_part_of_the_frames_is_not_tested() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE, HIP: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE, HIP: 3 * WAVE}, 2.0)
    values = np.array(b.angles.values)
    values[:75, 1] = np.nan
    b = replace(b, angles=replace(b.angles, values=values))
    mean, motion = of(compare(a, b, "time"), HIP).changes
    assert (mean.verdict, motion.verdict) == (Verdict.CHANGED, Verdict.NOT_TESTED)
    assert "less than 90 %" in compare(a, b, "range").left_out[HIP]


def test_sides_are_not_compared_through_the_uncertain_deepest_frames() -> None:
    right = one("a", TIMES, {KNEE: WAVE, "left_knee_flexion": WAVE / 2, HIP: WAVE, "left_hip_flexion": WAVE / 2}, 2.0)
    column, deepest = right.angles.names.index(KNEE), np.flatnonzero(WAVE > 49.5)
    trusted, sigma = np.ones(right.angles.values.shape, dtype=bool), np.array(right.angles.sigma)
    trusted[deepest, column], sigma[deepest, column] = False, np.radians(20)
    doubtful = replace(right, angles=replace(right.angles, trusted=trusted, sigma=sigma))
    assert "knee_flexion" in {angle.name for angle in compare_sides(right)[0].angles}
    found, why = compare_sides(doubtful)
    assert found.by == "range"
    assert "not walking" in why
    assert [angle.name for angle in found.angles] == ["hip_flexion"]
    assert "right: its range is >= 39, the highest" in found.left_out["knee_flexion"]


def test_squats_and_lunges_together_are_not_pooled_to_compare_the_sides() -> None:
    assert compare_sides(compared("squat", squats(110, 3, 2.5)))[0].by == "range"
    assert compare_sides(compared("walk", walking(8.0)))[0].by == "cycle"


def test_share_outside_the_band_of_the_difference() -> None:
    bump = np.where(TIMES < 1.5, 8.0, 0.0)
    found = compare(one("a", TIMES, {KNEE: WAVE}, 2.0), one("b", TIMES, {KNEE: WAVE + bump}, 2.0), "time")
    assert of(found, KNEE).outside == pytest.approx(0.3)
    assert np.isnan(of(compare(one("a", TIMES, {KNEE: WAVE}), one("b", TIMES, {KNEE: WAVE}), "time"), KNEE).outside)


# --- what is compared ----------------------------------------------------------------------------


def test_angles_of_one_alone_are_named() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE, HIP: WAVE}), one("b", TIMES, {KNEE: WAVE, HIP: np.nan})
    found = compare(a, b, "time")
    assert [angle.name for angle in found.angles] == [KNEE]
    assert found.left_out == {HIP: "not observed in b"}


def test_heading_is_left_out_unless_the_world_is_shared_or_it_is_asked_for() -> None:
    a, b = (one(n, TIMES, {KNEE: WAVE, "pelvis_rotation": 10.0}, 2.0) for n in "ab")
    assert len(compare(a, b, "time").angles) == 2
    assert "pelvis_rotation" in compare(a, b, "range").left_out
    assert len(compare(a, b, "range", names=["pelvis_rotation"]).angles) == 1
    assert "pelvis_rotation" in compare(a, replace(b, other_system=True), "time").left_out


def test_unknown_and_missing_angles_are_refused() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE, HIP: WAVE}), one("b", TIMES, {KNEE: WAVE, HIP: np.nan})
    with pytest.raises(UnknownNameError, match="right_knee_flexion"):
        compare(a, b, "time", names=["right_knee_flexon"])
    with pytest.raises(InvalidInputError, match="not observed in b"):
        compare(a, b, "time", names=[HIP])


def test_fewer_angles_are_tested_more_sharply() -> None:
    columns = {KNEE: WAVE, HIP: WAVE, "left_knee_flexion": WAVE, "left_hip_flexion": WAVE}
    a, b = one("a", TIMES, columns, 2.0), one("b", TIMES, columns | {KNEE: WAVE + 7}, 2.0)
    assert of(compare(a, b, "time"), KNEE).verdict is Verdict.NOT_SHOWN
    assert of(compare(a, b, "time", names=[KNEE]), KNEE).verdict is Verdict.CHANGED


# --- by cycle, repetition and range --------------------------------------------------------------


def test_a_walk_compared_with_itself_differs_nowhere() -> None:
    a = compared("a", walking())
    for by in ("time", "cycle", "range"):
        found = compare(a, replace(a, name="b"), by)  # type: ignore[arg-type]
        assert found.identical
        assert max(abs(c.difference) for angle in found.angles for c in angle.changes) == 0
        assert not found.changed


def test_changed_knee_is_found_by_cycle_and_range_on_other_clocks() -> None:
    before, after = walking(), walking(side_changed=1.6)
    poses = after.poses
    confidence = certain_to(2.0, after)
    later = replace(
        after, poses=replace(poses, times=poses.times + 50), confidence=replace(confidence, times=poses.times + 50)
    )
    a, b = compared("before", before, "one"), compared("after", later, "two")
    assert choose_axis(a, b, agreement(a, b)).by == "cycle"
    found = compare(a, b, "cycle")
    knee = of(found, KNEE)
    assert knee.verdict is Verdict.CHANGED
    assert min(knee.repeats) >= 1
    assert found.angles[0].name == KNEE
    assert of(found, "left_knee_flexion").verdict is Verdict.NOT_SHOWN
    ranges = compare(a, b, "range")
    assert of(ranges, KNEE).verdict is Verdict.CHANGED
    assert of(ranges, KNEE).errors is None
    assert len(of(ranges, KNEE).changes) == 1


def squats(depth: float, count: int, seconds: float) -> Motion:
    """Equal squats of both legs to a knee flexion in degrees, with bands of 2 deg."""
    time = np.arange(round(60 * (count * seconds + 1))) / 60
    phase = np.clip((time - 0.5) / seconds, 0, count)
    half = np.radians(depth) * (1 - np.cos(2 * np.pi * phase)) / 4
    turns: dict[str, Array] = {}
    for side in ("right", "left"):
        turns |= limb(side, ("thigh",), so3.about_axis("y", -half))
        turns |= limb(side, ("shank",), so3.about_axis("y", half))
    poses = posture(BODY, len(half), **turns)
    rise = -poses.p_world_joint[:, BODY.index("RightFoot")[0], 2] + 0.09
    poses = poses.with_poses(slice(None), poses.p_world_joint + rise[:, None, None] * [0, 0, 1])
    motion = BODY.motion(poses)
    return replace(motion, confidence=certain_to(2.0, motion))


def test_walks_of_a_known_person_share_errors_and_sides_of_one_do_not() -> None:
    made = Made(("P07", "3f2a"))
    a, b = (replace(compared(name, walking(2.0)), made=made) for name in "ab")
    shared, apart = (of(compare(a, other, "cycle"), KNEE).changes[0] for other in (b, replace(b, made=None)))
    assert shared.error.known == pytest.approx((1 - SHARED) * apart.error.known)
    assert shared.error.estimated == apart.error.estimated
    assert shared.detectable < shared.detectable_independent
    assert compare(a, b, "cycle").shared[KNEE] == SHARED
    assert compare(a, b, "range").shared == compare(*sides_of(a), "cycle").shared == {}


def test_squats_of_another_depth_and_tempo_are_compared_by_repetition() -> None:
    a, b = compared("a", squats(110, 3, 2.5), "one"), compared("b", squats(85, 4, 2.0), "two")
    choice = choose_axis(a, b, agreement(a, b))
    assert (choice.by, choice.kind) == ("repetition", "squat")
    knee = of(compare(a, b, "repetition"), KNEE)
    assert knee.repeats == (3, 4)
    mean, motion = knee.changes
    assert np.degrees(motion.difference) == pytest.approx(-21, abs=1)  # of the 25, between 5 and 95 % of the rise
    assert knee.verdict is Verdict.CHANGED
    assert mean.difference < 0


def test_symmetric_movement_has_equal_sides_and_a_mirrored_one_opposite_differences() -> None:
    found, _ = compare_sides(compared("squat", squats(110, 3, 2.5)), "repetition")
    assert {angle.name for angle in found.angles} >= {"knee_flexion", "hip_flexion", "elbow_flexion"}
    assert np.degrees(max(abs(c.difference) for angle in found.angles for c in angle.changes)) < 1e-6
    assert (
        of(found, "knee_flexion").changes[0].error.effective_dof == np.inf
    )  # equal in each squat: no spread of differences
    motion = walking(side_changed=1.5)
    sides, mirrored = (sides_of(compared("walk", m)) for m in (motion, mirror(motion)))
    one_way, other_way = compare(*sides, "time"), compare(*mirrored, "time")
    assert np.degrees(abs(of(one_way, "knee_flexion").changes[0].difference)) > 3
    for angle in one_way.angles:
        if angle.name == "wrist_flexion":
            continue  # turns by a whole turn in this motion
        opposite = of(other_way, angle.name)
        for first, second in zip(angle.changes, opposite.changes, strict=True):
            assert first.difference == pytest.approx(-second.difference, abs=1e-6)


def mirror(motion: Motion) -> Motion:
    """The motion with left and right exchanged: reflected in the plane y = 0."""
    names, poses = motion.skeleton.names, motion.poses
    other = [names.index(n.replace("Left", "?").replace("Right", "Left").replace("?", "Right")) for n in names]
    reflection = np.diag([1.0, -1.0, 1.0])
    R = reflection @ poses.R_world_bone[:, other] @ reflection
    p = poses.p_world_joint[:, other] @ reflection
    return replace(motion, poses=replace(poses, p_world_joint=p, R_world_bone=R))


def test_motions_without_the_axis_are_refused() -> None:
    a = compared("walk", walking())
    with pytest.raises(InvalidInputError, match=r"walk has no squat.*--by"):
        compare(a, a, "repetition")
    with pytest.raises(InvalidInputError, match="b has no complete gait cycle"):
        compare(a, one("b", TIMES, {KNEE: WAVE}), "cycle")


# --- the choice of the axis ----------------------------------------------------------------------


def test_same_clock_is_assumed_of_one_recording_only() -> None:
    a = compared("rtof", walking(), "demo")
    noisy = replace(a, name="rto", angles=replace(a.angles, values=a.angles.values + 0.05))
    clocks = agreement(a, noisy)
    assert choose_axis(a, noisy, clocks).by == "time"
    assert choose_axis(a, replace(noisy, recording="other"), clocks).by == "cycle"
    assert choose_axis(replace(a, recording=""), noisy, clocks).by == "time"
    reverse = replace(noisy, angles=replace(noisy.angles, values=noisy.angles.values[::-1]))
    assert choose_axis(a, reverse, agreement(a, reverse)).by == "cycle"
    assert choose_axis(replace(a, not_gait="dancing"), reverse, agreement(a, reverse)).by == "range"
    assert choose_axis(replace(a, strides={}), reverse, agreement(a, reverse)).by == "range"


def test_another_system_is_compared_in_time_where_the_spans_overlap() -> None:
    a, b = one("a", TIMES, {KNEE: WAVE}, 2.0), one("b.mot", TIMES, {KNEE: WAVE}, other_system=True)
    assert choose_axis(a, b, agreement(a, b)).by == "time"
    far = one("b.mot", TIMES + 100, {KNEE: WAVE}, other_system=True)
    assert choose_axis(a, far, agreement(a, far)).by == "range"
    assert choose_axis(a, far, None, "cycle").why == ""


NAMES = ("right_knee_flexion", "left_knee_flexion", "right_hip_flexion", "right_elbow_flexion")
GRID = np.arange(600) / 60


def random_movement(seed: int) -> NDArray[np.float64]:
    return 20 * planted.smooth_noise(seed, (600, len(NAMES)), 12, 1.0)


def columns(values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return dict(zip(NAMES, values.T, strict=True))


def moved(angles: ClinicalAngles, seconds: float) -> ClinicalAngles:
    """The same movement on a clock that shows earlier times by so many seconds."""
    return replace(angles, times=angles.times - seconds)


@pytest.mark.parametrize("shift", [0.0, 0.437, -3.21, 100.0])
def test_planted_shift_is_found_to_milliseconds(shift: float) -> None:
    a = angles_of(GRID, columns(random_movement(0)))
    found = align(a, moved(a, shift), NAMES)
    assert found.shift == pytest.approx(shift, abs=0.003)
    assert found.agreement > 0.98
    assert not found.poor
    assert not found.ambiguous


def test_shift_is_found_despite_offsets_scales_noise_and_another_rate() -> None:
    values = random_movement(1)
    a = angles_of(GRID, columns(values))
    times = np.arange(100, 700) / 100
    other = np.stack([np.interp(times, GRID, v) for v in values.T], axis=1)
    noise = planted.smooth_noise(9, (600, len(NAMES)), 10, 4.0)
    b = angles_of(times, columns(0.8 * other + [30, -10, 5, 0] + noise))
    found = align(a, moved(b, 1.5), NAMES)
    assert found.shift == pytest.approx(1.5, abs=0.05)
    assert abs(found.shift - 1.5) < 4 * found.sigma
    assert 0.002 < found.sigma < 0.05


def test_stated_deviation_of_the_shift_is_that_of_its_errors() -> None:
    scores = []
    for seed in range(30):
        values = random_movement(seed)
        a = angles_of(GRID, columns(values))
        noise = planted.smooth_noise(500 + seed, (600, len(NAMES)), 8, 8.0)
        found = align(a, angles_of(GRID, columns(values + noise)), NAMES)
        scores.append(found.shift / found.sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_other_movement_hardly_agrees() -> None:
    first, second = (angles_of(GRID, columns(random_movement(seed))) for seed in (0, 77))
    found = align(first, second, NAMES)
    assert found.poor


def test_walking_is_ambiguous_by_a_stride() -> None:
    angles = clinical_angles(walk())
    found = align(angles, angles, [name for name in NAMES if "elbow" not in name])
    assert found.shift == pytest.approx(0.0, abs=1e-3)
    assert abs(found.rival) == pytest.approx(1.2, abs=0.15)  # the stride time of this walk
    assert found.ambiguous


def test_agreement_without_a_shift_is_that_of_the_given_clocks() -> None:
    a = angles_of(GRID, columns(random_movement(0)))
    assert align(a, a, NAMES).unshifted == pytest.approx(align(a, a, NAMES).agreement)
    assert align(a, moved(a, 0.5), NAMES).unshifted < 0.6
    assert np.isnan(align(a, moved(a, 100.0), NAMES).unshifted)


def test_nothing_that_moves_is_refused() -> None:
    still = angles_of(GRID, dict.fromkeys(NAMES, 10.0))
    with pytest.raises(InvalidInputError, match="--angles"):
        align(still, still, NAMES)


def test_gaps_do_not_count() -> None:
    values = random_movement(3)
    a = angles_of(GRID, columns(values))
    values[100:200, 0] = np.nan
    values[300:310] = np.nan
    found = align(a, moved(angles_of(GRID, columns(values)), 0.25), NAMES)
    assert found.shift == pytest.approx(0.25, abs=0.005)
    assert found.agreement > 0.97
