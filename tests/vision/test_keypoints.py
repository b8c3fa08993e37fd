"""Keypoints of one person from a detector's file: real detections, any layout, recordings, errors."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS, flat, landmarks_px, points_px, walking, watching

from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections, read_detector_keypoints
from rtof_kin.vision.layouts import detector_table

REAL = Path(__file__).parents[1] / "fixtures" / "detectors" / "two_people"
K = np.array([[1681.0, 0, 533], [0, 1681.0, 948], [0, 0, 1]])
REAL_CAMERA = Camera(K, np.eye(3), np.zeros(3), 1088, 1920)
MOTION = walking()
CAMERA = watching(MOTION)
COCO = points_px("coco17", MOTION, CAMERA)
TOML = """schema_version = 1
[camera]
width_px = 1920
height_px = 1080
focal_px = 1250.0
position_m = [4.0, 0.0, 1.5]
target_m = [0.0, 0.0, 1.0]
[keypoints]
"""


def written(folder: Path, uv: np.ndarray) -> None:
    """OpenPose-like JSON of one person."""
    frames = [{"people": [{"pose_keypoints_2d": flat(p)}]} for p in uv]
    (folder / "found.json").write_text(json.dumps(frames))


def recording(folder: Path, keypoints: str) -> Path:
    (folder / "recording.toml").write_text(TOML + keypoints + "\n")
    return folder


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
    assert np.median(step) < 10  # px per frame, for a person of about 1000 px
    assert np.all((at["Neck"] - at["Hips"])[:, 1] < -150)
    for upper, lower in (("Spine", "Hips"), ("Spine2", "Spine"), ("Neck", "Spine3"), ("Head", "Neck")):
        assert np.all(at[upper][:, 1] < at[lower][:, 1] + 5)
    assert found.summary.startswith("layout body25b, OpenPose BODY_25B: confirmed by geometry")
    other = next(p for p in range(3) if p != found.track.person[0])
    second = read_detector_keypoints(REAL, REAL_CAMERA, rate_hz=60.0, person=other, frame=0)
    assert second.track.person[0] == other
    both = ~(found.track.lost | second.track.lost)
    assert np.all(found.track.person[both] != second.track.person[both])
    assert f"person {other + 1} in frame 0" in second.summary


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("named", [False, True])
def test_a_recording_reads_a_detectors_file(layout: str, named: bool, tmp_path: Path) -> None:
    camera = Camera.looking_at([4.0, 0.0, 1.5], [0.0, 0.0, 1.0], 1250.0)
    p = MOTION.poses.p_world_joint
    here = MOTION.skeleton.motion(MOTION.poses.with_poses(slice(None), p - p[:1, :1] * [1, 1, 0]))
    written(tmp_path, points_px(layout, here, camera))
    text = f'layout = "{layout if named else "auto"}"\nrate_hz = 30.0\nstart_s = 2.0'
    keypoints = Recording.load(recording(tmp_path, f'file = "found.json"\n{text}')).keypoints
    assert keypoints.names[:21] == MOTION.skeleton.names
    landmarks, raw = keypoints.landmarks, keypoints.select([n for n in keypoints.names if ":" in n])
    truth = landmarks_px(landmarks.names, here, camera)
    error = np.linalg.norm(landmarks.uv_px - truth, axis=-1)[landmarks.seen]
    assert error.mean() < 6.0
    exact = points_px(layout, here, camera)
    assert raw.names == tuple(f"{layout}:{point}" for point in detector_table().layout(layout).points)
    np.testing.assert_allclose(raw.uv_px[raw.seen], exact[raw.seen], atol=1e-3)  # rounded in the file
    assert raw.seen.all()
    np.testing.assert_allclose(keypoints.times, 2.0 + np.arange(len(truth)) / 30)


def test_loading_a_recording_logs_the_tracked_person(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.copytree(REAL, tmp_path / "two_people")
    text = 'file = "two_people"\nlayout = "body25b"\nrate_hz = 60.0\nperson = 1\nframe = 3'
    with caplog.at_level(logging.INFO):
        loaded = Recording.load(recording(tmp_path, text))
    assert loaded.keypoints.names[0] == "Hips"
    (record,) = [r for r in caplog.records if "followed" in r.message]
    assert record.levelno == logging.INFO  # as the person was told
    assert "person 2 in frame 3" in record.message
    loaded.save(tmp_path / "copy")
    again = Recording.load(tmp_path / "copy")
    np.testing.assert_array_equal(again.keypoints.uv_px, loaded.keypoints.uv_px)


@pytest.mark.parametrize(
    "text, error, message",
    [
        ('layout = "coco"', FileFormatError, r"\[keypoints\] layout: 'coco'"),
        ('layout = "coco17"', FileFormatError, "no times; give rate_hz"),
        ('layout = "halpe26"\nrate_hz = 30', FileFormatError, "halpe26 has 26 points"),
        ('layout = "human36m17"\nrate_hz = 30', FileFormatError, "as those of coco17"),
        ('layout = "coco17"\nrate_hz = 30\nperson = 3', FileFormatError, "no such person"),
        ('layout = "coco17"\nrate_hz = 30\npersn = 3', UnknownNameError, "Did you mean 'person'"),
        ('layout = "coco17"\nlandmarks = ["Nose"]', FileFormatError, "landmarks"),
        ('layout = "coco17"\nrate_hz = 0', FileFormatError, "rate_hz: 0 is not a positive number"),
        (
            'layout = "human36m17"\nrate_hz = 30\n[skeleton]\ntable = "human36m"',
            FileFormatError,
            "for the skeleton total_capture",
        ),
    ],
)
def test_wrong_fields_of_a_recording_are_refused(
    text: str, error: type[Exception], message: str, tmp_path: Path
) -> None:
    layout = "human36m17" if "table" in text else "coco17"
    written(tmp_path, points_px(layout, MOTION, CAMERA))
    with pytest.raises(error, match=message):
        Recording.load(recording(tmp_path, f'file = "found.json"\n{text}'))


def test_columns_named_as_landmarks_need_no_layout(tmp_path: Path) -> None:
    (tmp_path / "k.csv").write_text("time,Hips_u_px,Hips_v_px\n0,5,5\n")
    assert Recording.load(recording(tmp_path, 'file = "k.csv"')).keypoints.names == ("Hips",)
    with pytest.raises(FileFormatError, match=r"layout: a .csv"):
        Recording.load(recording(tmp_path, 'file = "k.csv"\nlayout = "joints"'))
    with pytest.raises(FileFormatError, match="out of the folder"):
        Recording.load(recording(tmp_path, 'file = "../found.json"\nlayout = "auto"\nrate_hz = 30'))


def test_landmarks_that_are_undetected_or_in_lost_frames_are_unobserved() -> None:
    confidence = np.full((50, 1, 17), 0.9)
    confidence[..., 15] = 0.0  # the left ankle
    confidence[10:14] = confidence[20] = 0.0
    found = keypoints_from_detections(Detections(COCO[:, None], confidence), MOTION.times, CAMERA)
    seen = dict(zip(found.keypoints.names, found.keypoints.seen.T, strict=True))
    assert not seen["LeftFoot"].any()
    lost = np.r_[10:14, 20]
    for name in ("LeftLeg", "RightFoot"):
        np.testing.assert_array_equal(np.flatnonzero(~seen[name]), lost)
    assert found.summary.endswith("lost in 5 of 50 frames (10-13, 20)")


def test_points_outside_of_the_image_are_refused() -> None:
    detections = Detections(3 * COCO[:, None], np.ones((50, 1, 17)))
    with pytest.raises(InvalidInputError, match="outside of the camera's image of 1920 x 1080"):
        keypoints_from_detections(detections, MOTION.times, CAMERA).keypoints  # noqa: B018


def test_a_file_has_either_times_or_a_rate(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", uv_px=COCO, times=MOTION.times)
    found = read_detector_keypoints(tmp_path / "p.npz", CAMERA, start=1.0)
    np.testing.assert_allclose(found.keypoints.times, MOTION.times + 1.0)
    with pytest.raises(FileFormatError, match="leave rate_hz out"):
        read_detector_keypoints(tmp_path / "p.npz", CAMERA, rate_hz=30.0)
