from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import lifting_support as support
import numpy as np
import planted
import pytest
import torch
from numpy.typing import NDArray

from lifting import predict as module
from lifting.checkpoint import save_checkpoint
from lifting.predict import LiftedPoses, Lifter
from lifting.source import Source
from lifting.threads import torch_threads
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.resources import LIFTERS, model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.simulation.simulate import SimulationSettings, simulate

Array = NDArray[np.float64]
EXCERPT = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"
T = 40
OFFSETS = support.TABLE.offsets


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture(scope="module")
def p_world_joint() -> Array:
    return support.positions(0, T)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return support.side_camera()


@pytest.fixture(scope="module")
def keypoints(camera: Camera, p_world_joint: Array) -> KeypointSequence:
    return support.seen_by(camera, p_world_joint)


@pytest.fixture(scope="module")
def lifted(lifter: Lifter, keypoints: KeypointSequence) -> LiftedPoses:
    return lifter.predict(keypoints, OFFSETS)


def hidden(keypoints: KeypointSequence, frames: slice, joints: object = slice(None)) -> KeypointSequence:
    """Keypoints with some unseen."""
    confidence = keypoints.confidence.copy()
    confidence[frames, joints] = 0.0
    return replace(keypoints, confidence=confidence)


def assert_close(a: LiftedPoses, p: Array, atol: float = 1e-4) -> None:
    np.testing.assert_allclose(a.p_world_joint, p, atol=atol)


# --- what must not matter ------------------------------------------------------------------------


def test_the_answer_turns_with_the_world(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    R, t = so3.about_axis("z", 1.9), np.array([3.0, -2.0, 0.5])
    R_camera = camera.R_camera_world @ R.T
    elsewhere = Camera(
        camera.K, R_camera, camera.t_camera_world - R_camera @ t, camera.width_px, camera.height_px
    )
    turned = lifter.predict(replace(keypoints, camera=elsewhere), OFFSETS)
    assert_close(turned, lifted.p_world_joint @ R.T + t)


@pytest.mark.parametrize("factor", [0.5, 1.7])
def test_the_focal_length_does_not_matter(
    lifter: Lifter, camera: Camera, p_world_joint: Array, lifted: LiftedPoses, factor: float
) -> None:
    K = camera.K * np.array([[factor], [factor], [1.0]])
    zoomed = replace(camera, K=K)
    assert_close(lifter.predict(support.seen_by(zoomed, p_world_joint), OFFSETS), lifted.p_world_joint)


def test_where_the_camera_looks_does_not_matter(
    lifter: Lifter, camera: Camera, p_world_joint: Array, lifted: LiftedPoses
) -> None:
    R = so3.exp([0.1, -0.25, 0.6]) @ camera.R_camera_world  # pan, tilt and roll on the spot
    turned = Camera(camera.K, R, -R @ camera.center_world, camera.width_px, camera.height_px)
    assert_close(lifter.predict(support.seen_by(turned, p_world_joint), OFFSETS), lifted.p_world_joint)


def test_distortion_is_taken_out(
    lifter: Lifter, camera: Camera, p_world_joint: Array, lifted: LiftedPoses
) -> None:
    bent = replace(camera, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))
    assert_close(lifter.predict(support.seen_by(bent, p_world_joint), OFFSETS), lifted.p_world_joint, 1e-3)


def test_a_lean_of_the_camera_that_is_not_told_does_matter(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    R = so3.about_axis("x", 0.3) @ camera.R_camera_world
    wrong = Camera(camera.K, R, -R @ camera.center_world, camera.width_px, camera.height_px)
    changed = lifter.predict(replace(keypoints, camera=wrong), OFFSETS)
    assert np.abs(changed.p_world_joint - lifted.p_world_joint).max() > 0.1


def test_the_order_of_landmarks_and_unknown_ones_do_not_matter(
    lifter: Lifter, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    order = list(reversed(keypoints.names))
    shuffled = keypoints.select([*order, "LeftEar", "Tail"])
    assert_close(lifter.predict(shuffled, OFFSETS), lifted.p_world_joint, 1e-9)


def test_mirrored_scenes_have_mirrored_answers(lifter: Lifter, p_world_joint: Array) -> None:
    body, flip = lifter.description.body, np.array([1.0, -1.0, 1.0])
    left = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
    right = Camera.looking_at([4.0, -1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
    mirrored = (p_world_joint * flip)[:, body.mirrored]
    here = lifter.predict(support.seen_by(left, p_world_joint), OFFSETS)
    there = lifter.predict(support.seen_by(right, mirrored), OFFSETS)
    assert_close(there, (here.p_world_joint * flip)[:, body.mirrored])
    plain = lifter.predict(support.seen_by(right, mirrored), OFFSETS, flip=False)
    one = lifter.predict(support.seen_by(left, p_world_joint), OFFSETS, flip=False)
    assert np.abs(plain.p_world_joint - (one.p_world_joint * flip)[:, body.mirrored]).max() > 1e-3


def test_chunks_and_threads_do_not_matter(
    lifter: Lifter, keypoints: KeypointSequence, lifted: LiftedPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CHUNK", 7)
    told: list[tuple[int, int]] = []
    with torch_threads(2):
        again = lifter.predict(keypoints, OFFSETS, lambda done, total: told.append((done, total)))
        assert torch.get_num_threads() == 2
    assert_close(again, lifted.p_world_joint, 1e-5)
    assert told == [(7, 40), (14, 40), (21, 40), (28, 40), (35, 40), (40, 40)]


def test_equal_calls_give_equal_answers(
    lifter: Lifter, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    assert np.array_equal(lifter.predict(keypoints, OFFSETS).p_world_joint, lifted.p_world_joint)


# --- time ----------------------------------------------------------------------------------------


def test_each_frame_sees_its_window_alone(
    lifter: Lifter, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    part = lifter.predict(keypoints[5:35], OFFSETS)
    np.testing.assert_allclose(part.p_world_joint[13:17], lifted.p_world_joint[18:22], atol=1e-5)
    assert np.abs(part.p_world_joint[0] - lifted.p_world_joint[5]).max() > 1e-5


@pytest.mark.parametrize("rate_hz", [25.0, 30.0, 50.0, 120.0])
def test_other_rates_give_the_same_motion(lifter: Lifter, camera: Camera, rate_hz: float) -> None:
    """A landmark that crosses the image evenly is the same at every rate."""
    p = support.positions(0, 1)[0]

    def at(times: Array) -> KeypointSequence:
        uv = camera.project(p) + times[:, None, None] * np.array([60.0, -20.0])
        return KeypointSequence(camera, times, uv, np.ones(uv.shape[:2]), support.TABLE.names)

    fine = lifter.predict(at(np.arange(241) / 60))
    other = lifter.predict(at(np.arange(int(4 * rate_hz) + 1) / rate_hz))
    assert len(other) == int(4 * rate_hz) + 1
    for second in (1, 2, 3):
        np.testing.assert_allclose(
            other.p_world_joint[round(second * rate_hz)], fine.p_world_joint[60 * second], atol=2e-3
        )


def test_uneven_times_and_single_frames_are_lifted(lifter: Lifter, keypoints: KeypointSequence) -> None:
    jitter = np.random.default_rng(0).uniform(-0.005, 0.005, T)
    uneven = lifter.predict(replace(keypoints, times=keypoints.times + jitter), OFFSETS)
    assert np.isfinite(uneven.p_world_joint).all()
    assert uneven.seen.all()
    for few in (1, 2, 3):
        short = lifter.predict(keypoints[:few], OFFSETS, smooth=True)
        assert short.p_world_joint.shape == (few, 21, 3)
        assert np.isfinite(short.p_world_joint).all()


def test_smoothing_is_without_delay_and_removes_jitter(
    lifter: Lifter, camera: Camera, p_world_joint: Array
) -> None:
    noise = np.random.default_rng(0).normal(scale=4.0, size=(T, 21, 2))
    noisy = support.seen_by(camera, p_world_joint)
    noisy = replace(noisy, uv_px=noisy.uv_px + noise)
    raw, smooth = lifter.predict(noisy), lifter.predict(noisy, smooth=True)
    jitter = [np.abs(np.diff(r.p_world_joint, n=3, axis=0)).mean() for r in (raw, smooth)]
    assert jitter[1] < 0.3 * jitter[0]
    mean = raw.p_world_joint[10:30].mean(axis=0) - smooth.p_world_joint[10:30].mean(axis=0)
    assert np.abs(mean).max() < 0.02


# --- what is not seen ----------------------------------------------------------------------------


def test_long_gaps_are_bridged_and_say_so(lifter: Lifter, camera: Camera) -> None:
    p = support.positions(0, 160)
    gap = hidden(support.seen_by(camera, p), slice(50, 110))
    result = lifter.predict(gap, OFFSETS)
    assert np.isfinite(result.p_world_joint).all()
    assert not result.seen[64:96].any()
    assert result.seen[:50].all()
    assert result.seen[110:].all()
    first, last = np.flatnonzero(~result.seen)[[0, -1]]
    between = result.p_world_joint[first - 1 : last + 2]
    share = np.linspace(0, 1, len(between))[:, None, None]
    np.testing.assert_allclose(between, (1 - share) * between[0] + share * between[-1], atol=1e-9)


def test_ends_that_are_not_seen_are_held(lifter: Lifter, camera: Camera) -> None:
    keypoints = hidden(support.seen_by(camera, support.positions(0, 80)), slice(40, 80))
    result = lifter.predict(keypoints, OFFSETS)
    last = np.flatnonzero(result.seen)[-1]
    assert 40 <= last < 54
    assert np.array_equal(
        result.p_world_joint[last:], np.repeat(result.p_world_joint[last : last + 1], 80 - last, 0)
    )


def test_pauses_of_the_video_are_not_interpolated_across(lifter: Lifter, keypoints: KeypointSequence) -> None:
    times = keypoints.times + np.where(np.arange(T) >= 20, 30.0, 0.0)
    paused = lifter.predict(replace(keypoints, times=times), OFFSETS)
    before = lifter.predict(hidden(keypoints, slice(20, T)), OFFSETS)
    np.testing.assert_allclose(paused.p_world_joint[10], before.p_world_joint[10], atol=1e-5)


def test_detectors_without_some_joints_are_lifted_with_those_there_are(
    lifter: Lifter, keypoints: KeypointSequence
) -> None:
    coco = [n for n in keypoints.names if n.endswith(("Arm", "Hand", "Leg", "Foot", "Head"))]
    result = lifter.predict(keypoints.select(coco), OFFSETS)
    assert result.p_world_joint.shape == (T, 21, 3)
    assert result.seen.all()
    masked = hidden(keypoints, slice(None), [n not in coco for n in keypoints.names])
    assert_close(result, lifter.predict(masked, OFFSETS).p_world_joint, 1e-9)


def test_too_few_joints_are_refused_by_name(lifter: Lifter, keypoints: KeypointSequence) -> None:
    few = keypoints.select([*keypoints.names[:5], "Nose", "LeftEye"])
    with pytest.raises(ShapeError, match=r"at least 6 joints .* sees 5 \(Hips, Spine, .*adapter"):
        lifter.predict(few)
    nothing = hidden(keypoints, slice(None))
    with pytest.raises(ShapeError, match="nobody was seen in any frame"):
        lifter.predict(nothing)


def test_joints_that_are_never_seen_together_are_refused(lifter: Lifter, keypoints: KeypointSequence) -> None:
    confidence = np.zeros((300, 21))
    for j in range(7):
        confidence[40 * j, j] = 1.0
    scattered = KeypointSequence(
        keypoints.camera, np.arange(300) / 60, np.resize(keypoints.uv_px, (300, 21, 2)),
        confidence, keypoints.names,
    )  # fmt: skip
    with pytest.raises(ShapeError, match="in no window are 6 joints seen"):
        lifter.predict(scattered)


@pytest.mark.parametrize("seed", range(5))
def test_hostile_landmarks_never_give_nan(lifter: Lifter, camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.normal(scale=10.0 ** rng.uniform(0, 6), size=(30, 21, 2))
    if seed == 0:
        uv[:] = 500.0  # everything in one point
    confidence = (rng.uniform(size=(30, 21)) > 0.7).astype(float)
    confidence[0] = 1.0
    keypoints = KeypointSequence(camera, np.arange(30) / 60, uv, confidence, support.TABLE.names)
    result = lifter.predict(keypoints, smooth=True)
    assert np.isfinite(result.p_world_joint).all()
    assert not np.isnan(result.seen).any()


def test_a_camera_that_looks_straight_down_is_no_obstacle(lifter: Lifter, p_world_joint: Array) -> None:
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    above = Camera(np.diag([1250.0, 1250.0, 1.0]), R, -R @ np.array([0.0, 0.0, 6.0]), 1920, 1080)
    assert np.isfinite(lifter.predict(support.seen_by(above, p_world_joint)).p_world_joint).all()


# --- options -------------------------------------------------------------------------------------


def test_bones_and_floor_are_read_when_given(
    lifter: Lifter, keypoints: KeypointSequence, lifted: LiftedPoses
) -> None:
    for other in (
        lifter.predict(keypoints),
        lifter.predict(keypoints, OFFSETS * 1.2),
        lifter.predict(keypoints, OFFSETS, floor_height=0.0),
    ):
        assert np.abs(other.p_world_joint - lifted.p_world_joint).max() > 1e-3


@pytest.mark.parametrize(
    ("offsets", "message"),
    [
        (OFFSETS[:20], r"joint_offsets: expected shape \(21, 3\), got \(20, 3\)"),
        (OFFSETS * 1000, "are no human's; give metres"),
        (OFFSETS * 0, "are no human's"),
        (OFFSETS * np.nan, "are no human's"),
        ("wide", "not an array of numbers"),
    ],
)
def test_offsets_that_are_no_humans_are_refused(
    lifter: Lifter, keypoints: KeypointSequence, offsets: object, message: str
) -> None:
    with pytest.raises(ShapeError, match=message):
        lifter.predict(keypoints, offsets)


def test_a_floor_above_the_camera_is_refused(lifter: Lifter, keypoints: KeypointSequence) -> None:
    with pytest.raises(InvalidInputError, match="the camera is 0.50 m below the floor"):
        lifter.predict(keypoints, floor_height=2.0)


def test_results_are_read_only_and_float64(lifted: LiftedPoses) -> None:
    assert lifted.p_world_joint.dtype == np.float64
    assert lifted.seen.dtype == np.bool_
    with pytest.raises(ValueError, match="read-only"):
        lifted.p_world_joint[0, 0, 0] = 1.0


def test_the_shipped_lifter_lifts_a_scene_it_has_not_seen(camera: Camera) -> None:
    clip = read_mocap(EXCERPT)
    p = clip.poses.p_world_joint - clip.poses.p_world_joint[:1, :1] * np.array([1.0, 1.0, 0.0])
    lifted = Lifter.load().predict(support.seen_by(camera, p), clip.joint_offsets)
    error = lifted.p_world_joint - p
    assert np.linalg.norm(error - error[:, :1], axis=-1).mean() < 0.08
    assert np.linalg.norm(error, axis=-1).mean() < 0.25


def test_a_lifter_knows_the_hash_of_its_file(lifter: Lifter, tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path / "lifter.pt", lifter._network, lifter.description)
    assert Lifter.load(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert len(Lifter.load().sha256) == 64
    assert Lifter.load().sha256 != Lifter.load(path).sha256
    assert lifter.sha256 == ""


# --- another skeleton ----------------------------------------------------------------------------


def recording_of_17(frames: int = 60) -> Recording:
    """Somebody with Human3.6M's joints at 50 Hz, seen without error."""
    skeleton = SkeletonModel.named("human36m")
    poses = planted.moving(skeleton, frames).poses
    poses = replace(poses, times=np.arange(frames) / 50)
    settings = replace(SimulationSettings.perfect(), sensors=())
    return simulate(poses, skeleton.joint_offsets, camera=support.side_camera(), settings=settings,
                    seed=0, skeleton=skeleton)  # fmt: skip


def test_a_lifter_of_17_joints_reconstructs_through_the_pipeline() -> None:
    recording = recording_of_17(frames=24)
    lifter = support.untrained_lifter(table=support.TABLE_17, rate_hz=50.0)
    settings = ReconstructionSettings(frames=12)
    result = reconstruct(recording, mode="rto", lifter=lifter, settings=settings)
    assert recording.skeleton_table == "human36m"
    assert result.motion.poses.names == support.TABLE_17.names
    assert np.isfinite(result.motion.poses.p_world_joint).all()
    assert result.stages["lift"].valid.all()


def test_at_the_rate_of_the_lifter_frames_are_taken_as_they_are() -> None:
    keypoints = recording_of_17().keypoints
    lifter = support.untrained_lifter(table=support.TABLE_17, rate_hz=50.0)
    source = Source.of(lifter.description.body, keypoints, None)
    windows = source.windows(keypoints.times[20:40], 27, 13, 50.0, np.full(30, np.nan), np.nan)
    rays = windows.rays_world.permute(0, 2, 3, 1).numpy()
    np.testing.assert_array_equal(rays[:, 13], source.rays[20:40])
    np.testing.assert_array_equal(rays[13:, 0], source.rays[20:27])
    at_60 = support.untrained_lifter(table=support.TABLE_17).predict(keypoints)
    assert np.abs(at_60.p_world_joint - lifter.predict(keypoints).p_world_joint).max() > 1e-6


def test_a_lifter_of_other_joints_says_what_to_do() -> None:
    with pytest.raises(ShapeError, match=r"sees 3 \(Spine, Neck, Head\).*trained for these joints"):
        reconstruct(recording_of_17(), mode="lift", lifter=support.untrained_lifter())


def test_a_lifter_that_is_not_there_is_reported(tmp_path: Path) -> None:
    shipped = "or the name of a shipped one: detections, perfect, causal"
    with pytest.raises(FileFormatError, match=f"no such file; .*{shipped}"):
        Lifter.load(tmp_path / "none.pt")


@pytest.mark.parametrize("name", list(LIFTERS))
def test_shipped_lifters_have_names(name: str) -> None:
    lifter = Lifter.load(name)
    assert lifter.description.network.causal == (name == "causal")
    assert (lifter.description.recipe["augment"]["noise"]["clean"] == 1.0) == (name == "perfect")
    assert lifter.sha256 == Lifter.load(model_path(LIFTERS[name])).sha256
