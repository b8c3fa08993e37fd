"""The lifting stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from reconstruction_support import BODY, FRAMES, TRUNK, TURN, Case

from rtof_kin.body import kinematics
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import ViewError
from rtof_kin.data.poses import Provenance
from rtof_kin.reconstruction.lift import lift
from rtof_kin.solve.fragment_solver import SolverStatus

GAP = slice(15, 24)


@pytest.fixture
def occluded(case: Case) -> Case:
    """Without keypoints in the frames of `GAP`."""
    return case.changed(keypoints=planted.unseen(case.recording.video, GAP))


def test_lifter_receives_keypoints_offsets_sensors_and_floor(case: Case) -> None:
    tall, lifter, sensors = BODY.with_height(1.9), case.lifter(), case.recording.bone_imus()
    lift(case.recording.video, tall, lifter, sensors, -0.4)
    ((keypoints, offsets),) = lifter.asked
    assert keypoints is case.recording.video
    np.testing.assert_array_equal(offsets, tall.joint_offsets)
    assert lifter.sensors[0] is sensors
    assert lifter.floors == [-0.4]


def test_bridged_frames_take_orientations_from_positions(occluded: Case) -> None:
    lifter = occluded.lifter(blind=GAP, turned=TURN, sigma_rad=0.2)
    poses = occluded.lift(lifter).poses
    by_position = kinematics.rotations_from_positions(BODY.parents, BODY.joint_offsets, poses.p_world_joint)
    np.testing.assert_allclose(poses.R_world_bone[GAP], by_position[GAP], atol=1e-12)
    by_lifter = occluded.truth.poses.R_world_bone @ TURN
    seen = np.delete(np.arange(FRAMES), GAP)
    np.testing.assert_allclose(poses.R_world_bone[seen], by_lifter[seen], atol=1e-9)
    assert np.isnan(poses.sigma_rad[GAP]).all()
    assert np.all(poses.sigma_rad[seen] == 0.2)
    result = occluded.run(lifter=lifter)
    assert np.isfinite(result.motion.poses.R_world_bone).all()
    assert result.solution.status is SolverStatus.CONVERGED


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_bridged_frames_are_finite_and_invalid(occluded: Case, mode: str) -> None:
    result = occluded.run(mode, lifter=occluded.lifter(blind=GAP))
    poses = result.motion.poses
    assert np.isfinite(poses.p_world_joint).all()
    np.testing.assert_array_equal(np.flatnonzero(~poses.valid.all(axis=1)), np.arange(FRAMES)[GAP])
    assert not poses.valid[GAP].any()
    assert np.all(poses.provenance[GAP, TRUNK] == Provenance.BRIDGED)
    by = Provenance.IMU if mode in ("sf2", "rtof") else Provenance.BRIDGED
    assert np.all(poses.provenance[GAP, BODY.index("LeftHand", "RightFoot")] == by)
    assert result.stage_metrics[mode]["coverage"] == pytest.approx(1 - 9 / FRAMES)


def test_bridged_frames_observe_no_pelvis_orientation(case: Case) -> None:
    """Although the pelvis' own keypoints are there: they were too few for the lifter."""
    observed = case.lift(case.lifter(blind=GAP)).poses.orientation_observed
    assert not observed[GAP].any()
    assert observed[:15, 0].all()


def test_occluded_joint_of_a_lifted_frame_has_provenance_prior(case: Case) -> None:
    head, hand = BODY.index("Head", "LeftHand")
    hidden = planted.unseen(case.recording.video, slice(5, 10), (head, hand))
    poses = case.changed(keypoints=hidden).run("sf2").motion.poses
    assert np.all(poses.provenance[5:10, head] == Provenance.PRIOR)
    assert np.all(poses.provenance[5:10, hand] == Provenance.IMU)
    assert poses.valid.all()


def test_person_behind_the_camera_is_refused_with_the_frame(case: Case) -> None:
    lifter = case.lifter()
    lifter.p[17] += [9.0, 0.0, 0.0]
    with pytest.raises(ViewError, match="frame 17 is behind the camera"):
        case.run(lifter=lifter)


def test_unseen_legs_are_not_valid_beyond_half_a_second(case: Case) -> None:
    legs = BODY.index("LeftLeg", "LeftFoot")
    video = case.recording.video
    for step, valid in ((1.0, True), (12.0, False)):  # five frames are 0.1 s, then 1.2 s
        hidden = replace(planted.unseen(video, slice(5, 10), legs), times=video.times * step)
        poses = case.changed(keypoints=hidden).lift(case.lifter()).poses
        assert np.all(poses.valid[5:10, legs] == valid)
        assert poses.valid[:5].all()
        assert np.all(poses.provenance[5:10, legs] == Provenance.PRIOR)
