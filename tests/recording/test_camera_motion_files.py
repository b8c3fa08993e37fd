"""Recordings of a camera that turns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.formats.camera_motion import write_camera_motion
from rtof_kin.formats.sensors.tables import phone_files, read_phone
from rtof_kin.inertial.orientation import HELD, motion_of_gyroscope
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording

T = 60
TIMES = np.arange(T) / 30
TEXT = """
schema_version = 1
[camera]
width_px = 1920
height_px = 1080
focal_px = 1250.0
position_m = [4.0, 0.6, 1.5]
target_m = [0.0, 0.0, 1.0]
{motion}
[keypoints]
file = "keypoints.npz"
rate_hz = 30.0
layout = "joints"
[notes]
text = "in the garden"
"""


def written(folder: Path, motion: str) -> Path:
    uv = np.random.default_rng(0).uniform(300, 900, (T, 21, 2))
    np.savez(folder / "keypoints.npz", uv_px=uv, confidence=np.ones((T, 21)))
    (folder / INDEX).write_text(TEXT.format(motion=motion))
    return folder


def turning(focal_px: float | None = None) -> CameraMotion:
    return CameraMotion(TIMES, so3.exp(0.2 * np.sin(TIMES)[:, None] * [0, 1.0, 0]), np.radians(0.1), focal_px=focal_px)


def test_keypoints_are_stabilised_on_load_and_a_saved_recording_keeps_them(tmp_path: Path) -> None:
    plain = Recording.load(written(tmp_path, "")).video
    write_camera_motion(tmp_path / "camera_motion.npz", turning().shifted(-2.0))
    written(tmp_path, '[camera.motion]\nfile = "camera_motion.npz"\nstart_s = 2.0')
    recording = Recording.load(tmp_path)
    expected = stabilised(plain, turning())
    np.testing.assert_allclose(recording.video.uv_px, expected.uv_px)
    assert recording.video.camera.stabilised
    assert "in the garden" in recording.notes
    assert "camera that stands still" in recording.notes
    assert "known to 0.10 deg" in recording.notes
    recording.save(tmp_path / "again")
    again = Recording.load(tmp_path / "again")
    assert again.video.camera.stabilised
    np.testing.assert_array_equal(again.video.uv_px, recording.video.uv_px)
    assert again.notes == recording.notes


def test_log_of_a_phone_is_a_motion_too(tmp_path: Path) -> None:
    times = np.arange(0, 2.2, 0.01)
    w = 0.3 * np.cos(3 * times)[:, None] * [0, 1.0, 0]
    f = np.tile([0, 9.81, 0], (len(times), 1))
    rows = (",".join(map(str, row)) for row in np.column_stack([times, w, f]))
    (tmp_path / "gyro.csv").write_text("\n".join(["time,wx,wy,wz,fx,fy,fz", *rows]))
    plain = Recording.load(written(tmp_path, "")).video
    found = Recording.load(written(tmp_path, '[camera.motion]\nfile = "gyro.csv"')).video
    stream = read_phone(phone_files(tmp_path / "gyro.csv")).streams[0]
    expected = stabilised(plain, motion_of_gyroscope(stream, HELD["portrait"]))
    np.testing.assert_allclose(found.uv_px, expected.uv_px)
    assert abs(found.camera.R_camera_world[2, 2]) < 0.01  # as level as the phone, not as declared


def test_other_focal_length_than_that_of_the_motion_is_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_camera_motion(tmp_path / "camera_motion.npz", turning(focal_px=1500.0))
    Recording.load(written(tmp_path, '[camera.motion]\nfile = "camera_motion.npz"'))
    assert "focal length of 1500 px, [camera] has 1250 px" in caplog.text


@pytest.mark.parametrize(
    "table, message",
    [
        ('file = "none.npz"', "there is no file"),
        ('file = "camera_motion.npz"\nstart_s = 60.0', "put it on their clock"),
        ('file = "gyro.csv"\nheld = "sideways"', "'sideways' is not one of portrait"),
        ('file = "camera_motion.npz"\nmagic = 1', "magic"),
    ],
)
def test_mistakes_name_the_field_or_the_file(table: str, message: str, tmp_path: Path) -> None:
    write_camera_motion(tmp_path / "camera_motion.npz", turning())
    (tmp_path / "gyro.csv").write_text("time,wx,wy,wz\n0,0,0,0\n1,0,0,0\n3,0,0,0\n")
    with pytest.raises((FileFormatError, KeyError), match=message):
        Recording.load(written(tmp_path, f"[camera.motion]\n{table}"))
