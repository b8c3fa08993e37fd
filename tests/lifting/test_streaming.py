"""`StreamingLifter` gives frame by frame what `predict` gives of the whole, once later frames are there."""

from __future__ import annotations

from collections.abc import Sequence
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
def lifter() -> Lifter:
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


def frame(
    keypoints: KeypointSequence, t: int, imus: BoneImuSequence | None = None
) -> tuple[float, Array, Array, dict[str, Array]]:
    """What `push` takes of one frame."""
    R = {} if imus is None else dict(zip(imus.joints, imus.R_world_bone[t], strict=True))
    return float(keypoints.times[t]), keypoints.uv_px[t], keypoints.confidence[t], R


def streamed(
    streaming: StreamingLifter, keypoints: KeypointSequence, imus: BoneImuSequence | None = None
) -> list[tuple[StreamedPose | None, ...]]:
    """Every frame pushed, one after the other."""
    return [streaming.push(*frame(keypoints, t, imus)) for t in range(len(keypoints))]


def assert_same(poses: Sequence[StreamedPose | None], whole: LiftedPoses, least: int | None = None) -> None:
    """Each pose is that of the whole at its time, and there are enough of them."""
    found = [pose for pose in poses if pose is not None]
    for pose in found:
        t = int(np.argmin(np.abs(whole.times - pose.time)))
        assert pose.time == whole.times[t]
        assert whole.seen[t]
        np.testing.assert_allclose(pose.p_world_joint, whole.p_world_joint[t], atol=1e-5)
        np.testing.assert_allclose(pose.sigma_m, whole.sigma_m[t], atol=1e-5)
        np.testing.assert_allclose(pose.R_world_bone, whole.R_world_bone[t], atol=1e-4)
        np.testing.assert_allclose(pose.sigma_rad, whole.sigma_rad[t], atol=1e-4)
    assert len(found) >= (len(whole) // 2 if least is None else least)


@pytest.mark.parametrize("flip", [True, False])
def test_poses_with_a_complete_window_are_those_of_predict(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence, flip: bool
) -> None:
    streaming = StreamingLifter(lifter, camera, OFFSETS, 0.0, lookaheads=(0, 13, 20), flip=flip)
    assert streaming.delay_s == pytest.approx(13 / 60)
    newest, complete, older = zip(*streamed(streaming, keypoints, imus), strict=True)
    assert [pose.time for pose in newest] == keypoints.times.tolist()
    assert [pose is None for pose in complete] == [t < 13 for t in range(T)]
    whole = lifter.predict(keypoints, OFFSETS, bone_imus=imus, floor_height=0.0, flip=flip)
    assert_same(complete, whole, T - 13)
    assert_same(older, whole, T - 20)


def test_the_newest_frames_move_on_as_they_did(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    """A wrong guess of later frames would change the pose; of a person at rest there is none."""
    still = replace(keypoints, uv_px=np.broadcast_to(keypoints.uv_px[:1], keypoints.uv_px.shape))
    poses = [pose for (pose,) in streamed(StreamingLifter(lifter, camera, OFFSETS), still)]
    assert_same(poses, lifter.predict(still, OFFSETS), T)
    ((moving,),) = streamed(StreamingLifter(lifter, camera, OFFSETS), keypoints, imus)[-1:]
    repeated = lifter.predict(keypoints, OFFSETS, bone_imus=imus)
    assert moving is not None
    gap = np.abs(moving.p_world_joint - repeated.p_world_joint[-1]).max()
    assert 1e-4 < gap < 0.2


def test_late_and_replaced_frames_count_as_if_they_had_come_in_time(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    in_order, mixed = (StreamingLifter(lifter, camera, OFFSETS, lookaheads=(0, 5)) for _ in range(2))
    expected = streamed(in_order, keypoints[:60], imus)[-1]
    time, uv, confidence, R = frame(keypoints, 50, imus)
    for t in [*range(30), *range(33, 60)]:
        wrong = (time, uv + 40, confidence, R)
        mixed.put(*(wrong if t == 50 else frame(keypoints, t, imus)))
    for t in (32, 30, 31, 50):
        found = mixed.push(*frame(keypoints, t, imus))
    np.testing.assert_array_equal(mixed.times, in_order.times)
    for one, other in zip(found, expected, strict=True):
        assert one is not None
        assert other is not None
        assert one.time == other.time
        np.testing.assert_array_equal(one.p_world_joint, other.p_world_joint)


def test_poses_at_any_recent_times(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    streaming = StreamingLifter(lifter, camera, OFFSETS, history_s=0.6)
    streamed(streaming, keypoints, imus)
    newest = keypoints.times[-1]
    assert_same(streaming.lift(keypoints.times[-36:-13]), lifter.predict(keypoints, OFFSETS, bone_imus=imus), 23)
    between = streaming.lift([newest - 0.305, newest - 0.3])
    assert [pose.time for pose in between if pose] == [newest - 0.305, newest - 0.3]
    assert streaming.lift([]) == ()
    for wrong in (newest - 0.65, newest + 0.01, np.nan):
        with pytest.raises(InvalidInputError, match="times from"):
            streaming.lift([newest, wrong])


@pytest.mark.parametrize("rate_hz", [25.0, 50.0, 144.0, 240.0])
def test_any_frame_rate_and_jitter_give_the_same_as_predict(lifter: Lifter, camera: Camera, rate_hz: float) -> None:
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, T)
    keypoints = support.seen_by(camera, support.positions(0, T))
    keypoints = replace(keypoints, times=(np.arange(T) + jitter) / rate_hz)
    later = int(np.ceil(0.22 * rate_hz)) + 1
    streaming = StreamingLifter(lifter, camera, lookaheads=(0, later))
    newest, complete = zip(*streamed(streaming, keypoints), strict=True)
    assert None not in newest
    assert_same(complete, lifter.predict(keypoints), T - later)


def test_unseen_landmarks_lost_sensors_and_pauses_are_as_in_predict(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    rng = np.random.default_rng(1)
    confidence = (rng.uniform(size=(T, 21)) > 0.3).astype(float)
    times = keypoints.times + np.where(np.arange(T) >= 40, 3.0, 0.0)
    holes = replace(keypoints, confidence=confidence, times=times)
    R = np.array(imus.R_world_bone)
    R[rng.uniform(size=R.shape[:2]) < 0.3] = np.nan
    lost = replace(imus, R_world_bone=R, times=times)
    streaming = StreamingLifter(lifter, camera, OFFSETS, lookaheads=(0, 13))
    newest, complete = zip(*streamed(streaming, holes, lost), strict=True)
    assert None not in newest
    # For 13 frames after the pause the pose is older than the history.
    assert [pose is None for pose in complete] == [t < 13 or 40 <= t < 53 for t in range(T)]
    assert_same(complete, lifter.predict(holes, OFFSETS, bone_imus=lost))


def test_where_too_little_is_seen_there_is_no_pose(lifter: Lifter, camera: Camera, keypoints: KeypointSequence) -> None:
    confidence = np.ones((T, 21))
    confidence[:3] = confidence[20:60] = 0.0
    poses = streamed(StreamingLifter(lifter, camera), replace(keypoints, confidence=confidence))
    assert [pose is None for (pose,) in poses] == [t < 3 or 33 <= t < 60 for t in range(T)]


def test_memory_is_bounded(lifter: Lifter, camera: Camera, keypoints: KeypointSequence) -> None:
    streaming = StreamingLifter(lifter, camera, lookaheads=(13,))
    frames = 600
    turns = np.resize(np.arange(T), frames)
    long = KeypointSequence(
        camera, np.arange(frames) / 60, keypoints.uv_px[turns], keypoints.confidence[turns], keypoints.names
    )
    assert_same([pose for (pose,) in streamed(streaming, long)], lifter.predict(long), frames - 13)
    assert len(streaming.times) < 80
    fast = StreamingLifter(lifter, camera, history_s=0.1)
    for time in np.arange(2000) / 1000:
        fast.put(time, keypoints.uv_px[0], keypoints.confidence[0])
    assert len(fast.times) < 330


@pytest.mark.parametrize(
    ("push", "error", "message"),
    [
        ({"time": -0.1}, InvalidInputError, "time: -0.1 s, with frames up to 1 s"),
        ({"time": np.nan}, InvalidInputError, "time: nan s"),
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
    lifter: Lifter,
    camera: Camera,
    keypoints: KeypointSequence,
    push: dict[str, object],
    error: type[RtofError],
    message: str,
) -> None:
    frame = {"uv_px": keypoints.uv_px[0], "confidence": keypoints.confidence[0]}
    streaming, untouched = StreamingLifter(lifter, camera), StreamingLifter(lifter, camera)
    for each in (streaming, untouched):
        each.push(1.0, **frame)
    with pytest.raises(error, match=message):
        streaming.push(**({"time": 1.1} | frame | push))
    (one,), (other,) = (each.push(1.2, keypoints.uv_px[5], frame["confidence"]) for each in (streaming, untouched))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.p_world_joint, other.p_world_joint)


def test_wrong_settings_are_refused(lifter: Lifter, camera: Camera) -> None:
    with pytest.raises(InvalidInputError, match="5 of the landmarks are joints of the lifter"):
        StreamingLifter(lifter, camera, names=(*lifter.names[:5], "Nose"))
    with pytest.raises(InvalidInputError, match="below the floor"):
        StreamingLifter(lifter, camera, floor_height=2.0)
    with pytest.raises(InvalidInputError, match="not a human's"):
        StreamingLifter(lifter, camera, OFFSETS * 1000)
    with pytest.raises(InvalidInputError, match="not negative"):
        StreamingLifter(lifter, camera, lookaheads=(0, -1))
    with pytest.raises(InvalidInputError, match="not negative"):
        StreamingLifter(lifter, camera, history_s=-0.1)
