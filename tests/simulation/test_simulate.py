"""Simulated recordings: physics without noise, statistics of the noise, cameras, determinism."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks.keypoint_noise import KeypointNoise, independent, keypoint_errors, unseen
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.cameras import read_camera
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.sensor_files import imus_of_log
from rtof_kin.setup.sources import Sources
from rtof_kin.simulation import noise as noises
from rtof_kin.simulation.mocap import MocapClip, read_mocap
from rtof_kin.simulation.noise import ORIENTATION_MEDIAN_DEG, ImuNoise
from rtof_kin.simulation.simulate import (
    LIMB_SENSORS,
    SimulationSettings,
    low_passed,
    simulate,
    simulate_file,
    standard_cameras,
    write_raw_files,
)
from rtof_kin.vision.keypoints import read_detector_keypoints

Array = NDArray[np.float64]
SKELETON = SkeletonModel.default().with_height(1.68)
POSES = planted.moving(SKELETON, 120).poses
CAMERA = planted.camera()
NOISELESS = SimulationSettings.noiseless()
ALL_SENSORS = tuple(SKELETON.sensors)


def simulated(
    settings: SimulationSettings, poses: PoseSequence = POSES, camera: Camera = CAMERA, seed: int = 1
) -> Recording:
    return simulate(poses, SKELETON.joint_offsets, camera=camera, settings=settings, seed=seed)


def sensor_accelerations(poses: PoseSequence, sensors: tuple[str, ...]) -> Array:
    """Central second differences (T - 2, S, 3) of the sensors' positions."""
    joints = SKELETON.index(*(SKELETON.sensors[name][0] for name in sensors))
    levers = np.array([SKELETON.sensors[name][1] for name in sensors])
    p = poses.p_world_joint[:, joints] + np.einsum("tsij,sj->tsi", poses.R_world_bone[:, joints], levers)
    return np.asarray((p[2:] - 2 * p[1:-1] + p[:-2]) * poses.rate_hz**2)


def test_without_noise_the_calibrated_orientation_is_that_of_the_bones() -> None:
    recording = simulated(replace(NOISELESS, sensors=ALL_SENSORS))
    bones = recording.calibration.apply(recording.imus)
    truth = POSES.R_world_bone[:, SKELETON.index(*bones.joints)]
    assert np.abs(bones.R_world_bone - truth).max() < 1e-12


def test_a_sensor_at_rest_reads_one_gravity_upwards() -> None:
    recording = simulated(NOISELESS, planted.standing(SKELETON, 30).poses)
    imus, calibration = recording.imus, recording.calibration
    f_inertial = np.einsum("tsij,tsj->tsi", imus.R_inertial_sensor, imus.f_sensor)
    np.testing.assert_allclose(f_inertial, np.broadcast_to(-GRAVITY_WORLD, f_inertial.shape), atol=1e-9)
    assert np.ptp(imus.f_sensor[0], axis=0).max() > 1, "every sensor is mounted in another way"
    headings = so3.heading(calibration.R_world_inertial)
    assert len(np.unique(headings.round(3))) == len(LIMB_SENSORS)
    np.testing.assert_allclose(calibration.R_world_inertial[:, 2, 2], 1.0)


def test_aligned_samples_equal_the_central_differences_of_the_truth() -> None:
    bones = simulated(NOISELESS).bone_imus()
    error = bones.a_world[1:-1] - sensor_accelerations(POSES, LIMB_SENSORS)
    assert np.abs(error).max() < 1e-8


@pytest.mark.parametrize(
    ("rate_hz", "start", "largest"), [(240.0, 0.9, 0.05), (100.0, 0.3, 0.15), (60.0, 0.5, 0.4), (50.0, 0.2, 0.4)]
)
def test_samples_at_other_instants_are_close(rate_hz: float, start: float, largest: float) -> None:
    settings = replace(NOISELESS, imu_rate_hz=rate_hz, imu_start_frames=(start, start))
    recording = simulated(settings)
    bones = recording.bone_imus()
    np.testing.assert_allclose(recording.imus.times[0], POSES.times[0] + start / rate_hz)
    np.testing.assert_allclose(np.diff(recording.imus.times), 1 / rate_hz)
    expected = sensor_accelerations(POSES, LIMB_SENSORS)
    error = np.linalg.norm((bones.a_world[1:-1] - expected)[3:-3], axis=-1)
    assert np.median(error) < 0.05
    assert error.max() < largest
    assert np.linalg.norm(expected, axis=-1).max() > 10, "or else the test says nothing"
    truth = POSES.R_world_bone[:, SKELETON.index(*bones.joints)]
    assert np.nanmax(so3.angle_between(bones.R_world_bone, truth)[3:-3]) < np.radians(0.3)


def test_perfect_keypoints_are_the_projections_of_everything_in_front_of_the_camera() -> None:
    recording = simulated(SimulationSettings.perfect())
    np.testing.assert_array_equal(recording.video.uv_px, CAMERA.project(POSES.p_world_joint))
    assert np.all(recording.video.confidence == 1)
    np.testing.assert_array_equal(recording.video.times, POSES.times)
    near = Camera.looking_at(POSES.p_world_joint[0, 0] + [0, 0, 0.01], [5.0, 0.0, 1.0], 1250.0)
    behind = near.to_camera(POSES.p_world_joint)[..., 2] < 0
    assert behind.any()
    np.testing.assert_array_equal(simulated(SimulationSettings.perfect(), camera=near).video.seen, ~behind)


def test_independent_keypoints_outside_the_image_are_unseen() -> None:
    near = Camera.looking_at([1.8, 0.3, 1.2], [0.0, 0.0, 1.2], 1250.0)
    uv = near.project(POSES.p_world_joint)
    outside = ((uv < 0) | (uv > [1920, 1080])).any(axis=-1)
    assert 0.02 < outside.mean() < 0.5
    settings = replace(independent(), video_lag_frames=(0.0, 0.0))
    assert not simulated(settings, camera=near).video.seen[outside].any()


def test_a_detector_finds_the_landmarks_asked_for() -> None:
    settings = replace(NOISELESS, landmarks=("Nose", "LeftToe", "LeftHand"))
    keypoints = simulated(settings).keypoints
    assert keypoints.names == ("Nose", "LeftToe", "LeftHand")
    joint, offset = SKELETON.landmarks["LeftToe"]
    j = SKELETON.index(joint)[0]
    toe = POSES.p_world_joint[:, j] + POSES.R_world_bone[:, j] @ offset
    np.testing.assert_allclose(keypoints.uv_px[:, 1], CAMERA.project(toe))


def test_a_late_video_shows_earlier_instants() -> None:
    recording = simulated(replace(NOISELESS, video_lag_frames=(3.0, 3.0)))
    uv = CAMERA.project(POSES.p_world_joint)
    assert recording.first_frame == 3
    np.testing.assert_array_equal(recording.joint_offsets, SKELETON.joint_offsets)
    np.testing.assert_array_equal(recording.keypoints.times, POSES.times[3:])
    np.testing.assert_array_equal(recording.truth.times, POSES.times[3:])
    np.testing.assert_allclose(recording.keypoints.uv_px, uv[:-3], atol=1e-6)
    between = simulated(replace(NOISELESS, video_lag_frames=(2.5, 2.5))).keypoints
    assert len(between) == len(POSES) - 3
    middle = (uv[1:] + uv[:-1])[:-2] / 2
    np.testing.assert_allclose(between.uv_px, middle, atol=0.3)


def everything(recording: Recording) -> Array:
    parts = (
        recording.keypoints.uv_px,
        recording.keypoints.confidence,
        recording.imus.times,
        recording.imus.R_inertial_sensor,
        recording.imus.f_sensor,
        recording.calibration.R_sensor_bone,
        recording.calibration.R_world_inertial,
    )
    return np.concatenate([part.ravel() for part in parts])


def test_equal_seeds_give_equal_recordings() -> None:
    first, again = (everything(simulated(SimulationSettings.realistic())) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = simulated(SimulationSettings.realistic(), seed=2)
    assert not np.array_equal(first, everything(other))


def test_a_subset_of_the_sensors_has_the_same_errors_as_the_whole_set() -> None:
    whole = simulated(replace(SimulationSettings.perfect(), sensors=ALL_SENSORS))
    few = simulated(replace(SimulationSettings.perfect(), sensors=("R_LowLeg", "Pelvis")))
    assert few.imus.names == ("R_LowLeg", "Pelvis")
    np.testing.assert_array_equal(whole.imus.select(few.imus.names).f_sensor, few.imus.f_sensor)
    np.testing.assert_array_equal(whole.imus.select(few.imus.names).R_inertial_sensor, few.imus.R_inertial_sensor)


TIMES = np.arange(6000) / 60
FIXED = replace(KeypointNoise(), parameter_spread=0.0)
QUIET = replace(FIXED, bias_px=0, drift_px=0, white_px=0, outlier_share=(0.0, 0.0))


def errors(noise: KeypointNoise, joints: list[str], times: Array = TIMES, seed: int = 0) -> Array:
    return keypoint_errors(np.random.default_rng(seed), times, joints, noise)


@pytest.mark.parametrize(("joint", "memory", "size"), [("Hips", 0.5, 5.0), ("LeftHand", 0.3, 6.5)])
def test_the_drift_has_its_size_and_correlation_time(joint: str, memory: float, size: float) -> None:
    uv = errors(replace(QUIET, drift_px=5.0), [joint] * 60)
    assert uv.std() == pytest.approx(size, rel=0.05)
    assert correlation_of(uv, round(memory * 60)) == pytest.approx(np.exp(-1), abs=0.05)


def correlation_of(values: Array, steps: int) -> float:
    return float((values[steps:] * values[:-steps]).mean() / values.var())


def test_bias_is_constant_and_white_noise_is_white() -> None:
    bias = errors(replace(QUIET, bias_px=6.0), ["Hips"] * 2000, TIMES[:3])
    assert np.ptp(bias, axis=0).max() < 1e-12
    assert bias[0].std() == pytest.approx(6.0, rel=0.05)
    white = errors(KeypointNoise.white(5.0), ["Hips", "LeftHand", "LeftFoot"])
    np.testing.assert_allclose(white.std(axis=(0, 2)), 5.0, rtol=0.03)
    assert abs(correlation_of(white, 1)) < 0.03
    joints = ["Hips", "LeftForeArm", "RightHand", "RightLeg", "LeftFoot"]
    size = errors(replace(QUIET, white_px=1.0), joints).std(axis=(0, 2))
    np.testing.assert_allclose(size, [1.0, 1.3, 1.3, 0.8, 0.8], rtol=0.05)


def test_outliers_have_their_share_and_duration() -> None:
    uv = errors(replace(QUIET, outlier_share=(0.04, 0.04)), ["Hips"] * 60)
    out = np.linalg.norm(uv, axis=-1) > 0
    assert out.mean() == pytest.approx(0.04, rel=0.1)
    displaced = np.linalg.norm(uv[out], axis=-1)
    assert np.median(displaced) == pytest.approx(80, rel=0.1)
    lengths = []
    for j in range(60):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], out[1:-1, j], [0]]).astype(int)))
        lengths += list(np.diff(edges)[::2] / 60)
    assert np.quantile(lengths, 0.05) >= 0.2 - 1 / 60
    assert np.quantile(lengths, 0.95) < 1.1, "two may overlap, rarely"


def test_a_person_who_leaves_the_image_is_lost_for_some_time() -> None:
    inside = np.ones((6000, 21), dtype=bool)
    inside[1000:1002] = False  # gone for two frames only
    inside[2000:2600] = False  # gone for ten seconds
    inside[3000:3010, 5] = False  # one joint
    lengths = []
    for seed in range(40):
        lost = unseen(np.random.default_rng(seed), TIMES, inside, FIXED)
        assert lost[~inside].all()
        assert lost[2000:2600].all()
        assert not lost[2601:3000].any()
        assert lost[3000:3010].sum() == 10
        lengths.append(lost[1000:2000].all(axis=1).sum() / 60)
    assert min(lengths) >= 0.5
    assert max(lengths) < 5.1
    assert 2.0 < np.mean(lengths) < 3.5


def test_parameters_are_drawn_anew_for_each_recording() -> None:
    drawn = [KeypointNoise().drawn(np.random.default_rng(s)) for s in range(400)]
    bias = np.array([noise.bias_px for noise in drawn])
    assert np.median(bias) == pytest.approx(6.0, rel=0.06)
    assert np.log(bias).std() == pytest.approx(0.25, rel=0.15)
    assert KeypointNoise.white(5.0).drawn(np.random.default_rng(0)) == KeypointNoise.white(5.0)
    assert ImuNoise().drawn(np.random.default_rng(0)) != ImuNoise()
    assert ImuNoise.perfect().drawn(np.random.default_rng(0)) == ImuNoise.perfect()
    lags = replace(independent(), sensors=())
    assert {simulated(lags, POSES[:20], seed=seed).first_frame for seed in range(20)} == {2, 3, 4}


SLOW = np.arange(2000) / 10
FIXED_IMU = replace(ImuNoise(), parameter_spread=0.0)


def local_motion(amplitude: float, seed: int = 3) -> Array:
    return so3.exp(planted.smooth_noise(seed, (len(SLOW), 3), 5, amplitude))


def slips(joint: str, axis: Array, amplitude: float = 0.5, seeds: int = 12) -> Array:
    R = local_motion(amplitude)
    return np.array(
        [
            so3.log(noises.mounting_errors(np.random.default_rng(s), SLOW, joint, axis, R, FIXED_IMU))
            for s in range(seeds)
        ]
    )


@pytest.mark.parametrize("joint", ["Head", "LeftArm", "RightForeArm", "LeftLeg", "RightFoot"])
def test_the_median_orientation_error_is_that_of_real_sensors(joint: str) -> None:
    error = np.degrees(np.linalg.norm(slips(joint, np.array([0, 1.0, 0])), axis=-1))
    assert np.median(error) == pytest.approx(ORIENTATION_MEDIAN_DEG[joint], rel=0.2)


def test_limb_sensors_err_in_swing_and_twist_as_real_ones_do() -> None:
    poses = planted.moving(SKELETON, 600).poses[::6]
    settings = replace(NOISELESS, imu=ImuNoise(), imu_rate_hz=poses.rate_hz)
    joints = SKELETON.index(*(SKELETON.sensors[name][0] for name in LIMB_SENSORS))
    along = so3.unit(np.array([SKELETON.table.joints[j].end for j in joints]))
    swing, twist = [], []
    for seed in range(60):
        bones = simulated(settings, poses, seed=seed).bone_imus()
        error = (np.swapaxes(poses.R_world_bone[:, joints], -1, -2) @ bones.R_world_bone)[1:-1]
        turned = np.einsum("tsij,sj,si->ts", error, along, along)
        swing.append(np.degrees(np.arccos(np.minimum(turned, 1))))
        twist.append(np.degrees(np.abs(np.einsum("tsi,si->ts", so3.log(error), along))))
    assert np.median(swing) == pytest.approx(2.7, rel=0.08)
    assert np.median(twist) == pytest.approx(4.7, rel=0.08)


def test_slip_turns_the_sensor_and_keeps_the_acceleration() -> None:
    imu = replace(FIXED_IMU, misalignment_deg=0, white=0, white_per_acceleration=0, coloured=0, bias=0)
    settings = replace(NOISELESS, imu=imu, sensors=("R_LowArm",))
    along = []
    for seed in range(8):
        bones = simulated(settings, seed=seed).bone_imus()
        truth = POSES.R_world_bone[:, SKELETON.index("RightForeArm")]
        error = so3.log(np.swapaxes(truth, -1, -2) @ bones.R_world_bone)
        along.append((error[..., 1] ** 2).sum() / (error**2).sum())
        a_error = bones.a_world[1:-1] - sensor_accelerations(POSES, ("R_LowArm",))
        assert np.abs(a_error).max() < 1e-8
    assert np.mean(along) > 0.7, "a forearm lies along y of its link frame"


def test_soft_tissue_errors_follow_the_motion_and_are_small_at_rest() -> None:
    noise = replace(FIXED_IMU, wobble_share=1.0)
    axis = np.array([0, 0, 1.0])

    def size(amplitude: float) -> float:
        R = local_motion(amplitude)
        E = noises.mounting_errors(np.random.default_rng(0), SLOW, "LeftLeg", axis, R, noise)
        return float(np.linalg.norm(so3.log(E), axis=-1).mean())

    assert size(0.0) < 1e-9
    assert size(0.02) < 0.3 * size(0.5)


def test_the_misalignment_is_two_degrees_per_axis_and_not_in_the_calibration() -> None:
    imu = replace(ImuNoise.perfect(), misalignment_deg=2.0)
    settings = replace(NOISELESS, imu=imu, sensors=ALL_SENSORS)
    found = []
    for seed in range(12):
        bones = simulated(settings, POSES[:8], seed=seed).bone_imus()
        truth = POSES.R_world_bone[:8, SKELETON.index(*bones.joints)]
        error = np.degrees(so3.log(np.swapaxes(truth, -1, -2) @ bones.R_world_bone))
        assert np.ptp(error, axis=0).max() < 1e-6, "constant"
        found.append(error[0])
    assert np.std(found) == pytest.approx(2.0, rel=0.12)


def test_accelerometer_errors_have_white_coloured_and_constant_parts() -> None:
    rng = np.random.default_rng(0)
    still = np.zeros((len(TIMES), 3))
    one = replace(ImuNoise.perfect(), white=0.4, white_per_acceleration=0.2)
    assert noises.accelerometer_errors(rng, TIMES, still, one).std() == pytest.approx(0.4, rel=0.05)
    fast = np.tile([6.0, 0.0, 8.0], (len(TIMES), 1))
    assert noises.accelerometer_errors(rng, TIMES, fast, one).std() == pytest.approx(2.4, rel=0.05)
    bias = replace(ImuNoise.perfect(), bias=0.1)
    samples = [noises.accelerometer_errors(rng, TIMES[:2], still[:2], bias) for _ in range(800)]
    assert np.ptp(samples, axis=1).max() == 0
    assert np.std(samples) == pytest.approx(0.1, rel=0.06)
    coloured = replace(ImuNoise.perfect(), coloured=0.5)
    error = noises.accelerometer_errors(rng, TIMES, still, coloured)
    assert error.std() == pytest.approx(0.5, rel=0.15)
    assert correlation_of(error, 12) == pytest.approx(np.exp(-1), abs=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_the_standard_cameras_stand_around_the_motion_and_see_it(seed: int) -> None:
    cameras = standard_cameras(POSES, seed)
    middle = POSES.p_world_joint.reshape(-1, 3)
    middle = (middle.min(axis=0) + middle.max(axis=0)) / 2
    offsets = np.array([camera.center_world - middle for camera in cameras])
    azimuths = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    assert np.abs(np.diff(azimuths) - np.pi / 2).max() < 0.61
    for camera, offset in zip(cameras, offsets, strict=True):
        assert (camera.width_px, camera.height_px) == (1920, 1080)
        assert camera.K[0, 0] == 1250
        assert 0.8 <= camera.center_world[2] <= 2.6
        assert 3.0 <= np.hypot(*offset[:2]) < 6.3
        np.testing.assert_allclose(camera.project(middle), [960, 540])
        uv = camera.project(POSES.p_world_joint)
        assert ((uv >= 0) & (uv <= [1920, 1080])).all(axis=-1).mean() >= 0.9
    assert np.array_equal(cameras[2].K, standard_cameras(POSES, seed)[2].K)
    np.testing.assert_array_equal(cameras[2].center_world, standard_cameras(POSES, seed)[2].center_world)


def test_low_pass_removes_jitter_and_keeps_bones_and_slow_motion() -> None:
    T = len(POSES)
    jitter = so3.exp(0.02 * np.random.default_rng(0).normal(size=(T, 21, 3)))
    R = POSES.R_world_bone @ jitter
    clip = MocapClip("jittery", replace(POSES, R_world_bone=R), SKELETON.joint_offsets)
    smooth = low_passed(clip, 8.0).poses
    before = so3.angle_between(R, POSES.R_world_bone).mean()
    assert so3.angle_between(smooth.R_world_bone, POSES.R_world_bone)[10:-10].mean() < 0.6 * before
    assert np.linalg.norm(smooth.p_world_joint - POSES.p_world_joint, axis=-1)[10:-10].max() < 0.02
    for j, parent in enumerate(SKELETON.parents[1:], start=1):
        bone = np.linalg.norm(smooth.p_world_joint[:, j] - smooth.p_world_joint[:, parent], axis=-1)
        np.testing.assert_allclose(bone, np.linalg.norm(SKELETON.joint_offsets[j]), atol=1e-12)
    with pytest.raises(InvalidInputError, match="40 Hz"):
        low_passed(clip, 40.0)


MOCAP = Path(__file__).parents[1] / "fixtures" / "mocap"


@pytest.mark.parametrize(
    ("name", "rate_hz", "smooth_hz"), [("02_01_excerpt.bvh", 30.0, 10.0), ("16_15.amc", 3.0, None)]
)
def test_motion_capture_file_becomes_a_recording(name: str, rate_hz: float, smooth_hz: float | None) -> None:
    def recorded(camera: Camera | int) -> Recording:
        return simulate_file(
            MOCAP / name,
            settings=SimulationSettings.perfect(),
            seed=5,
            camera=camera,
            rate_hz=rate_hz,
            video_rate_hz=rate_hz,
            smooth_hz=smooth_hz,
            acknowledgement="CMU",
        )

    recordings = [recorded(0), recorded(1), recorded(CAMERA)]
    for recording in recordings:
        assert recording.name == Path(name).stem
        assert recording.acknowledgement == "CMU"
        assert recording.truth.rate_hz == pytest.approx(rate_hz)
        assert np.median(np.diff(recording.imus.times)) == pytest.approx(1 / 60)
        assert np.median(np.linalg.norm(recording.imus.f_sensor, axis=-1)) < 20
        seen = recording.keypoints.camera.project(recording.truth.p_world_joint)
        np.testing.assert_array_equal(recording.keypoints.uv_px, seen)
    centres = np.array([recording.keypoints.camera.center_world for recording in recordings])
    assert np.linalg.norm(centres[0] - centres[1]) > 2
    np.testing.assert_array_equal(centres[2], CAMERA.center_world)
    with pytest.raises(UnknownNameError, match=r"standard camera '4'\. Known: 0, 1, 2, 3"):
        recorded(4)


GAP = np.where(np.arange(120)[:, None, None] == 7, np.nan, POSES.p_world_joint)
JITTER = 0.02 * np.random.default_rng(0).normal(size=(120, 1, 3))


@pytest.mark.parametrize(
    ("settings", "poses", "error", "message"),
    [
        ({"sensors": ("L_LowArn",)}, POSES, UnknownNameError, "Did you mean 'L_LowArm'"),
        ({"landmarks": ("Noze",)}, POSES, UnknownNameError, "Did you mean 'Nose'"),
        ({}, POSES[:3], InvalidInputError, "3 poses; 4 at least"),
        ({"video_lag_frames": (3.0, 3.0)}, POSES[:6], InvalidInputError, "too few for a lag of 0.05 s"),
        ({}, planted.moving(SkeletonModel.human36m(), 10).poses, InvalidInputError, "skeleton total_capture"),
        ({}, replace(POSES, p_world_joint=GAP), InvalidInputError, "frame 7 is not complete; cut the motion"),
        ({}, replace(POSES, p_world_joint=POSES.p_world_joint + JITTER), InvalidInputError, "needs `low_passed`"),
    ],
)
def test_wrong_input(
    settings: dict[str, tuple[str, ...]], poses: PoseSequence, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        simulated(replace(NOISELESS, **settings), poses)  # type: ignore[arg-type]


def test_of_several_cameras_the_one_that_sees_most_films() -> None:
    settings = SimulationSettings()
    clip = read_mocap(MOCAP / "02_01_excerpt.bvh", output_rate_hz=60.0)
    cameras = standard_cameras(clip.poses, 2)

    def seen_by(camera: Camera | list[Camera]) -> Recording:
        return simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=2)

    alone = [seen_by(camera) for camera in cameras]
    best = max(alone, key=lambda recording: float(recording.video.seen.mean()))
    chosen = seen_by(cameras)
    np.testing.assert_array_equal(chosen.video.uv_px, best.video.uv_px)
    assert chosen.imus is not None
    assert best.imus is not None
    np.testing.assert_array_equal(chosen.imus.f_sensor, best.imus.f_sensor)


@pytest.fixture(scope="module")
def demo() -> Recording:
    return Recording.load(model_path("demo")).between(0.0, 1.5)


def test_files_are_recognised_and_hold_what_was_recorded(tmp_path: Path, demo: Recording) -> None:
    take = tmp_path / "take"
    write_raw_files(demo, take)
    found = Sources.of(take.glob("[!.]*"))
    assert found.keypoints is not None
    assert found.camera is not None
    assert found.sensor_map is not None
    assert demo.imus is not None
    assert demo.calibration is not None

    camera = read_camera(found.camera)
    np.testing.assert_allclose(camera.R_camera_world, demo.video.camera.R_camera_world, atol=1e-12)
    seen = read_detector_keypoints(found.keypoints, camera).keypoints
    np.testing.assert_allclose(seen.select(demo.video.names).uv_px, demo.video.uv_px, atol=1e-2)

    imus = imus_of_log(read_sensor_log(found.sensors))
    np.testing.assert_allclose(imus.times - imus.times[0], demo.imus.times - demo.imus.times[0], atol=2e-6)
    assert imus.times[0] - demo.imus.times[0] > 30  # a clock of their own
    assert so3.angle_between(imus.R_inertial_sensor, demo.imus.R_inertial_sensor).max() < 1e-6
    np.testing.assert_allclose(imus.f_sensor, demo.imus.f_sensor, atol=1e-4)
    places = read_sensor_map(found.sensor_map)
    joints = [known_segment(places[name], SkeletonModel.default()) for name in imus.names]
    assert joints == list(demo.calibration.select(demo.imus.names).joints)


def test_nothing_is_replaced_and_sensors_need_places(tmp_path: Path, demo: Recording) -> None:
    write_raw_files(replace(demo, imus=None, calibration=None), tmp_path / "take")
    assert not (tmp_path / "take" / "dots").exists()
    with pytest.raises(OutputExistsError):
        write_raw_files(demo, tmp_path / "take")
    with pytest.raises(InvalidInputError, match="places"):
        write_raw_files(replace(demo, calibration=None), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_the_demo_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--demo", "--only", "files", "-o", str(tmp_path / "take"), "--seconds", "1"]) == 0
    assert "rtof-kin run" in capsys.readouterr().out
    assert len(list((tmp_path / "take" / "dots").iterdir())) == 8
