"""`reconstruct` with a lifter whose errors are planted."""

from __future__ import annotations

import logging
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import CalibrationError, InvalidInputError, ShapeError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.reconstruction.pipeline import calibrate_recording, reconstruct
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import SolverStatus
from rtof_kin.solve.inertial_ik import InertialGuidedIK, InertialGuidedIKSettings
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.uncertainty.covariance_inflation import CovarianceInflation
from rtof_kin.solve.uncertainty.disagreement import disagreement

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T = 40
SETTINGS = ReconstructionSettings(frames=16)
TRUNK = BODY.index("Hips", "Spine", "Spine1", "Neck", "Head", "LeftShoulder", "RightShoulder")


@pytest.fixture(scope="module")
def truth() -> MotionSequence:
    return planted.human(BODY, T)


@pytest.fixture(scope="module")
def recording(truth: MotionSequence) -> Recording:
    return planted.recording(truth, sigma_px=3.0, degrees=3.0)


@pytest.fixture(scope="module")
def results(truth: MotionSequence, recording: Recording) -> dict[str, Reconstruction]:
    return {mode: run(recording, truth, mode) for mode in CAMERA_MODES}


def run(recording: Recording, truth: MotionSequence, mode: str = "rtof", **how: Any) -> Reconstruction:
    """As it is given, where nothing else is said: what is right already needs no calibration."""
    options: dict[str, Any] = {
        "lifter": planted.PlantedLifter(truth), "settings": SETTINGS, "calibrate": False
    }  # fmt: skip
    return reconstruct(recording, mode=mode, **(options | how))


# --- the modes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode, stages", [
    ("lift", ["lift"]), ("sf2", ["lift", "sf2"]), ("rto", ["lift", "rto"]),
    ("rtof", ["lift", "sf2", "rtof"]),
])  # fmt: skip
def test_a_mode_runs_its_stages_and_scores_them(
    results: dict[str, Reconstruction], mode: str, stages: list[str]
) -> None:
    result = results[mode]
    assert result.mode == mode
    assert list(result.stages) == list(result.stage_metrics) == stages
    assert result.metrics is result.stage_metrics[mode]
    assert (result.solution is not None) == (mode in ("rto", "rtof"))
    assert (result.bone_imus is not None) == (mode in ("sf2", "rtof"))


def test_each_stage_is_better_than_the_one_before(results: dict[str, Reconstruction]) -> None:
    score = {mode: result.stage_metrics[mode] for mode, result in results.items()}
    assert score["rtof"]["mpjpe_rr_mm"] < 0.7 * score["sf2"]["mpjpe_rr_mm"]
    assert score["sf2"]["mpjpe_rr_mm"] < 0.9 * score["lift"]["mpjpe_rr_mm"]
    assert score["rto"]["mpjpe_rr_mm"] < 0.9 * score["lift"]["mpjpe_rr_mm"]
    assert score["rtof"]["mpjpe_mm"] < 0.6 * score["lift"]["mpjpe_mm"]
    assert score["rtof"]["flexion_deg"] < 0.6 * score["lift"]["flexion_deg"]
    assert results["rtof"].solution is not None
    assert results["rtof"].solution.status is SolverStatus.CONVERGED


@pytest.mark.parametrize("mode, start, seen", [("rto", "lift", "camera"), ("rtof", "sf2", "fused")])
def test_what_is_far_from_its_start_is_stated_as_uncertain(
    results: dict[str, Reconstruction], mode: str, start: str, seen: str
) -> None:
    motion = results[mode].motion
    told = motion.confidence
    assert told is not None
    apart = disagreement(motion.poses, results[mode].stages[start], told.pairs).relative[:, 1:]
    added = CovarianceInflation.shipped().shares[seen]["relative"] ** 2 * np.trace(apart, axis1=2, axis2=3)
    stated = np.trace(told.relative_covariance[:, 1:], axis1=2, axis2=3)
    assert (stated > added).all()


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_the_motion_is_the_subjects_rigid_skeleton_at_the_keypoints_times(
    results: dict[str, Reconstruction], recording: Recording, mode: str
) -> None:
    motion = results[mode].motion
    assert motion.q.shape == (T, BODY.nq)
    p, R = BODY.forward_kinematics(motion.q)
    np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(R, motion.poses.R_world_bone, atol=1e-9)
    np.testing.assert_array_equal(motion.times, recording.keypoints.times)
    assert np.abs(np.diff(motion.q, axis=0)).max() < 1.0
    assert motion.poses.valid.all()


@pytest.mark.parametrize("mode", ["sf2", "rto", "rtof"])
def test_what_is_scored_is_the_motion_that_is_delivered(
    results: dict[str, Reconstruction], mode: str
) -> None:
    result = results[mode]
    assert result.stages[mode] is result.motion.poses


def test_provenance_tells_who_saw_each_joint(results: dict[str, Reconstruction]) -> None:
    (hand,) = BODY.index("LeftHand")
    seen = {mode: result.motion.poses.provenance for mode, result in results.items()}
    for mode in ("lift", "rto"):
        assert np.all(seen[mode] == Provenance.CAMERA)
    for mode in ("sf2", "rtof"):
        assert np.all(seen[mode][:, hand] == Provenance.CAMERA_AND_IMU)
        assert np.all(seen[mode][:, TRUNK] == Provenance.CAMERA)
    observed = results["rtof"].motion.poses.orientation_observed
    assert observed[:, BODY.index(*planted.LIMBS)].all()
    assert not observed[:, hand].any()


def test_equal_calls_give_equal_answers(
    results: dict[str, Reconstruction], recording: Recording, truth: MotionSequence
) -> None:
    again = run(recording, truth)
    np.testing.assert_array_equal(again.motion.q, results["rtof"].motion.q)


def test_without_truth_there_are_no_scores(recording: Recording, truth: MotionSequence) -> None:
    result = run(replace(recording, truth=None), truth, "sf2")
    assert result.metrics is None
    assert result.stage_metrics == {}


def test_the_lifter_is_asked_once_with_all_keypoints_and_the_subjects_offsets(
    recording: Recording, truth: MotionSequence
) -> None:
    tall, lifter = BODY.with_height(1.9), planted.PlantedLifter(truth)
    result = run(recording, truth, "lift", skeleton=tall, lifter=lifter)
    (keypoints, offsets), *excerpts = lifter.asked
    assert all(len(others) < len(recording.keypoints) for others, _ in excerpts)
    assert keypoints is recording.keypoints
    np.testing.assert_array_equal(offsets, tall.joint_offsets)
    assert result.motion.skeleton is tall


@pytest.mark.parametrize("floor", [None, -0.4])
def test_the_recordings_floor_reaches_lifter_and_solver(
    recording: Recording, truth: MotionSequence, floor: float | None
) -> None:
    lifter = planted.PlantedLifter(truth)
    found = run(replace(recording, floor_height=floor), truth, lifter=lifter)
    assert lifter.floors[0] == floor
    assert found.solution is not None
    assert (found.solution.energy["floor"] > 0) == (floor is not None)
    given = ReconstructionSettings(frames=16, fragment=JointSpaceSettings(floor_height=5.0))
    high = run(replace(recording, floor_height=floor), truth, settings=given)
    assert high.solution is not None
    assert high.solution.energy["floor"] > 10, "settings stand above the recording"


def test_ankles_that_seem_to_be_below_the_floor_stand_on_it(
    recording: Recording, truth: MotionSequence
) -> None:
    lower = Quantity("ankle height", "feet", np.array([-0.3]), np.array([0.02]), np.array([0.02]), 0.9)
    on_it = replace(lower, value=np.array([-0.06]))
    results = [
        run(replace(recording, floor_height=-0.4), truth, calibration=SelfCalibration((found,)))
        for found in (lower, on_it)
    ]
    energies = [r.solution.energy["floor"] for r in results if r.solution is not None]
    assert energies[0] == pytest.approx(energies[1], rel=1e-6)


def test_ankles_stand_as_high_as_the_calibration_found_them(
    recording: Recording, truth: MotionSequence
) -> None:
    """Three centimetres higher is what a floor three centimetres higher would be."""
    higher = Quantity("ankle height", "feet", np.array([0.03]), np.array([0.02]), np.array([0.02]), known=0.1)
    found = run(replace(recording, floor_height=-0.4), truth, calibration=SelfCalibration((higher,)))
    other = run(replace(recording, floor_height=-0.37), truth, calibration=SelfCalibration(()))
    plain = run(replace(recording, floor_height=-0.4), truth, calibration=SelfCalibration(()))
    energies = [result.solution.energy["floor"] for result in (found, other, plain)]
    assert energies[0] == pytest.approx(energies[1], rel=1e-3)
    assert energies[0] != pytest.approx(energies[2], rel=1e-3)


@pytest.mark.parametrize("change, reason", [
    (lambda k: replace(k, times=1000 * k.times), "frames a second; give them in seconds"),
    (lambda k: replace(k, uv_px=k.uv_px / 1920), "within 3 px; where they are shares of the image"),
])  # fmt: skip
def test_times_and_points_in_another_unit_are_refused(
    recording: Recording, truth: MotionSequence, change: Any, reason: str
) -> None:
    with pytest.raises(ShapeError, match=reason):
        run(replace(recording, keypoints=change(recording.video), imus=None), truth, "rto")


def test_a_world_of_the_sensors_that_is_turned_against_the_cameras_is_named() -> None:
    whole = Recording.load(model_path("demo"))
    assert whole.calibration is not None
    R = so3.about_axis("z", np.pi / 2) @ whole.calibration.R_world_inertial
    turned = replace(
        whole, keypoints=whole.video[:240], truth=None,
        calibration=replace(whole.calibration, R_world_inertial=R),
    )  # fmt: skip
    found = reconstruct(turned, calibrate=False, settings=ReconstructionSettings(confidence=False))
    (named,) = [check.cause for check in found.checks if check.failed]
    assert named.startswith("the sensors' world has to be turned by -90 degrees about the vertical")


def test_a_deep_squat_does_not_turn_the_pelvis() -> None:
    """Two seconds of the demo around 8.3 s, knees at the chest: limits of the hips' Euler angles turned a
    pelvis that carries no sensor by 31 degrees."""
    whole = Recording.load(model_path("demo"))
    squat = replace(whole, keypoints=whole.video[440:560])
    settings = ReconstructionSettings(fragment=JointSpaceSettings.calibrated(), confidence=False)
    result = reconstruct(squat, settings=settings, calibrate=False)
    assert whole.truth is not None
    R_true = at_times(whole.truth, result.motion.times).R_world_bone[:, 0]
    off = so3.angle_between(result.motion.poses.R_world_bone[:, 0], R_true)
    assert np.degrees(off.max()) < 15


def test_sensors_that_say_nothing_are_told(recording: Recording, truth: MotionSequence) -> None:
    assert recording.imus is not None
    silent = replace(
        recording.imus,
        R_inertial_sensor=np.full_like(recording.imus.R_inertial_sensor, np.nan),
        f_sensor=np.full_like(recording.imus.f_sensor, np.nan),
    )
    found = run(replace(recording, imus=silent), truth)
    assert any(warning.startswith("no sensor says anything") for warning in found.warnings)


def test_of_a_known_person_bones_are_taken_and_the_clock_is_still_looked_at(
    recording: Recording, truth: MotionSequence
) -> None:
    def told(kind: str, item: str, value: float) -> Quantity:
        return Quantity(kind, item, np.array([value]), np.array([0.01]), np.array([0.05]), known=1.0)

    earlier = SelfCalibration((told("bones", "thighs", 0.02), told("delay", "video", 0.2)))
    only_delay = replace(CalibrationPriors(), sigma_swing=None, sigma_image_bias=None)
    found = run(recording, truth, priors=only_delay, known=earlier)
    assert found.calibration is not None
    assert found.calibration["bones", "thighs"].value[0] == 0.02
    assert abs(found.calibration["delay", "video"].value[0]) < 0.05
    given, made = (r.skeleton.bone_lengths["LeftLeg"] for r in (recording, found.recording))
    assert made == pytest.approx(1.02 * given)
    vision = run(recording, truth, "rto", known=earlier)
    assert vision.motion.skeleton.bone_lengths["LeftLeg"] == pytest.approx(1.02 * given)
    np.testing.assert_array_equal(vision.motion.poses.times, recording.video.times)


def test_the_recordings_own_skeleton_is_used_where_none_is_given(truth: MotionSequence) -> None:
    tall = BODY.with_height(1.9)
    recording = replace(planted.recording(truth), joint_offsets=tall.joint_offsets)
    result = run(recording, truth, "sf2")
    np.testing.assert_allclose(result.motion.skeleton.joint_offsets, tall.joint_offsets, atol=1e-12)


def test_settings_reach_the_stages(recording: Recording, truth: MotionSequence) -> None:
    never = InertialGuidedIKSettings(threshold=np.pi)
    careful = ReconstructionSettings(
        inertial_ik=never, fragment=CartesianSettings(max_iterations=1), frames=8
    )
    result = run(recording, truth, settings=careful)
    assert result.solution is not None
    assert len(result.solution.fragments) == T // 4 + 1
    assert result.solution.status is SolverStatus.ITERATION_LIMIT
    sf2, lift = result.stages["sf2"], result.stages["lift"]
    arm, hand = BODY.index("LeftForeArm", "LeftHand")
    for poses in (sf2, lift):
        assert poses.p_world_joint.shape == (T, 21, 3)
    bones = [poses.p_world_joint[:, hand] - poses.p_world_joint[:, arm] for poses in (sf2, lift)]
    unit = [bone / np.linalg.norm(bone, axis=-1, keepdims=True) for bone in bones]
    np.testing.assert_allclose(unit[0], unit[1], atol=1e-9)


def test_the_optimiser_starts_from_sf2_with_sensors_and_from_rigid_poses_without(
    recording: Recording, truth: MotionSequence
) -> None:
    idle = CartesianSettings(max_iterations=0, refit_root=False)
    settings_ = ReconstructionSettings(fragment=idle, frames=16)
    start = {
        "rtof": run(recording, truth, "sf2").stages["sf2"],
        "rto": InertialGuidedIK(BODY).refine(run(recording, truth, "lift").stages["lift"]),
    }
    for mode, poses in start.items():
        result = run(recording, truth, mode, settings=settings_)
        assert result.solution is not None
        np.testing.assert_allclose(result.solution.poses.p_world_joint, poses.p_world_joint, atol=1e-9)
    assert np.abs(start["rto"].p_world_joint - start["rtof"].p_world_joint).max() > 0.05


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_progress_tells_of_every_stage(recording: Recording, truth: MotionSequence, mode: str) -> None:
    told: list[tuple[str, int, int]] = []
    run(recording, truth, mode, progress=lambda *at: told.append(at))
    assert told[:2] == [("lift", 0, 1), ("lift", 1, 1)]
    if mode in ("rto", "rtof"):
        assert told[-1] == (mode, 6, 6)
    assert all(done <= total for _, done, total in told)


def test_the_other_skeleton_is_reconstructed_without_sensors() -> None:
    small = SkeletonModel.human36m()
    truth = planted.moving(small, 20)
    recording = Recording(
        "h36m", planted.keypoints(truth.poses, 3.0), skeleton_table="human36m", truth=truth.poses
    )
    result = run(recording, truth, "rto")
    score = result.stage_metrics
    assert score["rto"]["mpjpe_rr_mm"] < score["lift"]["mpjpe_rr_mm"]


# --- lifters that know orientations and sensors --------------------------------------------------

TURN = so3.exp([0.1, -0.05, 0.15])
"""By how much the lifter's orientations are wrong, in the segments' own axes."""


def oriented(truth: MotionSequence, **how: Any) -> planted.PlantedLifter:
    return planted.PlantedLifter(truth, turned=TURN, **how)


@pytest.mark.parametrize("mode, with_sensors, told", [
    ("lift", True, False), ("rto", True, False), ("sf2", True, True), ("rtof", True, True),
    ("sf2", False, False), ("rtof", False, False),
])  # fmt: skip
def test_the_lifter_is_told_the_sensors_where_the_mode_uses_them(
    recording: Recording, truth: MotionSequence, mode: str, with_sensors: bool, told: bool
) -> None:
    lifter = planted.PlantedLifter(truth)
    quick = ReconstructionSettings(
        lift_with_sensors=with_sensors, frames=16, fragment=CartesianSettings(max_iterations=1)
    )
    result = run(recording, truth, mode, lifter=lifter, settings=quick)
    sensors = lifter.sensors[0]
    assert sensors is (result.bone_imus if told else None)
    assert (sensors is not None) == told


def test_the_lifters_orientations_and_uncertainties_are_those_of_its_stage(
    recording: Recording, truth: MotionSequence
) -> None:
    result = run(recording, truth, "sf2", lifter=oriented(truth, sigma_rad=0.2))
    lift = result.stages["lift"]
    np.testing.assert_allclose(lift.R_world_bone, truth.poses.R_world_bone @ TURN, atol=1e-9)
    assert np.all(lift.sigma_rad == 0.2)
    refined = InertialGuidedIK(BODY).refine(lift, result.bone_imus, lift.R_world_bone)
    np.testing.assert_allclose(result.stages["sf2"].R_world_bone, refined.R_world_bone, atol=1e-9)
    (head,) = BODY.index("Head")  # no sensor and no bone
    np.testing.assert_allclose(refined.R_world_bone[:, head], lift.R_world_bone[:, head], atol=1e-9)


def test_frames_that_were_bridged_are_oriented_by_their_positions(
    recording: Recording, truth: MotionSequence
) -> None:
    gap = slice(15, 24)
    blind = replace(recording, keypoints=planted.unseen(recording.keypoints, gap))
    lift = run(blind, truth, "lift", lifter=oriented(truth, blind=gap)).stages["lift"]
    by_position = kinematics.rotations_from_positions(BODY.parents, BODY.joint_offsets, lift.p_world_joint)
    np.testing.assert_allclose(lift.R_world_bone[gap], by_position[gap], atol=1e-12)
    assert np.isnan(lift.sigma_rad[gap]).all()
    seen = np.r_[0:15, 24:T]
    np.testing.assert_allclose(lift.R_world_bone[seen], (truth.poses.R_world_bone @ TURN)[seen], atol=1e-9)
    assert np.isfinite(lift.sigma_rad[seen]).all()
    result = run(blind, truth, lifter=oriented(truth, blind=gap))
    assert np.isfinite(result.motion.poses.R_world_bone).all()
    assert result.solution is not None
    assert result.solution.status is SolverStatus.CONVERGED


@pytest.mark.parametrize("mode", ["sf2", "rto"])
def test_without_orientations_stages_start_from_positions_alone(
    recording: Recording, truth: MotionSequence, mode: str
) -> None:
    """As for lifters of old, and of other skeletons: a hand turns with its forearm's sensor."""
    idle = CartesianSettings(max_iterations=0, refit_root=False)
    result = run(recording, truth, mode, settings=ReconstructionSettings(fragment=idle, frames=16))
    assert np.isnan(result.stages["lift"].sigma_rad).all()
    refined = InertialGuidedIK(BODY).refine(result.stages["lift"], result.bone_imus)
    np.testing.assert_allclose(result.stages[mode].p_world_joint, refined.p_world_joint, atol=1e-9)
    if mode == "sf2":
        np.testing.assert_allclose(result.stages[mode].R_world_bone, refined.R_world_bone, atol=1e-9)


def test_a_torso_that_the_lifter_knows_well_is_held_to(recording: Recording, truth: MotionSequence) -> None:
    """The surer it is, the nearer to its (wrong) orientations the pelvis stays."""
    away = []
    for sigma in (0.02, 0.5):
        lifter = oriented(truth, sigma_rad=sigma)
        poses = run(recording, truth, "rto", lifter=lifter).motion.poses
        given = truth.poses.R_world_bone[:, 0] @ TURN
        away.append(so3.angle_between(poses.R_world_bone[:, 0], given).mean())
    assert away[0] < 0.7 * away[1]


# --- gaps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_frames_that_nobody_saw_are_bridged_and_not_valid(
    recording: Recording, truth: MotionSequence, mode: str
) -> None:
    gap = slice(15, 24)
    blind = replace(recording, keypoints=planted.unseen(recording.keypoints, gap))
    result = run(blind, truth, mode, lifter=planted.PlantedLifter(truth, gap))
    poses = result.motion.poses
    assert np.isfinite(poses.p_world_joint).all()
    assert not poses.valid[gap].any()
    assert poses.valid[:15].all()
    assert poses.valid[24:].all()
    assert np.all(poses.provenance[gap, TRUNK] == Provenance.BRIDGED)
    limbs = BODY.index("LeftHand", "RightFoot")
    by = Provenance.IMU if mode in ("sf2", "rtof") else Provenance.BRIDGED
    assert np.all(poses.provenance[gap, limbs] == by)
    assert result.metrics is not None
    assert result.metrics["coverage"] == pytest.approx(1 - 9 / T)


def test_of_a_frame_that_was_bridged_no_camera_saw_how_the_pelvis_turns(
    recording: Recording, truth: MotionSequence
) -> None:
    """Even with the pelvis' own points there: they were too few for the lifter."""
    lifter = planted.PlantedLifter(truth, slice(15, 24))
    observed = run(recording, truth, "lift", lifter=lifter).motion.poses.orientation_observed
    assert not observed[15:24].any()
    assert observed[:15, 0].all()


def test_a_joint_that_was_not_seen_in_a_frame_that_was_is_known_from_the_prior(
    recording: Recording, truth: MotionSequence
) -> None:
    hidden = planted.unseen(recording.keypoints, slice(5, 10), BODY.index("Head", "LeftHand"))
    poses = run(replace(recording, keypoints=hidden), truth).motion.poses
    head, hand = BODY.index("Head", "LeftHand")
    assert np.all(poses.provenance[5:10, head] == Provenance.PRIOR)
    assert np.all(poses.provenance[5:10, hand] == Provenance.IMU)
    assert poses.valid.all()


# --- uneven times --------------------------------------------------------------------------------


def keypoints_at(times: Array) -> KeypointSequence:
    """One landmark on a straight line: 100 px/s to the right, 40 px/s down."""
    uv = 500 + np.asarray(times)[:, None, None] * np.array([100.0, 40.0])
    return KeypointSequence(planted.camera(), times, uv, np.full((len(times), 1), 0.8), ("Head",))


def test_times_that_are_even_are_left_alone() -> None:
    rng = np.random.default_rng(0)
    for times in (
        np.arange(5) / 30,
        np.arange(500) / 60 + rng.uniform(-4e-3, 4e-3, 500) / 60,
        np.array([0.0, 1.0]),
        np.array([3.0]),
    ):
        keypoints = keypoints_at(times)
        assert evenly_spaced(keypoints) is keypoints


@settings(max_examples=60, deadline=None)
@given(
    jitter=st.floats(0.02, 0.4), frames=st.integers(3, 400), rate=st.floats(5, 120),
    seed=st.integers(0, 1000),
)  # fmt: skip
def test_jittering_times_become_even_and_positions_are_those_of_the_new_times(
    jitter: float, frames: int, rate: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    times = (np.arange(frames) + rng.uniform(-jitter, jitter, frames)) / rate
    keypoints = keypoints_at(times)
    even = evenly_spaced(keypoints)
    if even is not keypoints:
        np.testing.assert_allclose(np.diff(even.times), np.diff(even.times).mean(), rtol=1e-9)
    assert even.times[[0, -1]].tolist() == times[[0, -1]].tolist()
    assert evenly_spaced(even) is even
    seen = even.seen[:, 0]
    expected = 500 + even.times[seen, None] * np.array([100.0, 40.0])
    # Next to a sample, up to 1 % of a frame, the sample itself is taken.
    np.testing.assert_allclose(even.uv_px[seen, 0], expected, atol=1.1 * 1.0 / rate + 1e-6)
    np.testing.assert_allclose(even.confidence[seen], 0.8)


@pytest.mark.parametrize("milliseconds", [[33, 33, 34], [14, 19], [16, 17, 17]])
def test_times_rounded_to_milliseconds_have_the_mean_rate(milliseconds: list[int]) -> None:
    times = np.cumsum([0, *milliseconds * 40]) / 1000
    even = evenly_spaced(keypoints_at(times))
    assert len(even) == len(times)
    assert np.diff(even.times).mean() == pytest.approx(np.mean(milliseconds) / 1000)
    assert even.seen.all()


@pytest.mark.parametrize("start", [0.0, 12.3, 1.7e9])
@pytest.mark.parametrize("rate", [25.0, 29.97, 60.0, 100.0])
def test_dropped_frames_are_not_filled_in_and_no_other_is_lost(
    start: float, rate: float, caplog: pytest.LogCaptureFixture
) -> None:
    frames = np.delete(np.arange(40), [10, 11, 12, 25])
    with caplog.at_level(logging.WARNING):
        even = evenly_spaced(keypoints_at(start + frames / rate))
    np.testing.assert_allclose(even.times, start + np.arange(40) / rate, atol=1e-6)
    assert np.flatnonzero(~even.seen[:, 0]).tolist() == [10, 11, 12, 25]
    assert np.isnan(even.uv_px[[10, 11, 12, 25]]).all()
    assert f"36 samples brought to 40 even frames of {1000 / rate:.1f} ms" in caplog.text


def test_a_landmark_that_is_missing_stays_missing_between_its_neighbours() -> None:
    times = np.arange(30) / 60 + np.where(np.arange(30) % 2, 0.002, 0.0)
    keypoints = keypoints_at(times)
    uv = np.array(keypoints.uv_px)
    uv[14] = np.nan
    even = evenly_spaced(replace(keypoints, uv_px=uv))
    missing = np.flatnonzero(~even.seen[:-1, 0])
    assert 1 <= len(missing) <= 2
    assert set(missing) <= {13, 14, 15}


def test_a_video_with_jitter_and_dropped_frames_is_reconstructed(truth: MotionSequence) -> None:
    long = planted.human(BODY, 120)
    rng = np.random.default_rng(1)
    frames = np.delete(np.arange(10, 100, 2), [20, 21])
    poses = long.poses
    times = poses.times + rng.uniform(-1.5e-3, 1.5e-3, 120)
    all_frames = planted.keypoints(poses)
    picked = replace(
        all_frames, times=times[frames], uv_px=all_frames.uv_px[frames],
        confidence=all_frames.confidence[frames],
    )  # fmt: skip
    result = run(replace(planted.recording(long), keypoints=picked), long)
    assert len(result.keypoints) == 45
    missing = set(np.flatnonzero(~result.keypoints.seen.any(axis=1)).tolist())
    assert {20, 21} <= missing <= {19, 20, 21, 22}
    assert np.ptp(np.diff(result.motion.times)) < 1e-9
    assert result.metrics is not None
    assert result.metrics["mpjpe_rr_mm"] < 30
    assert result.solution is not None
    assert result.solution.status is SolverStatus.CONVERGED


# --- what is refused -----------------------------------------------------------------------------


def test_an_unknown_mode_is_refused_before_anything_runs(recording: Recording, truth: MotionSequence) -> None:
    lifter = planted.PlantedLifter(truth)
    with pytest.raises(UnknownNameError, match=r"unknown mode 'rtoff'\. Did you mean 'rtof'\?"):
        reconstruct(recording, mode="rtoff", lifter=lifter)
    assert not lifter.asked


@pytest.mark.parametrize("mode", ["sf2", "rtof"])
def test_a_mode_that_needs_sensors_asks_for_them(
    recording: Recording, truth: MotionSequence, mode: str
) -> None:
    lifter = planted.PlantedLifter(truth)
    blind = replace(recording, imus=None, calibration=None)
    with pytest.raises(ShapeError, match=f"mode {mode} needs IMUs .*use 'lift' or 'rto'"):
        run(blind, truth, mode, lifter=lifter)
    assert not lifter.asked
    assert run(blind, truth, "rto").metrics is not None


def test_calibrating_without_sensors_is_refused_in_its_own_words(recording: Recording) -> None:
    blind = replace(recording, imus=None, calibration=None)
    with pytest.raises(CalibrationError, match="has no IMUs, without which there is nothing to calib"):
        calibrate_recording(blind)


def test_sensors_without_calibration_are_refused_where_they_are_needed(
    recording: Recording, truth: MotionSequence
) -> None:
    with pytest.raises(CalibrationError, match="have no calibration"):
        run(replace(recording, calibration=None), truth)
    assert run(replace(recording, calibration=None), truth, "lift").metrics is not None


@pytest.mark.parametrize("mode", ["lift", "rtof"])
def test_a_person_behind_the_camera_is_refused_with_the_frame(
    recording: Recording, truth: MotionSequence, mode: str
) -> None:
    lifter = planted.PlantedLifter(truth)
    lifter.p[17] += [9.0, 0.0, 0.0]
    with pytest.raises(InvalidInputError, match="pose of frame 17 is behind the camera; check"):
        run(recording, truth, mode, lifter=lifter)


def test_importing_the_pipeline_loads_neither_torch_nor_a_plotting_library() -> None:
    code = (
        "import sys, rtof_kin, rtof_kin.reconstruction.pipeline, rtof_kin.report.export\n"
        "heavy = {'torch', 'matplotlib', 'yourdfpy', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- calibrated from the recording itself --------------------------------------------------------


def test_a_recording_is_calibrated_first_unless_told_not_to(truth: MotionSequence) -> None:
    long = planted.human(BODY, 60)
    given = planted.recording(long, sigma_px=1.0)
    late = replace(given, keypoints=replace(given.keypoints, times=given.keypoints.times + 0.05))
    result = reconstruct(late, lifter=planted.PlantedLifter(long), settings=SETTINGS)
    assert result.calibration is not None
    delay = result.calibration["delay", "video"].value[0]
    assert delay == pytest.approx(0.05, abs=0.01)
    np.testing.assert_allclose(result.keypoints.times, late.keypoints.times - delay)
    np.testing.assert_allclose(result.motion.poses.times, result.keypoints.times)
    again = run(late, long, calibration=result.calibration)
    np.testing.assert_array_equal(again.motion.q, result.motion.q)
    assert run(late, long).calibration is None


def test_without_sensors_nothing_is_calibrated(
    truth: MotionSequence, recording: Recording, results: dict[str, Reconstruction]
) -> None:
    assert results["rtof"].recording is recording
    assert run(recording, truth, "rto", calibrate=True).calibration is None


def test_what_cannot_be_calibrated_is_taken_as_it_is_given_and_that_is_said(
    truth: MotionSequence, recording: Recording
) -> None:
    short = replace(recording, keypoints=recording.keypoints[:8])
    result = run(short, truth, calibrate=True)
    assert result.calibration is None
    assert "taken as it is given: video and IMUs have" in result.warnings[0]
    with pytest.raises(CalibrationError, match="in common, too little to look for a delay of 4.00 s"):
        run(recording, truth, priors=CalibrationPriors(sigma_delay=1.0))
