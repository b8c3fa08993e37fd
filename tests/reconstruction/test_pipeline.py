"""`reconstruct` and `calibrate_recording` with a lifter whose errors are planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from reconstruction_support import BODY, FRAMES, QUICK_PRIORS, SETTINGS, TRUNK, TURN, Case

from rtof_kin.body import kinematics
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.fragment_solver import SolverStatus
from rtof_kin.solve.initial_guess import InertialGuidedIK
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.uncertainty import CovarianceInflation, disagreement

Results = dict[str, Reconstruction]


@pytest.fixture(scope="module")
def results(case: Case) -> Results:
    return {mode: case.run(mode) for mode in CAMERA_MODES}


def floor_energy(result: Reconstruction) -> float:
    return result.solution.energy["floor"]


@pytest.mark.parametrize(
    "mode, stages",
    [("lift", ["lift"]), ("sf2", ["lift", "sf2"]), ("rto", ["lift", "rto"]), ("rtof", ["lift", "sf2", "rtof"])],
)
def test_mode_runs_its_stages_and_scores_them(case: Case, results: Results, mode: str, stages: list[str]) -> None:
    result = results[mode]
    assert result.mode == mode
    assert list(result.stages) == list(result.stage_metrics) == stages
    assert result.metrics is result.stage_metrics[mode]
    assert (result.solution is not None) == (mode in ("rto", "rtof"))
    assert (result.bone_imus is not None) == (mode in ("sf2", "rtof"))
    assert (result.stages[mode] is result.motion.poses) == (mode != "lift")
    assert result.recording is case.recording
    assert case.changed(truth=None).run(mode).stage_metrics == {}


def test_each_stage_is_better_than_the_one_before(results: Results) -> None:
    score = {mode: result.stage_metrics[mode] for mode, result in results.items()}
    for better, worse, figure, factor in (
        ("rtof", "sf2", "mpjpe_rr_mm", 0.7),
        ("sf2", "lift", "mpjpe_rr_mm", 0.9),
        ("rto", "lift", "mpjpe_rr_mm", 0.9),
        ("rtof", "lift", "mpjpe_mm", 0.6),
        ("rtof", "lift", "flexion_deg", 0.6),
    ):
        assert score[better][figure] < factor * score[worse][figure]
    assert results["rtof"].solution is not None
    assert results["rtof"].solution.status is SolverStatus.CONVERGED


@pytest.mark.parametrize("mode", ["rto", "rtof", "imu"])
def test_unobserved_joints_follow_the_prior_of_the_lifter(case: Case, mode: str) -> None:
    """Nothing observes how far a clavicle is turned about itself, under the arm."""
    clavicle, arm = BODY.index("LeftShoulder", "LeftArm")
    turn, mean = np.radians(20.0) * so3.unit(BODY.joint_offsets[arm]), BODY.table.prior.mean_quat_wxyz
    mean = so3.from_quat_wxyz(mean)
    mean[clavicle - 1], mean[arm - 1] = mean[clavicle - 1] @ so3.exp(turn), so3.exp(-turn) @ mean[arm - 1]
    lifter, own = case.lifter(), case.lifter()
    own.prior = replace(BODY.table.prior, mean_quat_wxyz=so3.to_quat_wxyz(mean))
    bent = {}
    for name, options in {
        "shipped": {"lifter": lifter},
        "own": {"lifter": own},
        "given": {"lifter": own, "skeleton": BODY},
    }.items():
        result = case.run(mode, **options)
        bent[name] = kinematics.local_rotations(BODY.parents, result.motion.poses.R_world_bone)[:, clavicle]
        assert (result.motion.skeleton.table.model_prior is not None) == (name != "shipped")
    moved = np.median(so3.log(np.swapaxes(bent["shipped"], -1, -2) @ bent["own"]), axis=0)
    np.testing.assert_allclose(moved, turn, atol=np.radians(3.0))
    np.testing.assert_allclose(bent["given"], bent["own"], atol=1e-9)


def test_calibration_keeps_the_prior_of_the_lifter(case: Case) -> None:
    lifter = case.lifter()
    lifter.prior = replace(BODY.table.prior, sigma_root_jerk=50.0)
    result = case.run(calibrate=True, priors=QUICK_PRIORS, lifter=lifter)
    assert result.calibration is not None
    assert result.motion.skeleton.table.prior is lifter.prior


@pytest.mark.parametrize("mode, start, seen", [("rto", "lift", "camera"), ("rtof", "sf2", "fused")])
def test_covariance_grows_with_the_distance_from_the_start(results: Results, mode: str, start: str, seen: str) -> None:
    motion = results[mode].motion
    apart = disagreement(motion.poses, results[mode].stages[start], motion.confidence).relative_covariance[:, 1:]
    added = CovarianceInflation.shipped().shares[seen]["relative"] ** 2 * np.trace(apart, axis1=2, axis2=3)
    stated = np.trace(motion.confidence.relative_covariance[:, 1:], axis1=2, axis2=3)
    assert (stated > added).all()


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_motion_is_that_of_the_rigid_skeleton_at_the_keypoints_times(case: Case, results: Results, mode: str) -> None:
    motion = results[mode].motion
    assert motion.q.shape == (FRAMES, BODY.nq)
    p, R = BODY.forward_kinematics(motion.q)
    np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)
    np.testing.assert_allclose(R, motion.poses.R_world_bone, atol=1e-9)
    np.testing.assert_array_equal(motion.times, case.recording.video.times)
    assert np.abs(np.diff(motion.q, axis=0)).max() < 1.0
    assert motion.poses.valid.all()


def test_provenance_names_camera_and_sensors(results: Results) -> None:
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


@pytest.mark.parametrize("mode", CAMERA_MODES)
def test_progress_reports_every_stage_and_equal_calls_give_equal_motions(
    case: Case, results: Results, mode: str
) -> None:
    steps: list[tuple[str, int, int]] = []
    again = case.run(mode, progress=lambda *step: steps.append(step))
    np.testing.assert_array_equal(again.motion.q, results[mode].motion.q)
    assert steps[0] == ("lift", 0, 1)
    assert ("lift", 1, 1) in steps
    if mode in ("rto", "rtof"):
        assert steps[-1] == (mode, 6, 6)
    assert all(done <= total for _, done, total in steps)


def test_human36m_skeleton_is_reconstructed_without_sensors() -> None:
    truth = planted.moving(SkeletonModel.human36m(), 20)
    keypoints = planted.keypoints(truth.poses, 3.0)
    recording = Recording("h36m", keypoints, skeleton_table="human36m", truth=truth.poses)
    score = Case(truth, recording).run("rto").stage_metrics
    assert score["rto"]["mpjpe_rr_mm"] < score["lift"]["mpjpe_rr_mm"]


def test_smaller_sigma_of_the_lifter_keeps_the_pelvis_nearer_to_its_orientation(case: Case) -> None:
    R_lifted, away = case.truth.poses.R_world_bone[:, 0] @ TURN, []
    for sigma in (0.02, 0.5):
        poses = case.run("rto", lifter=case.lifter(turned=TURN, sigma_rad=sigma)).motion.poses
        away.append(so3.angle_between(poses.R_world_bone[:, 0], R_lifted).mean())
    assert away[0] < 0.7 * away[1]


def test_pelvis_without_sensor_follows_a_deep_squat() -> None:
    """Two seconds of the demo around 8.3 s, knees at the chest; limits of the hips' Euler angles once
    turned the pelvis by 31 degrees.
    """
    demo = Recording.load(model_path("demo"))
    settings = ReconstructionSettings(confidence=False)
    squat = replace(demo, keypoints=demo.video[440:560])
    poses = reconstruct(squat, settings=settings, calibrate=False).motion.poses
    assert demo.truth is not None
    R_true = at_times(demo.truth, poses.times).R_world_bone[:, 0]
    assert np.degrees(so3.angle_between(poses.R_world_bone[:, 0], R_true).max()) < 15


def test_unknown_mode_is_refused_before_lifting(case: Case) -> None:
    lifter = case.lifter()
    with pytest.raises(UnknownNameError, match=r"'rtoff'.*'rtof'"):
        case.run("rtoff", lifter=lifter)
    assert not lifter.asked


def test_skeleton_is_the_one_given_else_that_of_the_recording(case: Case) -> None:
    tall = case.changed(joint_offsets=BODY.with_height(1.9).joint_offsets)
    offsets = tall.run("lift").motion.skeleton.joint_offsets
    np.testing.assert_allclose(offsets, tall.recording.joint_offsets, atol=1e-12)
    assert tall.run("lift", skeleton=BODY).motion.skeleton is BODY


def test_settings_reach_the_fragment_solver_after_sf2(case: Case) -> None:
    result = case.run(settings=ReconstructionSettings(fragment=CartesianSettings(max_iterations=1), frames=8))
    expected = InertialGuidedIK(BODY).refine(result.stages["lift"], result.bone_imus)
    np.testing.assert_allclose(result.stages["sf2"].p_world_joint, expected.p_world_joint, atol=1e-9)
    assert len(result.solution.fragments) == FRAMES // 4 + 1
    assert result.solution.status is SolverStatus.ITERATION_LIMIT


@pytest.mark.parametrize("floor", [None, -0.4])
def test_floor_of_the_recording_reaches_lifter_and_solver(case: Case, floor: float | None) -> None:
    lifter, own = case.lifter(), case.changed(floor_height=floor)
    assert (floor_energy(own.run(lifter=lifter)) > 0) == (floor is not None)
    assert lifter.floors == [floor, floor]  # the first is that of the clocks
    given = replace(SETTINGS, fragment=JointSpaceSettings(floor_height=5.0))
    assert floor_energy(own.run(settings=given)) > 10  # settings override the recording


def test_calibrated_ankles_stand_above_the_floor(case: Case) -> None:
    """Ankles 3 cm higher equal a floor 3 cm higher; ankles below the floor stand 2 cm above it."""

    def energy(floor: float, higher: float) -> float:
        value, sigma = np.array([higher]), np.array([0.02])
        ankles = Quantity("ankle height", "feet", value, sigma, sigma, known=0.9)
        return floor_energy(case.changed(floor_height=floor).run(calibration=SelfCalibration((ankles,))))

    assert energy(-0.4, 0.03) == pytest.approx(energy(-0.37, 0.0), rel=1e-3)
    assert energy(-0.4, 0.03) != pytest.approx(energy(-0.4, 0.0), rel=1e-3)
    assert energy(-0.4, -0.06) == pytest.approx(energy(-0.4, -0.3), rel=1e-6)


def test_sensors_without_samples_are_warned_of(case: Case) -> None:
    imus = case.recording.imus
    R, f = (np.full_like(x, np.nan) for x in (imus.R_inertial_sensor, imus.f_sensor))
    silent = case.changed(imus=replace(imus, R_inertial_sensor=R, f_sensor=f))
    assert any("no sensor" in warning for warning in silent.run().warnings)


def test_recording_is_calibrated_first_where_asked() -> None:
    truth = planted.human(BODY, 60)
    given = planted.recording(truth, sigma_px=1.0)
    late = Case(truth, replace(given, keypoints=replace(given.video, times=given.video.times + 0.03)))
    result = late.run(calibrate=True)
    delay = result.calibration["delay", "video"].value[0]
    assert delay == pytest.approx(0.03, abs=0.01)
    np.testing.assert_allclose(result.motion.times, late.recording.video.times - delay)
    again = late.run(calibration=result.calibration)
    np.testing.assert_array_equal(again.motion.q, result.motion.q)
    assert reconstruct(late.recording, lifter=late.lifter(), settings=SETTINGS).calibration is None
    assert late.run("rto", calibrate=True).calibration is None


def test_known_person_keeps_bones_and_estimates_the_delay_anew(case: Case) -> None:
    def estimated(kind: str, item: str, value: float) -> Quantity:
        return Quantity(kind, item, np.array([value]), np.array([0.01]), np.array([0.05]), known=1.0)

    earlier = SelfCalibration((estimated("bones", "thighs", 0.02), estimated("delay", "video", 0.2)))
    found = case.run(calibrate=True, priors=QUICK_PRIORS, known=earlier)
    assert found.calibration["bones", "thighs"].value[0] == 0.02
    assert abs(found.calibration["delay", "video"].value[0]) < 0.05
    vision = case.run("rto", known=earlier)
    np.testing.assert_array_equal(vision.motion.times, case.recording.video.times)
    length = 1.02 * case.recording.skeleton.bone_lengths["LeftLeg"]
    for skeleton in (found.recording.skeleton, vision.motion.skeleton):
        assert skeleton.bone_lengths["LeftLeg"] == pytest.approx(length)


def test_recording_that_cannot_be_calibrated_is_used_as_given_with_a_warning(case: Case) -> None:
    result = case.changed(keypoints=case.recording.video[:8]).run(calibrate=True)
    assert result.calibration is None
    assert "0.12 s in common" in result.warnings[0]
    with pytest.raises(CalibrationError, match=r"delay of 4\.00 s"):
        case.run(calibrate=True, priors=CalibrationPriors(sigma_delay=1.0))


def test_priors_of_a_calibration_that_is_not_made_are_refused(case: Case) -> None:
    with pytest.raises(InvalidInputError, match="calibrate=True"):
        case.run(calibrate=False, priors=QUICK_PRIORS)
    with pytest.raises(CalibrationError, match="no IMUs.*'rto'"):
        calibrate_recording(replace(case.recording, imus=None, calibration=None))


def test_a_mounting_from_the_video_leaves_the_zero_of_flexion_open(case: Case) -> None:
    ones = np.ones(3)
    free = SelfCalibration(
        tuple(
            Quantity("mounting", name, 0.01 * ones, 0.08 * ones, 0.4 * ones, 0.95) for name in ("LeftUpLeg", "LeftLeg")
        )
    )
    wide = case.run("rtof", calibration=free)
    known = replace(free, quantities=tuple(replace(q, sigma=0.03 * ones) for q in free.quantities))
    usual = case.run("rtof", calibration=known)
    (said,) = [text for text in wide.warnings if text.startswith("the zero of knee flexion")]
    assert "+-1" in said  # 10 to 19 deg
    assert not any("zero of knee" in text for text in usual.warnings)
    assert wide.motion.confidence is not None
    assert usual.motion.confidence is not None
    knees = [c.turn("LeftUpLeg", "LeftLeg")[:, 1, 1] for c in (wide.motion.confidence, usual.motion.confidence)]
    assert np.degrees(np.sqrt(knees[0].mean() - knees[1].mean())) > 5


def test_a_mounting_that_the_recording_states_as_uncertain_widens_the_angles_once(case: Case) -> None:
    given, legs = case.recording.calibration, ("LeftUpLeg", "LeftLeg")
    sd = np.array([9.0 if joint in legs else np.nan for joint in given.joints])
    stated = case.changed(calibration=replace(given, mounting_sd_deg=sd))
    found = SelfCalibration(
        tuple(Quantity("mounting", name, np.full(3, 1e-6), np.full(3, 0.08), np.full(3, 0.4), 0.95) for name in legs)
    )

    def knee_variance(result: Reconstruction) -> float:
        return float(result.motion.confidence.turn(*legs)[:, 1, 1].mean())

    usual, wide = case.run("rtof"), stated.run("rtof")
    np.testing.assert_array_equal(usual.motion.q, wide.motion.q)
    for result in (wide, stated.run("rtof", calibration=found)):  # its 5 degrees are part of the 9
        more = np.degrees(np.sqrt(knee_variance(result) - knee_variance(usual)))
        assert more == pytest.approx(9 * np.sqrt(2), abs=0.3)
        (said,) = [text for text in result.warnings if text.startswith("the zero of ")]
        assert "knee flexion is not known to better than +-25 deg" in said


def test_keypoints_of_the_legs_that_are_off_are_named_first_and_in_their_bands() -> None:
    truth = planted.human(BODY, FRAMES)
    right = Case(truth, planted.recording(truth))
    video, feet = right.recording.video, ("LeftLeg", "RightLeg", "LeftFoot", "RightFoot")
    uv = video.uv_px.copy()
    uv[:, [i for i, name in enumerate(video.names) if name.endswith(("Toe", "Heel"))], 0] += 200.0
    uv[:, [video.names.index(name) for name in feet], 0] += 200.0
    off = right.changed(keypoints=replace(video, uv_px=uv)).run("rto")
    assert not [check for check in right.run("rto").checks if check.failed]
    failed = [check for check in off.checks if check.failed]
    assert failed[0].cause.startswith("the keypoints of the legs are off by ")
    stated = off.motion.confidence
    p, q = off.motion.poses.p_world_joint, truth.poses.p_world_joint
    error = ((p - p[:, :1]) - (q - q[:, :1]))[:, BODY.index(*feet)]
    sigma = np.sqrt(np.diagonal(stated.relative_covariance, axis1=-2, axis2=-1))[:, BODY.index(*feet)]
    assert np.mean(np.abs(error) <= BAND_95 * sigma) > 0.9
