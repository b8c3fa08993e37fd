"""`reconstruct` and `calibrate_recording` with a lifter whose errors are planted."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import planted
import pytest
from reconstruction_support import BODY, FRAMES, QUICK_PRIORS, SETTINGS, TRUNK, run

from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import CalibrationError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import Provenance
from rtof_kin.reconstruction.pipeline import calibrate_recording, reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import SolverStatus
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.uncertainty.covariance_inflation import CovarianceInflation
from rtof_kin.solve.uncertainty.disagreement import disagreement


@pytest.fixture(scope="module")
def results(truth: MotionSequence, recording: Recording) -> dict[str, Reconstruction]:
    return {mode: run(recording, truth, mode) for mode in CAMERA_MODES}


def floor_energy(result: Reconstruction) -> float:
    assert result.solution is not None
    return result.solution.energy["floor"]


# --- the modes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode, stages", [
    ("lift", ["lift"]), ("sf2", ["lift", "sf2"]), ("rto", ["lift", "rto"]),
    ("rtof", ["lift", "sf2", "rtof"]),
])  # fmt: skip
def test_mode_runs_its_stages_and_scores_them(
    results: dict[str, Reconstruction], recording: Recording, mode: str, stages: list[str]
) -> None:
    result = results[mode]
    assert result.mode == mode
    assert list(result.stages) == list(result.stage_metrics) == stages
    assert result.metrics is result.stage_metrics[mode]
    assert (result.solution is not None) == (mode in ("rto", "rtof"))
    assert (result.bone_imus is not None) == (mode in ("sf2", "rtof"))
    assert (result.stages[mode] is result.motion.poses) == (mode != "lift")
    assert result.recording is recording


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
def test_covariance_grows_with_the_distance_from_the_start(
    results: dict[str, Reconstruction], mode: str, start: str, seen: str
) -> None:
    motion = results[mode].motion
    assert motion.confidence is not None
    apart = disagreement(motion.poses, results[mode].stages[start], motion.confidence.pairs).relative[:, 1:]
    added = CovarianceInflation.shipped().shares[seen]["relative"] ** 2 * np.trace(apart, axis1=2, axis2=3)
    stated = np.trace(motion.confidence.relative_covariance[:, 1:], axis1=2, axis2=3)
    assert (stated > added).all()


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_motion_is_that_of_the_rigid_skeleton_at_the_keypoints_times(
    results: dict[str, Reconstruction], recording: Recording, mode: str
) -> None:
    motion = results[mode].motion
    assert motion.q.shape == (FRAMES, BODY.nq)
    p, R = BODY.forward_kinematics(motion.q)
    np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(R, motion.poses.R_world_bone, atol=1e-9)
    np.testing.assert_array_equal(motion.times, recording.video.times)
    assert np.abs(np.diff(motion.q, axis=0)).max() < 1.0
    assert motion.poses.valid.all()


def test_provenance_names_camera_and_sensors(results: dict[str, Reconstruction]) -> None:
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


def test_equal_calls_give_equal_motions(
    results: dict[str, Reconstruction], recording: Recording, truth: MotionSequence
) -> None:
    np.testing.assert_array_equal(run(recording, truth).motion.q, results["rtof"].motion.q)


def test_no_truth_no_scores(recording: Recording, truth: MotionSequence) -> None:
    result = run(replace(recording, truth=None), truth, "sf2")
    assert result.metrics is None
    assert result.stage_metrics == {}


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_progress_reports_every_stage(recording: Recording, truth: MotionSequence, mode: str) -> None:
    steps: list[tuple[str, int, int]] = []
    run(recording, truth, mode, progress=lambda *step: steps.append(step))
    assert steps[:2] == [("lift", 0, 1), ("lift", 1, 1)]
    if mode in ("rto", "rtof"):
        assert steps[-1] == (mode, 6, 6)
    assert all(done <= total for _, done, total in steps)


def test_human36m_skeleton_is_reconstructed_without_sensors() -> None:
    truth = planted.moving(SkeletonModel.human36m(), 20)
    recording = Recording(
        "h36m", planted.keypoints(truth.poses, 3.0), skeleton_table="human36m", truth=truth.poses
    )
    score = run(recording, truth, "rto").stage_metrics
    assert score["rto"]["mpjpe_rr_mm"] < score["lift"]["mpjpe_rr_mm"]


def test_smaller_sigma_of_the_lifter_keeps_the_pelvis_nearer_to_its_orientation(
    recording: Recording, truth: MotionSequence
) -> None:
    turn, away = so3.exp([0.1, -0.05, 0.15]), []
    for sigma in (0.02, 0.5):
        lifter = planted.PlantedLifter(truth, turned=turn, sigma_rad=sigma)
        poses = run(recording, truth, "rto", lifter=lifter).motion.poses
        away.append(so3.angle_between(poses.R_world_bone[:, 0], truth.poses.R_world_bone[:, 0] @ turn).mean())
    assert away[0] < 0.7 * away[1]


def test_pelvis_without_sensor_follows_a_deep_squat() -> None:
    """Two seconds of the demo around 8.3 s, knees at the chest; limits of the hips' Euler angles once
    turned the pelvis by 31 degrees.
    """
    demo = Recording.load(model_path("demo"))
    settings = ReconstructionSettings(fragment=JointSpaceSettings.calibrated(), confidence=False)
    squat = replace(demo, keypoints=demo.video[440:560])
    poses = reconstruct(squat, settings=settings, calibrate=False).motion.poses
    assert demo.truth is not None
    R_true = at_times(demo.truth, poses.times).R_world_bone[:, 0]
    assert np.degrees(so3.angle_between(poses.R_world_bone[:, 0], R_true).max()) < 15


# --- what is given reaches the stages ------------------------------------------------------------


def test_skeleton_is_the_one_given_else_that_of_the_recording(truth: MotionSequence) -> None:
    tall = BODY.with_height(1.9)
    own = replace(planted.recording(truth), joint_offsets=tall.joint_offsets)
    found = run(own, truth, "lift").motion.skeleton
    np.testing.assert_allclose(found.joint_offsets, tall.joint_offsets, atol=1e-12)
    assert run(own, truth, "lift", skeleton=BODY).motion.skeleton is BODY


def test_settings_reach_the_fragment_solver(recording: Recording, truth: MotionSequence) -> None:
    settings = ReconstructionSettings(fragment=CartesianSettings(max_iterations=1), frames=8)
    solution = run(recording, truth, settings=settings).solution
    assert solution is not None
    assert len(solution.fragments) == FRAMES // 4 + 1
    assert solution.status is SolverStatus.ITERATION_LIMIT


@pytest.mark.parametrize("floor", [None, -0.4])
def test_floor_of_the_recording_reaches_lifter_and_solver(
    recording: Recording, truth: MotionSequence, floor: float | None
) -> None:
    lifter, own = planted.PlantedLifter(truth), replace(recording, floor_height=floor)
    assert (floor_energy(run(own, truth, lifter=lifter)) > 0) == (floor is not None)
    assert lifter.floors == [floor]
    given = replace(SETTINGS, fragment=JointSpaceSettings(floor_height=5.0))
    assert floor_energy(run(own, truth, settings=given)) > 10  # settings override the recording


def with_ankles(value: float) -> SelfCalibration:
    ankles = Quantity(
        "ankle height", "feet", np.array([value]), np.array([0.02]), np.array([0.02]), known=0.9
    )
    return SelfCalibration((ankles,))


def test_calibrated_ankles_stand_above_the_floor(recording: Recording, truth: MotionSequence) -> None:
    """Ankles 3 cm higher equal a floor 3 cm higher; ankles below the floor stand 2 cm above it."""
    high, low, lowest, none = (
        floor_energy(run(replace(recording, floor_height=-0.4), truth, calibration=calibration))
        for calibration in (with_ankles(0.03), with_ankles(-0.06), with_ankles(-0.3), SelfCalibration(()))
    )
    higher_floor = replace(recording, floor_height=-0.37)
    other = floor_energy(run(higher_floor, truth, calibration=SelfCalibration(())))
    assert high == pytest.approx(other, rel=1e-3)
    assert high != pytest.approx(none, rel=1e-3)
    assert low == pytest.approx(lowest, rel=1e-6)


def test_sensors_without_samples_are_warned_of(recording: Recording, truth: MotionSequence) -> None:
    assert recording.imus is not None
    R, f = (np.full_like(x, np.nan) for x in (recording.imus.R_inertial_sensor, recording.imus.f_sensor))
    silent = replace(recording.imus, R_inertial_sensor=R, f_sensor=f)
    assert any("no sensor" in warning for warning in run(replace(recording, imus=silent), truth).warnings)


# --- self-calibration ----------------------------------------------------------------------------


def test_recording_is_calibrated_first_by_default() -> None:
    long = planted.human(BODY, 60)
    given = planted.recording(long, sigma_px=1.0)
    late = replace(given, keypoints=replace(given.video, times=given.video.times + 0.05))
    result = reconstruct(late, lifter=planted.PlantedLifter(long), settings=SETTINGS)
    assert result.calibration is not None
    assert result.keypoints is not None
    delay = result.calibration["delay", "video"].value[0]
    assert delay == pytest.approx(0.05, abs=0.01)
    np.testing.assert_allclose(result.keypoints.times, late.video.times - delay)
    np.testing.assert_allclose(result.motion.times, result.keypoints.times)
    again = run(late, long, calibration=result.calibration)
    np.testing.assert_array_equal(again.motion.q, result.motion.q)
    assert run(late, long).calibration is None
    assert run(late, long, "rto", calibrate=True).calibration is None


def test_known_person_keeps_bones_and_estimates_the_delay_anew(
    recording: Recording, truth: MotionSequence
) -> None:
    def estimated(kind: str, item: str, value: float) -> Quantity:
        return Quantity(kind, item, np.array([value]), np.array([0.01]), np.array([0.05]), known=1.0)

    earlier = SelfCalibration((estimated("bones", "thighs", 0.02), estimated("delay", "video", 0.2)))
    found = run(recording, truth, calibrate=True, priors=QUICK_PRIORS, known=earlier)
    assert found.calibration is not None
    assert found.calibration["bones", "thighs"].value[0] == 0.02
    assert abs(found.calibration["delay", "video"].value[0]) < 0.05
    length = 1.02 * recording.skeleton.bone_lengths["LeftLeg"]
    assert found.recording.skeleton.bone_lengths["LeftLeg"] == pytest.approx(length)
    vision = run(recording, truth, "rto", known=earlier)
    assert vision.motion.skeleton.bone_lengths["LeftLeg"] == pytest.approx(length)
    np.testing.assert_array_equal(vision.motion.times, recording.video.times)


def test_recording_that_cannot_be_calibrated_is_used_as_given_with_a_warning(
    truth: MotionSequence, recording: Recording
) -> None:
    result = run(replace(recording, keypoints=recording.video[:8]), truth, calibrate=True)
    assert result.calibration is None
    assert "not calibrated" in result.warnings[0]
    assert "0.12 s in common" in result.warnings[0]
    with pytest.raises(CalibrationError, match=r"delay of 4\.00 s"):
        run(recording, truth, calibrate=True, priors=CalibrationPriors(sigma_delay=1.0))


def test_calibration_needs_sensors(recording: Recording) -> None:
    with pytest.raises(CalibrationError, match="no IMUs.*'rto'"):
        calibrate_recording(replace(recording, imus=None, calibration=None))


# --- refused input, imports ----------------------------------------------------------------------


def test_unknown_mode_is_refused_before_lifting(recording: Recording, truth: MotionSequence) -> None:
    lifter = planted.PlantedLifter(truth)
    with pytest.raises(UnknownNameError, match=r"'rtoff'.*'rtof'"):
        run(recording, truth, "rtoff", lifter=lifter)
    assert not lifter.asked


def test_pipeline_imports_neither_torch_nor_plotting() -> None:
    code = (
        "import sys, rtof_kin, rtof_kin.reconstruction.pipeline, rtof_kin.report.export\n"
        "heavy = {'torch', 'matplotlib', 'yourdfpy', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
