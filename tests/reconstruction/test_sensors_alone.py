"""Mode imu: planted motions come back from their sensors alone, and it is said what cannot."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy.signal import find_peaks

from rtof_kin.body.metrics import flexion
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import CalibrationError, ShapeError, SolverError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.sensors_alone import SensorsAloneSettings, frame_times
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.report.export import export
from rtof_kin.report.figures import TRUTH, skeletons
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import FragmentSolver, SolverStatus

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
WHOLE = ("Hips", "Spine3", *planted.LIMBS)
SETTINGS = ReconstructionSettings(frames=20)


def recorded(motion: MotionSequence, joints: tuple[str, ...] = WHOLE, degrees: float = 0.0) -> Recording:
    """What sensors without a camera record of a motion."""
    return replace(planted.recording(motion, joints=joints, degrees=degrees), keypoints=None)


def shift(result: Reconstruction, motion: MotionSequence) -> Array:
    """(T, 3) m, the root's path less the true one, both from the first frame on."""
    own, true = result.motion.poses.p_world_joint[:, 0], motion.poses.p_world_joint[:, 0]
    return np.asarray((own - own[0]) - (true - true[0]))


@pytest.fixture(scope="module")
def walk() -> MotionSequence:
    return planted.walking(BODY, 2.5)[0]


@pytest.fixture(scope="module")
def walked(walk: MotionSequence) -> Reconstruction:
    return reconstruct(recorded(walk), mode="imu", settings=SETTINGS)


# --- planted truth -------------------------------------------------------------------------------


def test_exact_sensors_give_exact_orientations(walk: MotionSequence, walked: Reconstruction) -> None:
    index = BODY.index(*WHOLE)
    R, R_true = walked.motion.poses.R_world_bone[:, index], walk.poses.R_world_bone[:, index]
    off = np.degrees(so3.angle_between(R, R_true))
    assert off.mean() < 2.0
    bent, true = (flexion(m.poses.p_world_joint, BODY) for m in (walked.motion, walk))
    knees = BODY.index("LeftLeg", "RightLeg")
    assert np.degrees(np.abs(bent - true)[:, knees]).mean() < 2.0
    assert walked.solution is not None
    assert walked.solution.status is SolverStatus.CONVERGED


def test_a_walk_of_known_length_drifts_by_less_than_three_percent(
    walk: MotionSequence, walked: Reconstruction
) -> None:
    length = float(np.ptp(walk.poses.p_world_joint[:, 0, 0]))
    assert length == pytest.approx(2.0, rel=0.02)
    assert np.linalg.norm(shift(walked, walk)[-1]) < 0.03 * length
    assert walked.root_sigma is not None
    assert 0 < walked.root_sigma[-1] < 0.2 * length
    assert walked.warnings == ()
    assert walked.checks
    assert not any(check.failed for check in walked.checks)


def test_feet_that_stand_stay_where_they_are(walk: MotionSequence, walked: Reconstruction) -> None:
    _, stands = planted.walking(BODY, 2.5)
    p = walked.motion.poses.p_world_joint[:, BODY.index("LeftFoot", "RightFoot")]
    both = stands[1:] & stands[:-1]
    slip = np.linalg.norm(np.diff(p, axis=0), axis=-1)[both] * 60
    assert slip.mean() < 0.08
    assert np.abs(p[..., 2][stands] - 0.08).mean() < 0.01


def test_walking_in_place_stays_in_place() -> None:
    motion, _ = planted.walking(BODY, 2.5, speed=0.0)
    result = reconstruct(recorded(motion), mode="imu", settings=SETTINGS)
    assert np.abs(shift(result, motion)).max() < 0.05


def test_sensors_that_are_off_cost_about_what_they_are_off(walk: MotionSequence) -> None:
    result = reconstruct(recorded(walk, degrees=4.0), mode="imu", settings=SETTINGS)
    assert result.metrics is not None
    assert result.metrics["flexion_deg"] < 6.0
    assert result.metrics["mpjpe_rr_mm"] < 80.0


def test_two_equal_calls_give_equal_motions(walk: MotionSequence, walked: Reconstruction) -> None:
    again = reconstruct(recorded(walk), mode="imu", settings=SETTINGS)
    np.testing.assert_array_equal(again.motion.q, walked.motion.q)


def test_keypoints_are_not_looked_at(walk: MotionSequence, walked: Reconstruction) -> None:
    seen = reconstruct(planted.recording(walk, joints=WHOLE), mode="imu", settings=SETTINGS)
    np.testing.assert_array_equal(seen.motion.q, walked.motion.q)
    assert seen.keypoints is None


# --- what is said of it --------------------------------------------------------------------------


def test_provenance_tells_sensors_from_prior(walked: Reconstruction) -> None:
    poses = walked.motion.poses
    knee, hand, head, root, neck = BODY.index("LeftLeg", "LeftHand", "Head", "Hips", "Neck")
    assert (poses.provenance[:, [knee, hand, root, neck]] == Provenance.IMU).all()
    assert (poses.provenance[:, head] == Provenance.PRIOR).all()
    observed = poses.orientation_observed.all(axis=0)
    assert {BODY.names[j] for j in np.flatnonzero(observed)} == set(WHOLE)
    assert poses.valid.all()
    assert list(walked.stages) == ["start", "imu"]


def test_arms_alone_leave_the_root_where_it_is_and_say_so(
    walk: MotionSequence, caplog: pytest.LogCaptureFixture
) -> None:
    arms = recorded(walk, ("Spine3", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm"))
    with caplog.at_level(logging.WARNING):
        result = reconstruct(arms, mode="imu", settings=SETTINGS)
    assert "the root stays where it is" in caplog.text
    assert result.warnings == tuple(r.message.partition(": ")[2] for r in caplog.records)
    root = result.motion.poses.p_world_joint[:, 0]
    assert np.abs(root - root[0]).max() < 0.1
    assert (result.motion.poses.provenance[:, 0] == Provenance.PRIOR).all()
    assert result.root_sigma is not None
    assert np.isnan(result.root_sigma).all()


def test_somebody_who_sits_is_warned_of() -> None:
    motion = planted.upright(BODY, 90)
    q = np.array(motion.q)
    for side in ("Left", "Right"):
        q[:, 7 + BODY.dof_names.index(f"{side}UpLeg_y")] = np.radians(-90)
        q[:, 7 + BODY.dof_names.index(f"{side}Leg_y")] = np.radians(90)
    p, R = BODY.forward_kinematics(q)
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    sitting = MotionSequence(BODY, q, poses, motion.report)
    result = reconstruct(recorded(sitting), mode="imu", settings=SETTINGS)
    assert len(result.warnings) == 1
    assert "the pelvis is low" in result.warnings[0]


def test_somebody_whose_feet_never_stand_is_warned_of(walk: MotionSequence) -> None:
    recording = recorded(walk)
    strict = replace(SensorsAloneSettings().contacts, shortest=5.0)
    settings = replace(SETTINGS, sensors_alone=SensorsAloneSettings(contacts=strict))
    result = reconstruct(recording, mode="imu", settings=settings)
    assert len(result.warnings) == 1
    assert "no foot stands for 2.5 s at a stretch" in result.warnings[0]
    assert np.linalg.norm(shift(result, walk)[-1]) < 0.3


def test_a_sensor_that_pauses_leaves_a_gap_in_what_is_observed(walk: MotionSequence) -> None:
    recording = recorded(walk)
    assert recording.imus is not None
    R, f = np.array(recording.imus.R_inertial_sensor), np.array(recording.imus.f_sensor)
    s = recording.imus.names.index("imu_LeftLeg")
    R[60:90, s], f[60:90, s] = np.nan, np.nan
    broken = replace(recording, imus=replace(recording.imus, R_inertial_sensor=R, f_sensor=f))
    poses = reconstruct(broken, mode="imu", settings=SETTINGS).motion.poses
    (j,) = BODY.index("LeftLeg")
    np.testing.assert_array_equal(poses.orientation_observed[:, j], np.isfinite(R[:, s, 0, 0]))
    assert np.isfinite(poses.p_world_joint).all()


def test_scores_do_not_count_where_the_first_frame_is(walk: MotionSequence) -> None:
    recording = recorded(walk)
    assert recording.truth is not None
    far = replace(recording.truth, p_world_joint=recording.truth.p_world_joint + np.array([5.0, 3, 1]))
    here, there = (
        reconstruct(r, mode="imu", settings=SETTINGS) for r in (recording, replace(recording, truth=far))
    )
    assert here.metrics is not None
    assert there.metrics is not None
    assert there.metrics["mpjpe_mm"] == pytest.approx(here.metrics["mpjpe_mm"], rel=1e-9)
    figure = skeletons(there)
    assert "the estimate is shifted to start at the truth" in figure.get_suptitle()
    lines = [line for line in figure.axes[0].lines if line.get_color() == TRUTH]
    assert np.abs([line.get_xydata() for line in lines]).max() < 1.0


def test_it_is_exported_with_figures_warnings_and_drift(walked: Reconstruction, tmp_path: Path) -> None:
    import json

    folder = export(walked, tmp_path / "out")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["mode"] == "imu"
    assert summary["root_drift_sigma_m"]["last_frame"] == pytest.approx(walked.root_sigma[-1])  # type: ignore[index]
    assert (folder / "figures" / "skeletons.png").stat().st_size > 10_000


# --- frames --------------------------------------------------------------------------------------


@pytest.mark.parametrize("own, asked, expected", [(100, 60, 60), (30, 60, 30), (60, 60, 60)])
def test_frames_are_even_at_the_rate_asked_for_or_the_sensors(
    own: float, asked: float, expected: float
) -> None:
    T = 50
    R = np.tile(np.eye(3), (T, 1, 1, 1))
    f = np.tile([0.0, 0.0, 9.81], (T, 1, 1))
    imus = ImuSequence(2.0 + np.arange(T) / own, R, f, ("a",))
    times = frame_times(imus, asked)
    np.testing.assert_allclose(np.diff(times), 1 / expected)
    assert times[0] == 2.0
    assert imus.times[-1] - 1 / expected < times[-1] <= imus.times[-1] + 1e-9


# --- hostile input -------------------------------------------------------------------------------


def test_a_mode_that_lacks_what_it_needs_says_so(walk: MotionSequence) -> None:
    recording = recorded(walk)
    for mode in CAMERA_MODES:
        with pytest.raises(ShapeError, match=f"mode {mode} needs keypoints and the recording has none"):
            reconstruct(recording, mode=mode)
    seen = replace(planted.recording(walk), imus=None, calibration=None)
    with pytest.raises(ShapeError, match="mode imu needs IMUs and the recording has none"):
        reconstruct(seen, mode="imu")
    with pytest.raises(CalibrationError, match="have no calibration"):
        reconstruct(replace(recording, calibration=None), mode="imu")
    with pytest.raises(ShapeError, match="mode imu is solved in joint space"):
        reconstruct(recording, mode="imu", settings=ReconstructionSettings(fragment=CartesianSettings()))
    with pytest.raises(ShapeError, match="rate_hz must be positive"):
        SensorsAloneSettings(rate_hz=0.0)


def test_the_fragment_solver_refuses_what_it_cannot_solve(walked: Reconstruction) -> None:
    start, imus = walked.stages["start"], walked.bone_imus
    with pytest.raises(SolverError, match="neither keypoints nor bone_imus"):
        FragmentSolver(BODY, 20).solve(start, None)
    with pytest.raises(SolverError, match="space 'cartesian' needs keypoints"):
        FragmentSolver(BODY, 20, space="cartesian", sensor_joints=WHOLE).solve(start, None, imus)


# --- a real recording ----------------------------------------------------------------------------


def squats() -> Recording:
    """Three squats after a stand of two seconds: Movella DOTs on pelvis, thighs and shanks."""
    joints = {
        "Pelvis": "Hips", "RFemur": "RightUpLeg", "RTibia": "RightLeg",
        "LTibia": "LeftUpLeg", "LFemur": "LeftLeg",  # the left leg's files are named the wrong way round
    }  # fmt: skip
    arrays = read_npz(Path(__file__).parents[1] / "fixtures/inertial/xsens_dot_squats/squats.npz")
    parts = [
        ImuSequence(
            arrays[f"{name}_times"],
            so3.from_quat_wxyz(arrays[f"{name}_quat_wxyz"])[:, None],
            arrays[f"{name}_f_sensor"][:, None],
            (name,),
        )
        for name in joints
    ]
    imus = ImuSequence.joined(parts)
    found = calibrate_by_pose(imus, joints, "N", BODY)
    return Recording("squats", imus=imus, calibration=found.calibration)


def test_real_squats_bend_both_knees_three_times_over_standing_feet() -> None:
    poses = reconstruct(squats(), mode="imu").motion.poses
    bent = np.degrees(flexion(poses.p_world_joint, BODY)[:, BODY.index("LeftLeg", "RightLeg")])
    for knee in bent.T:
        peaks, _ = find_peaks(knee, height=40, distance=30)
        assert len(peaks) == 3
        assert ((knee[peaks] > 50) & (knee[peaks] < 85)).all()
        assert knee[poses.times < poses.times[0] + 1.5].max() < 8.0
    assert np.abs(bent[:, 0] - bent[:, 1]).mean() < 8.0
    (right,) = BODY.index("RightFoot")
    assert np.ptp(poses.p_world_joint[:, right], axis=0).max() < 0.06
    pelvis = poses.p_world_joint[:, 0, 2]
    assert 0.08 < pelvis[0] - pelvis.min() < 0.35
