"""Gait events and cycles of planted and of real walking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import LEG, limb, posture, walk, walking
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.clinical.gait import PHASES, CycleCurves, GaitAnalysis, analyse_gait, cycle_curves
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.paths import body_paths
from rtof_kin.core import rotations as so3
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
    assert all("stance takes less than 55 %" in note for note in gait.notes)


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


def test_standing_has_no_strides() -> None:
    gait = analysed(planted.standing(BODY, 120).poses)
    assert gait.strides == ()
    assert gait.summary == {}
    assert any("right foot: no heel strike in 2.0 s" in note for note in gait.notes)
    assert any("symmetry" in note for note in gait.notes)


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


def test_unsteady_strides_and_running_are_noted() -> None:
    times = np.arange(480) / 60
    phase = 2 * np.pi * (times / 1.2 + 0.35 * np.sin(2 * np.pi * times / 5))
    notes = " ".join(analysed(swung(phase, phase + np.pi)).notes)
    assert "not steady walking" in notes
    assert "stance takes less than 55 %" in notes


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
