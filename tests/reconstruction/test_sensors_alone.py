"""Mode imu: planted motions are recovered from their sensors alone, and its limitations are reported."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from reconstruction_support import BODY
from scipy.signal import find_peaks

from rtof_kin.body.metrics import flexion
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import CalibrationError, InvalidInputError, SolverError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.sensors_alone import frame_times
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.fragment_solver import FragmentSolver, SolverStatus
from rtof_kin.solve.settings import CartesianSettings

Array = NDArray[np.float64]
WHOLE = ("Hips", "Spine3", *planted.LIMBS)
SETTINGS = ReconstructionSettings(frames=20)


def recorded(motion: Motion, joints: tuple[str, ...] = WHOLE, degrees: float = 0.0) -> Recording:
    """A recording of sensors without a camera."""
    return replace(planted.recording(motion, joints=joints, degrees=degrees), keypoints=None)


def solved(recording: Recording, settings: ReconstructionSettings = SETTINGS) -> Reconstruction:
    return reconstruct(recording, mode="imu", settings=settings)


def shift(result: Reconstruction, motion: Motion) -> Array:
    """(T, 3) m, the root's path less the true one, both from the first frame on."""
    own, true = result.motion.poses.p_world_joint[:, 0], motion.poses.p_world_joint[:, 0]
    return np.asarray((own - own[0]) - (true - true[0]))


@pytest.fixture(scope="module")
def walk() -> Motion:
    return planted.walking(BODY, 2.5)[0]


@pytest.fixture(scope="module")
def walked(walk: Motion) -> Reconstruction:
    return solved(recorded(walk))


def test_exact_sensors_recover_a_walk(walk: Motion, walked: Reconstruction) -> None:
    assert walked.solution.status is SolverStatus.CONVERGED
    assert walked.warnings == ()
    assert walked.checks
    assert not any(check.failed for check in walked.checks)
    index, knees = BODY.index(*WHOLE), BODY.index("LeftLeg", "RightLeg")
    R, R_true = (m.poses.R_world_bone[:, index] for m in (walked.motion, walk))
    assert np.degrees(so3.angle_between(R, R_true)).mean() < 2.0
    bent, true = (flexion(m.poses.p_world_joint, BODY) for m in (walked.motion, walk))
    assert np.degrees(np.abs(bent - true)[:, knees]).mean() < 2.0


def test_walk_drifts_by_less_than_three_percent_and_standing_feet_do_not_slip(
    walk: Motion, walked: Reconstruction
) -> None:
    length = float(np.ptp(walk.poses.p_world_joint[:, 0, 0]))
    assert length == pytest.approx(2.0, rel=0.02)
    assert np.linalg.norm(shift(walked, walk)[-1]) < 0.03 * length
    assert 0 < walked.root_sigma[-1] < 0.2 * length
    _, stands = planted.walking(BODY, 2.5)
    p = walked.motion.poses.p_world_joint[:, BODY.index("LeftFoot", "RightFoot")]
    slip = 60 * np.linalg.norm(np.diff(p, axis=0), axis=-1)[stands[1:] & stands[:-1]]
    assert slip.mean() < 0.08
    assert np.abs(p[..., 2][stands] - 0.08).mean() < 0.01


def test_walking_in_place_stays_in_place() -> None:
    motion, _ = planted.walking(BODY, 2.5, speed=0.0)
    assert np.abs(shift(solved(recorded(motion)), motion)).max() < 0.05


def test_sensor_errors_cause_errors_of_their_size(walk: Motion) -> None:
    metrics = solved(recorded(walk, degrees=4.0)).stage_metrics["imu"]
    assert metrics["flexion_deg"] < 6.0
    assert metrics["mpjpe_rr_mm"] < 80.0


def test_equal_calls_give_equal_motions_and_keypoints_are_ignored(walk: Motion, walked: Reconstruction) -> None:
    again = solved(planted.recording(walk, joints=WHOLE))
    np.testing.assert_array_equal(again.motion.q, walked.motion.q)
    assert again.keypoints is None


def test_provenance_separates_sensors_from_prior(walked: Reconstruction) -> None:
    poses = walked.motion.poses
    knee, hand, head, root, neck = BODY.index("LeftLeg", "LeftHand", "Head", "Hips", "Neck")
    assert (poses.provenance[:, [knee, hand, root, neck]] == Provenance.IMU).all()
    assert (poses.provenance[:, head] == Provenance.PRIOR).all()
    observed = poses.orientation_observed.all(axis=0)
    assert {BODY.names[j] for j in np.flatnonzero(observed)} == set(WHOLE)
    np.testing.assert_array_equal(poses.valid, poses.provenance == Provenance.IMU)
    assert list(walked.stages) == ["start", "imu"]


def test_root_without_sensors_on_the_legs_stays_with_a_warning(walk: Motion, caplog: pytest.LogCaptureFixture) -> None:
    arms = ("Spine3", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm")
    with caplog.at_level(logging.WARNING):
        result = solved(recorded(walk, arms))
    (warning,) = result.warnings
    assert "no sensor on a foot or shank" in warning
    assert warning in caplog.text
    root = result.motion.poses.p_world_joint[:, 0]
    assert np.abs(root - root[0]).max() < 0.1
    assert (result.motion.poses.provenance[:, 0] == Provenance.PRIOR).all()
    assert result.root_sigma is not None
    assert np.isnan(result.root_sigma).all()


def test_low_pelvis_is_warned_of() -> None:
    motion = planted.upright(BODY, 90)
    q = np.array(motion.q)
    for dof, angle in (("LeftUpLeg", -90), ("RightUpLeg", -90), ("LeftLeg", 90), ("RightLeg", 90)):
        q[:, 7 + BODY.dof_names.index(f"{dof}_y")] = np.radians(angle)
    p, R = BODY.forward_kinematics(q)
    poses = replace(motion.poses, p_world_joint=p, R_world_bone=R)
    (warning,) = solved(recorded(Motion(BODY, q, poses, motion.report))).warnings
    assert "pelvis is low" in warning


def test_flight_is_warned_of(walk: Motion, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtof_kin.inertial.root_path._SHORTEST", 5.0)  # no foot stands for so long
    result = solved(recorded(walk))
    (warning,) = result.warnings
    assert "contact for 2.5 s" in warning
    assert np.linalg.norm(shift(result, walk)[-1]) < 0.3


def test_paused_sensor_leaves_its_orientation_unobserved(walk: Motion) -> None:
    recording = recorded(walk)
    imus, (j,) = recording.imus, BODY.index("LeftLeg")
    R = np.array(imus.R_inertial_sensor)
    R[60:90, imus.names.index("imu_LeftLeg")] = np.nan
    f = np.where(np.isnan(R[..., 0]), np.nan, imus.f_sensor)
    poses = solved(replace(recording, imus=replace(imus, R_inertial_sensor=R, f_sensor=f))).motion.poses
    assert np.flatnonzero(~poses.orientation_observed[:, j]).tolist() == list(range(60, 90))
    assert np.isfinite(poses.p_world_joint).all()


def test_scores_begin_at_the_truth(walk: Motion) -> None:
    recording = recorded(walk)
    far = replace(recording.truth, p_world_joint=recording.truth.p_world_joint + np.array([5.0, 3, 1]))
    here, there = solved(recording), solved(replace(recording, truth=far))
    assert there.stage_metrics["imu"] == pytest.approx(here.stage_metrics["imu"], rel=1e-9)


@pytest.mark.parametrize("asked, expected", [(30, 30), (60, 60), (100, 60)])
def test_frame_times_are_even_at_the_lower_rate(walk: Motion, asked: float, expected: float) -> None:
    imus = recorded(walk).imus
    times = frame_times(imus, asked)
    np.testing.assert_allclose(np.diff(times), 1 / expected)
    assert times[0] == imus.times[0]
    assert imus.times[-1] - 1 / expected < times[-1] <= imus.times[-1] + 1e-9


def test_mode_names_the_input_that_it_lacks(walk: Motion) -> None:
    recording = recorded(walk)
    for mode in CAMERA_MODES:
        with pytest.raises(InvalidInputError, match=f"mode {mode} needs keypoints.*'imu'"):
            reconstruct(recording, mode=mode)
    with pytest.raises(InvalidInputError, match="mode imu needs IMUs"):
        solved(replace(planted.recording(walk), imus=None, calibration=None))
    with pytest.raises(CalibrationError, match="no calibration"):
        solved(replace(recording, calibration=None))
    with pytest.raises(InvalidInputError, match="joint space"):
        solved(recording, ReconstructionSettings(fragment=CartesianSettings()))


def test_fragment_solver_names_the_input_that_it_lacks(walked: Reconstruction) -> None:
    start, imus = walked.stages["start"], walked.bone_imus
    with pytest.raises(SolverError, match="keypoints nor bone_imus"):
        FragmentSolver(BODY, 20).solve(start, None)
    with pytest.raises(SolverError, match="'cartesian' needs keypoints"):
        FragmentSolver(BODY, 20, space="cartesian", sensor_joints=WHOLE).solve(start, None, imus)


def squats() -> Recording:
    """Three squats after two seconds of standing: Movella DOTs on pelvis, thighs and shanks."""
    joints = {
        "Pelvis": "Hips",
        "RFemur": "RightUpLeg",
        "RTibia": "RightLeg",
        "LTibia": "LeftUpLeg",
        "LFemur": "LeftLeg",  # the names of the left leg's files are exchanged
    }
    a = read_npz(Path(__file__).parents[1] / "fixtures/inertial/xsens_dot_squats/squats.npz")
    R = {name: so3.from_quat_wxyz(a[f"{name}_quat_wxyz"])[:, None] for name in joints}
    imus = ImuSequence.joined([ImuSequence(a[f"{n}_times"], R[n], a[f"{n}_f_sensor"][:, None], (n,)) for n in joints])
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
