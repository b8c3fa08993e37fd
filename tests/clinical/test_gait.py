"""Gait events and cycles of planted and of real walking."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import LEG, body_paths, limb, posture, squatting, walk, walking
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.clinical.gait import (
    PHASES,
    CycleCurves,
    GaitAnalysis,
    StrideShape,
    analyse_gait,
    cycle_curves,
    departures,
    stride_shape,
)
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.repetitions import RepetitionAnalysis, find_repetitions
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PERIOD = 1.2


def swung(right: Array, left: Array, **turns: Array) -> PoseSequence:
    """Straight legs that swing by 25 degrees with the phases given, radians."""
    for side, phase in (("right", right), ("left", left)):
        turns |= limb(side, LEG, so3.about_axis("y", np.radians(25) * np.sin(phase)))
    return posture(BODY, len(right), **turns)


def swinging_legs(frames: int = 360, speed: float = 0.0, heading: float = 0.0) -> PoseSequence:
    """Straight legs that swing by 25 degrees in opposite phase under a moving pelvis."""
    times = np.arange(frames) / 60
    swing, R = 2 * np.pi * times / PERIOD, so3.about_axis("z", heading)
    poses = swung(swing, swing + np.pi, body=R)
    path = speed * times[:, None] * R[:, 0]
    return poses.with_poses(slice(None), poses.p_world_joint + path[:, None])


def analysed(poses: PoseSequence, skeleton: SkeletonModel = BODY) -> GaitAnalysis:
    return analyse_gait(gait_events(body_paths(poses, skeleton)))


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
def test_events_are_at_the_extremes_of_the_swing(heading: float) -> None:
    events = gait_events(body_paths(swinging_legs(heading=heading), BODY))
    right, left = events.feet["right"], events.feet["left"]
    np.testing.assert_allclose((right.strikes / PERIOD) % 1, 0.75, atol=0.02)
    np.testing.assert_allclose((right.offs / PERIOD) % 1, 0.25, atol=0.02)
    np.testing.assert_allclose((left.strikes / PERIOD) % 1, 0.25, atol=0.02)
    assert len(right.strikes) == len(left.strikes) == 5
    assert events.notes == ()


def test_parameters_of_planted_strides() -> None:
    gait = analysed(swinging_legs(speed=1.1))
    for side in ("right", "left"):
        measures = gait.summary[side]
        assert measures["cadence"][0] == pytest.approx(100, rel=2e-3)
        assert measures["stride_length"][0] == pytest.approx(1.1 * PERIOD, rel=2e-3)
        assert measures["stance_share"][0] == pytest.approx(0.5, abs=0.01)
        assert measures["speed"][0] == pytest.approx(1.1, rel=2e-3)
        assert measures["stride_time"][1] < 0.005
    assert all(abs(value) < 0.02 for value in gait.symmetry.values())
    assert gait.notes == ()


def test_treadmill_walking_has_the_same_events_and_no_stride_length() -> None:
    walking, treadmill = analysed(swinging_legs(speed=1.1)), analysed(swinging_legs())
    assert [s.start for s in walking.strides] == pytest.approx([s.start for s in treadmill.strides])
    assert treadmill.summary["right"]["stride_length"][0] < 0.01


def transitions(skeleton: SkeletonModel, poses: PoseSequence, landmark: str) -> tuple[Array, Array]:
    """Times at which a point of the foot crosses 0.6 m/s, and its height."""
    points = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    path = points[:, list(skeleton.landmarks).index(landmark)]
    moving = np.linalg.norm(np.gradient(path, poses.times, axis=0), axis=-1) > 0.6
    change = np.flatnonzero(np.diff(moving.astype(int)))
    return (poses.times[change] + poses.times[change + 1]) / 2, path[:, 2] - path[:, 2].min()


def test_events_of_real_walking_are_at_low_feet_that_stop_or_start() -> None:
    motion = walk()
    events = gait_events(body_paths(motion.poses, motion.skeleton))
    compared = 0
    for side, foot in events.feet.items():
        for instants, point in ((foot.strikes, "Heel"), (foot.offs, "ToeBase")):
            changes, height = transitions(motion.skeleton, motion.poses, side.title() + point)
            for instant in instants:
                assert np.abs(changes - instant).min() < 0.06
                assert np.interp(instant, motion.times, height) < 0.06
                compared += 1
    assert compared >= 14


def test_real_walking_has_normative_parameters() -> None:
    motion = walk()
    gait = analysed(motion.poses, motion.skeleton)
    assert len(gait.strides) == 5
    for side in ("right", "left"):
        measures = gait.summary[side]
        assert 90 < measures["cadence"][0] < 110
        assert 1.1 < measures["stride_length"][0] < 1.3
        assert 0.62 < measures["stance_share"][0] < 0.70
    assert all(abs(value) < 0.05 for value in gait.symmetry.values())
    assert gait.notes == ()


def curve(curves: tuple[CycleCurves, ...], name: str, side: str) -> CycleCurves:
    return next(c for c in curves if (c.name, c.side) == (name, side))


def test_cycle_curves_of_real_walking_have_their_known_extremes() -> None:
    motion = walk()
    curves = cycle_curves(clinical_angles(motion), analysed(motion.poses, motion.skeleton))
    for side in ("right", "left"):
        hip = np.degrees(curve(curves, f"{side}_hip_flexion", side).mean)
        assert hip[0] > 20
        assert 40 < 100 * PHASES[hip.argmin()] < 65
        knee = curve(curves, f"{side}_knee_flexion", side)
        assert 65 < 100 * PHASES[knee.mean.argmax()] < 85
        assert 55 < np.degrees(knee.mean.max()) < 75
        assert np.degrees(knee.sd.mean()) < 4
        ankle = curve(curves, f"{side}_ankle_dorsiflexion", side)
        assert 58 < 100 * PHASES[ankle.mean.argmin()] < 75
    assert {c.side for c in curves if c.name == "pelvis_list"} == {"right", "left"}


def test_mean_and_standard_deviation_of_cycle_curves() -> None:
    curves = np.stack([np.sin(PHASES), np.sin(PHASES) + 0.2])
    known = CycleCurves("right_hip_flexion", "right", curves)
    np.testing.assert_allclose(known.mean, np.sin(PHASES) + 0.1)
    np.testing.assert_allclose(known.sd, 0.2 / np.sqrt(2))
    assert np.isnan(replace(known, curves=curves[:1]).sd).all()


def test_an_unobserved_leg_has_no_events() -> None:
    poses = swinging_legs()
    provenance = np.full(poses.valid.shape, Provenance.CAMERA_AND_IMU, dtype=np.uint8)
    provenance[:, BODY.index("LeftFoot")] = Provenance.PRIOR
    gait = analysed(replace(poses, provenance=provenance))
    assert set(gait.summary) == {"right"}
    assert any("left foot: never observed" in note for note in gait.notes)
    assert gait.symmetry == {}


def test_a_single_stride_has_no_standard_deviation() -> None:
    gait = analysed(swinging_legs(120))
    assert any("a single complete stride" in note for note in gait.notes)
    assert all(np.isnan(spread) for m in gait.summary.values() for _, spread, n in m.values() if n == 1)


def test_running_is_no_gait() -> None:
    times = np.arange(480) / 60
    phase = 2 * np.pi * (times / 1.2 + 0.35 * np.sin(2 * np.pi * times / 5))
    assert "stance takes less than 55 %" in analysed(swung(phase, phase + np.pi)).why_not


def test_hopping_on_both_legs_has_no_strides() -> None:
    phase = 2 * np.pi * np.arange(240) / 60 / PERIOD
    gait = analysed(swung(phase, phase))
    assert gait.strides == ()
    assert any("a strike of the other foot between them" in note for note in gait.notes)


def test_strides_do_not_reach_across_gaps() -> None:
    poses = swinging_legs()
    p = np.array(poses.p_world_joint)
    p[150:160] = np.nan
    gait = analysed(replace(poses, p_world_joint=p, valid=None))
    gap = poses.times[150], poses.times[159]
    assert gait.strides
    assert all(s.stop < gap[0] or s.start > gap[1] for s in gait.strides)


@pytest.mark.parametrize("step", [13, 60, 180])
def test_low_rates_have_no_gait_events(step: int) -> None:
    gait = analysed(swinging_legs()[::step])
    assert gait.strides == ()
    assert f"{60 / step:.3g} Hz is too low a rate" in gait.notes[0]
    gait = analysed(swinging_legs()[::12])
    assert gait.summary["right"]["stride_time"][0] == pytest.approx(PERIOD, rel=0.01)


def test_one_frame_without_foot_orientation_does_not_change_others() -> None:
    whole = gait_events(body_paths(swinging_legs(), BODY))
    observed = np.ones((360, len(BODY.names)), dtype=bool)
    observed[0, BODY.index("RightFoot", "LeftFoot")] = False
    events = gait_events(body_paths(replace(swinging_legs(), orientation_observed=observed), BODY))
    assert all("foot: orientation unobserved for 0.017 s" in note for note in events.notes)
    for side, foot in events.feet.items():
        assert np.isnan(foot.heel[0]).all()
        np.testing.assert_array_equal(foot.heel[1:], whole.feet[side].heel[1:])
        np.testing.assert_allclose(foot.strikes, whole.feet[side].strikes, atol=1e-3)


def test_a_foot_without_orientation_has_the_events_of_the_ankle() -> None:
    observed = np.ones((360, len(BODY.names)), dtype=bool)
    observed[:216, BODY.index("RightFoot")] = False
    events = gait_events(body_paths(replace(swinging_legs(), orientation_observed=observed), BODY))
    (note,) = events.notes
    assert "right foot: orientation unobserved in 60 % of the frames" in note
    ankle = swinging_legs().p_world_joint[:, BODY.index("RightFoot")[0]]
    np.testing.assert_array_equal(events.feet["right"].heel, ankle)
    assert (events.feet["right"].by_ankle, events.feet["left"].by_ankle) == (True, False)
    poses = replace(swinging_legs(), orientation_observed=BODY.orientation_observed())
    strikes = gait_events(body_paths(poses, BODY)).feet["right"].strikes
    np.testing.assert_allclose((strikes / PERIOD) % 1, 0.75, atol=0.03)


def test_a_cycle_with_a_gap_in_an_angle_is_excluded_for_that_angle() -> None:
    poses = swinging_legs()
    angles, gait = clinical_angles(poses, BODY), analysed(poses)
    values = np.array(angles.values)
    values[150, angles.names.index("right_hip_flexion")] = np.nan
    curves = cycle_curves(replace(angles, values=values), gait)
    whole = len(curve(curves, "right_knee_flexion", "right").curves)
    assert len(curve(curves, "right_hip_flexion", "right").curves) == whole - 1


def in_a_circle(radius: float, speed: float = 1.1) -> Motion:
    """Symmetric walking to the left along a circle of some radius, m."""
    motion = walking(10.0, speed=speed, treadmill=True)
    poses, angle = motion.poses, speed / radius * motion.times
    turn = so3.about_axis("z", angle)
    root = poses.p_world_joint[:, :1] * [0, 0, 1]
    path = radius * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=-1)
    p = np.einsum("tij,tkj->tki", turn, poses.p_world_joint - root) + root + path[:, None]
    return BODY.motion(poses.with_poses(slice(None), p, turn[:, None] @ poses.R_world_bone))


def test_walking_in_a_circle_is_no_asymmetry_of_the_strides() -> None:
    gait = analyse(in_a_circle(2.5)).gait
    assert gait.is_gait
    assert abs(gait.symmetry["stride_length"]) < 0.01
    for side in ("right", "left"):
        assert gait.summary[side]["stride_length"][0] == pytest.approx(1.32, abs=0.02)


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_pelvis_rotation_over_the_cycle_is_from_the_direction_of_walking(heading: float) -> None:
    for motion in (walking(6.0, heading=heading), in_a_circle(2.5)):
        found = [c for c in analyse(motion).curves if c.name == "pelvis_rotation"]
        assert {curve.side for curve in found} == {"right", "left"}
        assert np.degrees(max(np.abs(curve.curves).max() for curve in found)) < 5


def test_measures_of_gait_are_of_its_strides_of_walking_alone() -> None:
    gait = analyse(walking(8.0)).gait
    odd = replace(gait.verdict, walking=gait.verdict.walking[1:])
    assert len(replace(gait, verdict=odd).counted) == len(gait.strides) - 1
    assert replace(gait, verdict=replace(odd, why_not="It is a dance.")).counted == gait.strides


WALKING = StrideShape(0.64, 0.5, swing=0.8, progress=1.3, forward=1.0, turn=0.0, slip=0.01)
SPOT = replace(WALKING, progress=0.02, forward=0.0, slip=0.45)


def recognised(motion: Motion) -> GaitAnalysis:
    return analyse_gait(gait_events(body_paths(motion.poses, motion.skeleton)))


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
def test_planted_walking_is_gait(heading: float) -> None:
    gait = recognised(walking(heading=heading))
    assert (gait.is_gait, gait.why_not) == (True, "")
    assert gait.verdict.walking == gait.strides
    assert not gait.verdict.on_the_spot


def test_shape_of_a_planted_stride() -> None:
    gait = recognised(walking(speed=1.1, stride_time=1.2, late=0.4))
    right = next(stride for stride in gait.strides if stride.side == "right")
    shape = stride_shape(right, gait.events)
    assert shape.progress == pytest.approx(1.32, abs=0.01)
    assert shape.phase == pytest.approx(0.4, abs=0.01)
    assert shape.forward == pytest.approx(1)
    assert abs(shape.turn) < 1e-6
    assert shape.slip < 0.03
    assert gait.is_gait  # a limp is gait too


def test_real_walking_is_gait_and_without_feet_too() -> None:
    motion = walk()
    assert recognised(motion).is_gait
    observed = np.ones(len(motion.skeleton.names), dtype=bool)
    observed[motion.skeleton.index("RightFoot", "LeftFoot")] = False
    assert recognised(replace(motion, poses=replace(motion.poses, orientation_observed=observed))).is_gait


def test_treadmill_walking_is_gait_on_the_spot() -> None:
    verdict = recognised(walking(treadmill=True)).verdict
    assert verdict.is_gait
    assert verdict.on_the_spot


def moved_to(p: Array, R: Array) -> PoseSequence:
    """Observed poses at 60 Hz."""
    return all_observed(PoseSequence(np.arange(len(p)) / 60, p, R, BODY.names))


def standing_first(motion: Motion, seconds: float) -> Motion:
    """A motion whose first frame is held before it."""
    poses, held = motion.poses, round(60 * seconds)
    p, R = (np.concatenate([np.repeat(x[:1], held, axis=0), x]) for x in (poses.p_world_joint, poses.R_world_bone))
    return BODY.motion(moved_to(p, R))


@pytest.mark.parametrize(("seconds", "strides"), [(1.8, 1), (2.4, 2)])
def test_a_short_walk_is_gait_from_one_stride_on_and_says_on_what(seconds: float, strides: int) -> None:
    gait = recognised(walking(seconds))
    assert gait.is_gait
    assert len(gait.verdict.walking) == strides
    assert gait.rests_on.startswith(f"{strides} stride")
    assert gait.notes[0] == f"all measures rest on {gait.rests_on}: they may not represent usual walking"
    assert gait.verdict.too_few.startswith(f"Only {strides} complete stride")  # for gait scores and visits
    (side,) = list(gait.summary)[:1]
    assert gait.summary[side]["stride_length"][0] == pytest.approx(1.32, abs=0.05)


@pytest.mark.parametrize(
    ("motion", "why"),
    [
        (lambda: walking(12, jitter=0.15), "The strides are not steady: their times vary by"),
        (lambda: walking(2.4, treadmill=True), "Only 2 complete strides of walking: at least 3"),
        (lambda: standing_first(walking(2.4), 3.0), "Only 2 complete strides of walking: at least 3"),
        (lambda: walking(speed=-1.0), "none of 7 stride-like movements has the shape of walking"),
        (squatting, "No complete stride was found"),
        (lambda: planted.standing(BODY, 120), "No complete stride was found"),
    ],
)
def test_other_motions_have_a_reason(motion: object, why: str) -> None:
    gait = recognised(motion())  # type: ignore[operator]
    assert not gait.is_gait
    assert why in gait.why_not
    assert gait.why_not.count(".") - gait.why_not.count("0.") == 1  # one sentence


@pytest.mark.parametrize(
    ("shape", "phrase"),
    [
        (replace(WALKING, stance_share=0.4), "running and jumping"),
        (replace(WALKING, stance_share=0.9), "more than 82 %"),
        (replace(WALKING, phase=0.2), "alternate evenly"),
        (replace(WALKING, swing=0.1), "swings less than 0.20 m"),
        (replace(WALKING, progress=0.25), "0.2 to 0.3 m"),
        (replace(WALKING, forward=-1.0), "backward or sideways"),
        (replace(WALKING, turn=-2.0), "turns by more than 70 deg"),
        (replace(WALKING, slip=0.3), "slides or hops"),
        (replace(SPOT, swing=0.3, slip=0.15), "swings less than 0.35 m"),
        (replace(SPOT, slip=0.1), "glide back as on a treadmill"),
        (replace(SPOT, slip=0.9), "glide back as on a treadmill"),
        (replace(SPOT, phase=0.4), "alternate evenly"),
        (replace(WALKING, swing=np.nan), "swings less"),
        (replace(WALKING, turn=np.nan), "turns by more"),
    ],
)
def test_each_departure_from_walking_is_named(shape: StrideShape, phrase: str) -> None:
    (text,) = departures(shape)
    assert phrase in text


def test_walking_of_every_kind_has_no_departure() -> None:
    assert departures(WALKING) == departures(SPOT) == ()
    assert departures(replace(WALKING, phase=np.nan)) == ()  # one foot was never observed


def test_a_walk_among_other_movements_is_judged_by_its_share_of_strides() -> None:
    gait = recognised(walking(6.0))
    turned = walking(6.0, speed=-1.0)
    walk_poses, back = walking(6.0).poses, turned.poses
    p = np.concatenate([walk_poses.p_world_joint, back.p_world_joint + np.array([6.6, 0, 0])])
    R = np.concatenate([walk_poses.R_world_bone, back.R_world_bone])
    mixed = analyse_gait(gait_events(body_paths(moved_to(p, R), BODY)))
    assert len(mixed.verdict.walking) >= len(gait.strides) - 1
    assert not mixed.is_gait
    assert "only 8 of 17 stride-like movements have the shape of walking" in mixed.why_not


def test_unobserved_feet_and_low_rates_are_named() -> None:
    motion = walking()
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[:, BODY.index("RightFoot", "LeftFoot")] = Provenance.PRIOR
    unseen = analyse_gait(gait_events(body_paths(replace(motion.poses, provenance=provenance), BODY)))
    assert unseen.why_not.startswith("Walking cannot be recognised: right foot: never observed")
    slow = analyse_gait(gait_events(body_paths(motion.poses[::15], BODY)))
    assert slow.why_not.startswith("Walking cannot be recognised: 4 Hz is too low a rate")


LEG_LENGTH = 0.792
"""Thigh and shank of the shipped skeleton, m."""


def knees(*phases: tuple[float, float]) -> PoseSequence:
    """Knees that bend to angles in degrees, each within so many seconds, above fixed ankles."""
    bend = [np.zeros(1)]
    for angle, seconds in phases:
        share = (1 - np.cos(np.linspace(0, np.pi, round(60 * seconds) + 1)[1:])) / 2
        bend.append(bend[-1][-1] + share * (angle - bend[-1][-1]))
    half = np.radians(np.concatenate(bend)) / 2
    turns: dict[str, Array] = {}
    for side in ("right", "left"):
        turns |= limb(side, ("thigh",), so3.about_axis("y", -half))
        turns |= limb(side, ("shank",), so3.about_axis("y", half))
    poses = posture(BODY, len(half), **turns)
    rise = -poses.p_world_joint[:, BODY.index("RightFoot")[0], 2] + 0.09
    return poses.with_poses(slice(None), poses.p_world_joint + rise[:, None, None] * [0, 0, 1])


_half = np.radians(55) * (1 - np.cos(np.linspace(0, np.pi, 1001))) / 2
_way = (1 - np.cos(_half)) / (1 - np.cos(_half[-1]))
MOVING = float(np.mean((_way > 0.05) & (_way < 0.95)))
"""Share of the time of a descent in which the pelvis is between 5 and 95 % of it."""
AT_THE_BOTTOM = float(np.mean(_way >= 0.95))


def found(poses: PoseSequence, kind: Any = "squat", skeleton: SkeletonModel = BODY) -> RepetitionAnalysis:
    return find_repetitions(body_paths(poses, skeleton), clinical_angles(poses, skeleton), kind)


SQUAT = ((110.0, 1.5), (110.0, 0.5), (0.0, 1.0), (0.0, 1.0))


def test_squats_are_counted_with_their_depth_and_tempo() -> None:
    analysis = found(knees((0, 1), *SQUAT, *SQUAT, *SQUAT))
    assert len(analysis.repetitions) == 3
    assert analysis.notes == ()
    for squat in analysis.repetitions:
        assert squat.depth == pytest.approx(LEG_LENGTH * (1 - np.cos(np.radians(55))), abs=0.01)
        assert squat.depth_share == pytest.approx(1 - np.cos(np.radians(55)), abs=0.01)
        assert np.degrees(squat.knee_flexion["right"]) == pytest.approx(110, abs=1)
        assert squat.descent_time == pytest.approx(1.5 * MOVING, abs=0.06)
        assert squat.ascent_time == pytest.approx(1.0 * MOVING, abs=0.06)
        assert squat.bottom_time == pytest.approx(0.5 + 2.5 * AT_THE_BOTTOM, abs=0.06)
    starts = [squat.descent[0] for squat in analysis.repetitions if squat.descent]
    assert np.diff(starts) == pytest.approx([4.0, 4.0], abs=0.05)
    assert analysis.total_time == pytest.approx(8.5 + 2.5 * (MOVING + AT_THE_BOTTOM), abs=0.06)


def test_rises_count_without_a_recorded_descent() -> None:
    sit = ((95.0, 1.2), (95.0, 1.0), (0.0, 1.0), (0.0, 0.8))
    poses = knees((95, 1), (95, 1), (0, 1.0), (0, 0.8), *sit, *sit)[60:]
    analysis = found(poses, "sit_to_stand")
    assert len(analysis.repetitions) == 3
    assert analysis.repetitions[0].descent is None
    assert np.isnan(analysis.repetitions[0].descent_time)
    assert analysis.repetitions[1].descent_time == pytest.approx(1.2 * MOVING, abs=0.06)
    assert analysis.total_time == pytest.approx(9.0, abs=0.4)
    squats = found(poses, "squat")
    assert len(squats.repetitions) == 2
    assert any("1 movement(s) cut by a gap or an end" in note for note in squats.notes)


def test_walking_and_standing_are_no_squats() -> None:
    motion = walk()
    for poses, skeleton in ((motion.poses, motion.skeleton), (planted.standing(BODY, 120).poses, BODY)):
        analysis = found(poses, "squat", skeleton)
        assert analysis.repetitions == ()
        assert "15 %" in analysis.notes[0]
        assert np.isnan(analysis.total_time)


def test_noise_and_sway_add_no_repetitions() -> None:
    poses = knees((0, 1), *SQUAT, *SQUAT)
    noise = planted.smooth_noise(1, (len(poses), 1, 3), 10, 0.01)
    rough = np.random.default_rng(0).normal(0, 0.004, poses.p_world_joint.shape)
    noisy = poses.with_poses(slice(None), poses.p_world_joint + noise + rough)
    assert len(found(noisy).repetitions) == 2


def test_a_repetition_cut_by_a_gap_is_not_counted() -> None:
    poses = knees((0, 1), *SQUAT, *SQUAT)
    p = np.array(poses.p_world_joint)
    p[130:140] = np.nan
    analysis = found(replace(poses, p_world_joint=p, valid=None))
    assert len(analysis.repetitions) == 1
    assert any("cut by a gap" in note for note in analysis.notes)


def test_squats_are_counted_with_one_leg_unobserved() -> None:
    poses = knees((0, 1), *SQUAT)
    provenance = np.full(poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[:, BODY.index("LeftLeg", "LeftFoot")] = Provenance.PRIOR
    observed = ~np.isin(BODY.names, ("LeftLeg", "LeftFoot"))
    analysis = found(replace(poses, provenance=provenance, orientation_observed=observed))
    assert len(analysis.repetitions) == 1
    assert any("one ankle was never observed" in note for note in analysis.notes)
    assert np.isnan(analysis.repetitions[0].knee_flexion["left"])
    assert np.degrees(analysis.repetitions[0].knee_flexion["right"]) == pytest.approx(110, abs=1)


def test_unknown_kinds_of_repetition_are_rejected() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'squat'"):
        found(knees((0, 1)), "squats")
