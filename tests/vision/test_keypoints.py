"""From a detector's file to a recording: real detections, any layout, the right person, clear errors."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS, flat, landmarks_px, points_px, walking, watching

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections, read_detector_keypoints

REAL = Path(__file__).parents[1] / "fixtures" / "detectors" / "two_people"
REAL_CAMERA = Camera(
    np.array([[1681.0, 0, 533], [0, 1681.0, 948], [0, 0, 1]]), np.eye(3), np.zeros(3), 1088, 1920
)
CAMERA = """
[camera]
width_px = 1920
height_px = 1080
focal_px = 1250.0
position_m = [4.0, 0.0, 1.5]
target_m = [0.0, 0.0, 1.0]
"""


@pytest.fixture(scope="module")
def motion() -> MotionSequence:
    return walking()


@pytest.fixture(scope="module")
def camera(motion: MotionSequence) -> Camera:
    return watching(motion)


def written(folder: Path, layout: str, motion: MotionSequence, camera: Camera) -> Path:
    """OpenPose-like JSON of one person."""
    uv = points_px(layout, motion, camera)
    path = folder / "found.json"
    path.write_text(json.dumps([{"people": [{"pose_keypoints_2d": flat(p)}]} for p in uv]))
    return path


def recording(folder: Path, keypoints: str) -> Path:
    text = f"schema_version = 1\n{CAMERA}\n[keypoints]\n{keypoints}\n"
    (folder / "recording.toml").write_text(text)
    return folder


# --- real detections -----------------------------------------------------------------------------


def test_real_detections_of_two_people_give_one_persons_joints() -> None:
    found = read_detector_keypoints(REAL, REAL_CAMERA, rate_hz=60.0)
    assert found.recognition.layout.name == "body25b"
    assert found.track.people >= 2
    assert not found.track.lost.any()
    assert len(set(found.track.person.tolist())) > 1  # the detector changes their order
    keypoints = found.keypoints
    np.testing.assert_allclose(keypoints.times, np.arange(8) / 60)
    at = {name: keypoints.uv_px[:, i] for i, name in enumerate(keypoints.names)}
    assert keypoints.seen.all(axis=0)[:21].all()
    step = np.linalg.norm(np.diff(keypoints.uv_px[:, :21], axis=0), axis=-1)
    assert np.median(step) < 10  # px from frame to frame, of somebody about 1000 px tall
    trunk = at["Neck"] - at["Hips"]
    assert np.all(trunk[:, 1] < -150)
    for lower, upper in (("Spine", "Hips"), ("Spine2", "Spine"), ("Neck", "Spine3"), ("Head", "Neck")):
        assert np.all(at[lower][:, 1] < at[upper][:, 1] + 5)
    said = "layout body25b, OpenPose BODY_25B: confirmed by geometry"
    assert found.summary.startswith(said)
    assert "people; followed the one who is number" in found.summary


def test_the_other_person_can_be_asked_for() -> None:
    first = read_detector_keypoints(REAL, REAL_CAMERA, rate_hz=60.0)
    other = next(p for p in range(3) if p != first.track.person[0])
    second = read_detector_keypoints(REAL, REAL_CAMERA, rate_hz=60.0, person=other, frame=0)
    assert second.track.person[0] == other
    both = ~(first.track.lost | second.track.lost)
    assert np.all(first.track.person[both] != second.track.person[both])
    assert f"asked for: person {other} in frame 0" in second.summary


# --- recordings ----------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("named", [True, False])
def test_a_recording_names_a_detectors_file(
    layout: str, named: bool, tmp_path: Path, motion: MotionSequence
) -> None:
    camera = Camera.looking_at([4.0, 0.0, 1.5], [0.0, 0.0, 1.0], 1250.0)
    here = motion.skeleton.motion(motion.poses)
    moved = here.poses.p_world_joint - here.poses.p_world_joint[:1, :1] * [1, 1, 0]
    here = motion.skeleton.motion(motion.poses.with_poses(slice(None), moved))
    written(tmp_path, layout, here, camera)
    said = layout if named else "auto"
    text = f'file = "found.json"\nlayout = "{said}"\nrate_hz = 30.0\nstart_s = 2.0'
    loaded = Recording.load(recording(tmp_path, text))
    names = loaded.keypoints.names
    assert names[:21] == motion.skeleton.names
    truth = landmarks_px(names, here, camera)
    error = np.linalg.norm(loaded.keypoints.uv_px - truth, axis=-1)[loaded.keypoints.seen]
    assert error.mean() < 6.0
    np.testing.assert_allclose(loaded.keypoints.times, 2.0 + np.arange(len(truth)) / 30)
    loaded.save(tmp_path / "copy")
    again = Recording.load(tmp_path / "copy")
    np.testing.assert_array_equal(again.keypoints.uv_px, loaded.keypoints.uv_px)


def test_a_folder_of_real_detections_is_a_recording_and_says_whom_it_follows(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "two_people"
    folder.mkdir()
    for path in REAL.glob("*.json"):
        (folder / path.name).write_bytes(path.read_bytes())
    text = 'file = "two_people"\nlayout = "body25b"\nrate_hz = 60.0\nperson = 1\nframe = 3'
    with caplog.at_level(logging.INFO):
        loaded = Recording.load(recording(tmp_path, text))
    assert loaded.keypoints.names[0] == "Hips"
    (record,) = [r for r in caplog.records if "followed" in r.message]
    assert record.levelno == logging.WARNING
    assert "asked for: person 1 in frame 3" in record.message


@pytest.mark.parametrize(
    "text, error, message",
    [
        ('layout = "coco"', FileFormatError, r"\[keypoints\] layout: 'coco' is not known"),
        ('layout = "coco17"', FileFormatError, "has no times; give rate_hz"),
        ('layout = "halpe26"\nrate_hz = 30', FileFormatError, "halpe26 has 26 points, but there are 17"),
        ('layout = "human36m17"\nrate_hz = 30', FileFormatError, "as those of coco17 do"),
        ('layout = "coco17"\nrate_hz = 30\nperson = 3', FileFormatError, "there is no such person"),
        ('layout = "coco17"\nrate_hz = 30\npersn = 3', UnknownNameError, "Did you mean 'person'"),
        ('layout = "coco17"\nlandmarks = ["Nose"]', FileFormatError, "stands beside landmarks"),
        ('layout = "coco17"\nrate_hz = 0', FileFormatError, "give rate_hz, the video's"),
    ],
)  # fmt: skip
def test_a_wrong_layout_is_a_clear_error(
    text: str, error: type[Exception], message: str, tmp_path: Path, motion: MotionSequence, camera: Camera
) -> None:
    written(tmp_path, "coco17", motion, camera)
    with pytest.raises(error, match=message):
        Recording.load(recording(tmp_path, f'file = "found.json"\n{text}'))


def test_a_detectors_layout_is_for_the_21_joints(
    tmp_path: Path, motion: MotionSequence, camera: Camera
) -> None:
    written(tmp_path, "human36m17", motion, camera)
    folder = recording(tmp_path, 'file = "found.json"\nlayout = "human36m17"\nrate_hz = 30')
    path = folder / "recording.toml"
    path.write_text(path.read_text() + '[skeleton]\ntable = "human36m"\n')
    with pytest.raises(FileFormatError, match="for the skeleton total_capture, not human36m.*'joints'"):
        Recording.load(folder)


def test_columns_named_as_landmarks_need_no_layout(tmp_path: Path) -> None:
    (tmp_path / "k.csv").write_text("time,Hips_u_px,Hips_v_px\n0,5,5\n")
    assert Recording.load(recording(tmp_path, 'file = "k.csv"')).keypoints.names == ("Hips",)
    with pytest.raises(FileFormatError, match="layout: a .csv names its points itself"):
        Recording.load(recording(tmp_path, 'file = "k.csv"\nlayout = "joints"'))


def test_a_file_outside_of_the_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="leads out of the folder"):
        Recording.load(recording(tmp_path, 'file = "../found.json"\nlayout = "auto"\nrate_hz = 30'))


# --- bad input -----------------------------------------------------------------------------------


def test_all_confidences_zero_is_a_clear_error(motion: MotionSequence, camera: Camera) -> None:
    uv = points_px("coco17", motion, camera)[:, None]
    with pytest.raises(ShapeError, match="nowhere are more than 0 of 17 points seen"):
        keypoints_from_detections(Detections(uv, np.zeros(uv.shape[:3])), motion.times, camera, "coco17")


def test_a_landmark_never_seen_is_unseen_and_its_neighbours_are_not(
    motion: MotionSequence, camera: Camera
) -> None:
    uv = points_px("coco17", motion, camera)[:, None]
    confidence = np.full(uv.shape[:3], 0.9)
    confidence[..., 15] = 0.0  # the left ankle
    found = keypoints_from_detections(Detections(uv, confidence), motion.times, camera)
    seen = dict(zip(found.keypoints.names, found.keypoints.seen.T, strict=True))
    assert not seen["LeftFoot"].any()
    assert seen["LeftLeg"].all()
    assert seen["RightFoot"].all()


def test_points_outside_of_the_cameras_image_mean_another_camera(
    motion: MotionSequence, camera: Camera
) -> None:
    uv = 3 * points_px("coco17", motion, camera)[:, None]
    with pytest.raises(ShapeError, match="% of the points lie outside of the camera's image of 1920 x 1080"):
        keypoints_from_detections(Detections(uv, np.ones(uv.shape[:3])), motion.times, camera)


def test_times_and_a_rate_contradict_each_other(
    tmp_path: Path, motion: MotionSequence, camera: Camera
) -> None:
    uv = points_px("coco17", motion, camera)
    np.savez(tmp_path / "p.npz", uv_px=uv, times=motion.times)
    found = read_detector_keypoints(tmp_path / "p.npz", camera, start=1.0)
    np.testing.assert_allclose(found.keypoints.times, motion.times + 1.0)
    with pytest.raises(FileFormatError, match="has times of its own; leave rate_hz out"):
        read_detector_keypoints(tmp_path / "p.npz", camera, rate_hz=30.0)


def test_where_the_person_was_lost_is_said(motion: MotionSequence, camera: Camera) -> None:
    uv = points_px("coco17", motion, camera)[:, None]
    confidence = np.full(uv.shape[:3], 0.9)
    confidence[10:14] = confidence[20] = 0.0
    found = keypoints_from_detections(Detections(uv, confidence), motion.times, camera)
    assert found.summary.endswith("lost in 5 of 50 frames (10-13, 20)")
    assert not found.keypoints.seen[11].any()
