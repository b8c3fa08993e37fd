"""`StreamingLifter` gives frame by frame what `predict` gives of the whole."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
from numpy.typing import NDArray

from lifting.predict import LiftedPoses, Lifter
from lifting.streaming import StreamedPose, StreamingLifter
from rtof_kin.core.errors import InvalidInputError, RtofError, ShapeError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
T = 70
OFFSETS = support.TABLE.offsets
WORN = ("LeftForeArm", "RightForeArm", "Hips", "Spine3")


@pytest.fixture(scope="module")
def causal() -> Lifter:
    return support.untrained_lifter(causal=True)


@pytest.fixture(scope="module")
def centred() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture(scope="module")
def camera() -> Camera:
    return support.side_camera()


@pytest.fixture(scope="module")
def keypoints(camera: Camera) -> KeypointSequence:
    return support.seen_by(camera, support.positions(0, T))


@pytest.fixture(scope="module")
def imus() -> BoneImuSequence:
    return support.worn_by(0, T, WORN)


def streamed(
    streaming: StreamingLifter, keypoints: KeypointSequence, imus: BoneImuSequence | None = None
) -> list[StreamedPose | None]:
    """Every frame pushed, one after the other."""
    return [
        streaming.push(
            float(keypoints.times[t]),
            keypoints.uv_px[t],
            keypoints.confidence[t],
            None if imus is None else dict(zip(imus.joints, imus.R_world_bone[t], strict=True)),
        )
        for t in range(len(keypoints))
    ]


def assert_same(poses: list[StreamedPose | None], whole: LiftedPoses) -> None:
    """Each pose is that of the whole at its time."""
    found = 0
    for pose in poses:
        if pose is None:
            continue
        t = int(np.argmin(np.abs(whole.times - pose.time)))
        assert pose.time == whole.times[t]
        assert pose.seen == whole.seen[t]
        found += 1
        if not pose.seen:
            continue
        np.testing.assert_allclose(pose.p_world_joint, whole.p_world_joint[t], atol=1e-5)
        np.testing.assert_allclose(pose.sigma_m, whole.sigma_m[t], atol=1e-5)
        np.testing.assert_allclose(pose.R_world_bone, whole.R_world_bone[t], atol=1e-4)
        np.testing.assert_allclose(pose.sigma_rad, whole.sigma_rad[t], atol=1e-4)
    assert found >= len(whole) // 2


@pytest.mark.parametrize("flip", [True, False])
def test_a_causal_lifter_answers_every_frame_at_once_as_predict_does(
    causal: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence, flip: bool
) -> None:
    streaming = StreamingLifter(causal, camera, OFFSETS, 0.0, flip=flip)
    assert streaming.delay_s == 0.0
    poses = streamed(streaming, keypoints, imus)
    whole = causal.predict(keypoints, OFFSETS, bone_imus=imus, floor_height=0.0, flip=flip)
    assert [pose.time for pose in poses if pose is not None] == keypoints.times.tolist()
    assert_same(poses, whole)


def test_a_centred_lifter_answers_after_its_delay(
    centred: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    streaming = StreamingLifter(centred, camera, OFFSETS)
    assert streaming.delay_s == pytest.approx(13 / 60)
    poses = streamed(streaming, keypoints, imus)
    assert [pose is None for pose in poses] == [t < 13 for t in range(T)]
    for t, pose in enumerate(poses[13:]):
        assert pose is not None
        assert pose.time == keypoints.times[t]
    assert_same(poses, centred.predict(keypoints, OFFSETS, bone_imus=imus))


@pytest.mark.parametrize("frames", [1, 9, 40])
def test_flushing_gives_the_remaining_poses(
    centred: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence, frames: int
) -> None:
    streaming = StreamingLifter(centred, camera, OFFSETS)
    short, worn = support.seen_by(camera, support.positions(0, frames)), support.worn_by(0, frames, WORN)
    pushed = [pose for pose in streamed(streaming, short, worn) if pose is not None]
    owed = streaming.flush()
    assert len(owed) == min(13, frames)
    assert [pose.time for pose in pushed + owed] == short.times.tolist()
    assert_same([*pushed, *owed], centred.predict(short, OFFSETS, bone_imus=worn))
    assert streaming.flush() == []


@pytest.mark.parametrize("rate_hz", [25.0, 50.0, 144.0, 240.0])
@pytest.mark.parametrize("causal_one", [True, False])
def test_any_frame_rate_and_jitter_give_the_same_as_predict(
    causal: Lifter, centred: Lifter, camera: Camera, rate_hz: float, causal_one: bool
) -> None:
    lifter = causal if causal_one else centred
    moving = support.positions(0, T)
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, T)
    keypoints = support.seen_by(camera, moving)
    keypoints = replace(keypoints, times=(np.arange(T) + jitter) / rate_hz)
    poses = streamed(StreamingLifter(lifter, camera), keypoints)
    assert (None in poses) != causal_one
    answered = [pose.time for pose in poses if pose is not None]
    assert answered == sorted(set(answered))
    whole = lifter.predict(keypoints)
    for pose in poses:
        if pose is not None:
            t = keypoints.times.tolist().index(pose.time)
            np.testing.assert_allclose(pose.p_world_joint, whole.p_world_joint[t], atol=1e-5)


def test_unseen_landmarks_lost_sensors_and_pauses_are_as_in_predict(
    causal: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    rng = np.random.default_rng(1)
    confidence = (rng.uniform(size=(T, 21)) > 0.3).astype(float)
    times = keypoints.times + np.where(np.arange(T) >= 40, 3.0, 0.0)
    holes = replace(keypoints, confidence=confidence, times=times)
    R = np.array(imus.R_world_bone)
    R[rng.uniform(size=R.shape[:2]) < 0.3] = np.nan
    lost = replace(imus, R_world_bone=R, times=times)
    poses = streamed(StreamingLifter(causal, camera, OFFSETS), holes, lost)
    assert_same(poses, causal.predict(holes, OFFSETS, bone_imus=lost))


def test_where_too_little_is_seen_the_last_pose_is_repeated_and_marked(
    causal: Lifter, camera: Camera, keypoints: KeypointSequence
) -> None:
    confidence = np.ones((T, 21))
    confidence[:3] = confidence[20:60] = 0.0
    poses = streamed(StreamingLifter(causal, camera), replace(keypoints, confidence=confidence))
    assert poses[:3] == [None] * 3
    rest = [pose for pose in poses if pose is not None]
    assert len(rest) == T - 3
    assert [pose.seen for pose in rest] == [not 46 <= t < 60 for t in range(3, T)]
    held = rest[50]
    np.testing.assert_array_equal(held.p_world_joint, rest[42].p_world_joint)
    assert np.isnan(held.sigma_m).all()
    assert np.isnan(held.R_world_bone).all()
    assert np.isnan(held.sigma_rad).all()


def test_memory_is_bounded(causal: Lifter, camera: Camera, keypoints: KeypointSequence) -> None:
    small = StreamingLifter(causal, camera)
    frames = 600
    turns = np.resize(np.arange(T), frames)
    long = KeypointSequence(
        camera, np.arange(frames) / 60, keypoints.uv_px[turns], keypoints.confidence[turns],
        keypoints.names,
    )  # fmt: skip
    assert_same(streamed(small, long), causal.predict(long))
    assert len(small._frames) < 35
    fast = StreamingLifter(causal, camera)
    streamed(fast, replace(long, times=np.arange(frames) / 1000))
    assert len(fast._frames) < 460


@pytest.mark.parametrize(
    ("push", "error", "message"),
    [
        ({"time": 1.0}, InvalidInputError, "time: 1 s after a frame at 1 s"),
        ({"time": np.nan}, InvalidInputError, "time: nan s after"),
        ({"uv_px": np.zeros((20, 2))}, ShapeError, "uv_px: expected shape"),
        ({"confidence": np.ones(20)}, ShapeError, "confidence: expected shape"),
        ({"confidence": np.full(21, 2.0)}, InvalidInputError, "confidence: outside"),
        ({"uv_px": np.full((21, 2), np.inf)}, InvalidInputError, "uv_px: infinite"),
        ({"R_world_bone": {"LeftFoo": np.eye(3)}}, UnknownNameError, "Did you mean 'LeftFoot'"),
        ({"R_world_bone": {"Hips": np.eye(4)}}, ShapeError, r"R_world_bone: expected \(3, 3\)"),
        ({"R_world_bone": {"Hips": 2 * np.eye(3)}}, InvalidInputError, "R_world_bone of Hips: not a rot"),
    ],
)
def test_wrong_frames_are_refused_and_not_taken(
    causal: Lifter, camera: Camera, keypoints: KeypointSequence,
    push: dict[str, object], error: type[RtofError], message: str,
) -> None:  # fmt: skip
    frame = {"uv_px": keypoints.uv_px[0], "confidence": keypoints.confidence[0]}
    streaming, untouched = StreamingLifter(causal, camera), StreamingLifter(causal, camera)
    for each in (streaming, untouched):
        each.push(1.0, **frame)
    with pytest.raises(error, match=message):
        streaming.push(**({"time": 1.1} | frame | push))
    after = [each.push(1.2, keypoints.uv_px[5], frame["confidence"]) for each in (streaming, untouched)]
    assert after[0] is not None
    assert after[1] is not None
    np.testing.assert_array_equal(after[0].p_world_joint, after[1].p_world_joint)


def test_wrong_settings_are_refused(causal: Lifter, camera: Camera) -> None:
    with pytest.raises(InvalidInputError, match="5 of the landmarks are joints of the lifter"):
        StreamingLifter(causal, camera, names=(*causal.names[:5], "Nose"))
    with pytest.raises(InvalidInputError, match="below the floor"):
        StreamingLifter(causal, camera, floor_height=2.0)
    with pytest.raises(InvalidInputError, match="not a human's"):
        StreamingLifter(causal, camera, OFFSETS * 1000)
