"""The camera that a recording gets: assumed, or from a file."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching

from benchmarks.turning_video import pan_and_shake, write_turning_video
from rtof_kin.cli import main
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_motion import read_camera_motion
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.inertial.orientation import HELD
from rtof_kin.recording.cameras import read_camera
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.tables import CameraTable
from rtof_kin.setup.camera import (
    HEIGHT,
    SIGMA_HEIGHT,
    SIGMA_PITCH_DEG,
    SIGMA_ROLL_DEG,
    SetupCamera,
    assumed_camera,
    calibrated_camera,
    filming_camera,
    rotation_of_video,
)
from rtof_kin.setup.init import find_people, write_recording
from rtof_kin.setup.recording_text import Field, Origin, recording_text, summaries
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources
from rtof_kin.vision.background_motion import bearings, turn_between
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.video_metadata import LensPrior, lens_prior

LENS = LensPrior(1480.123, 0.1, -0.0123, 0.05, "a phone's lens")


def read_back(found: SetupCamera) -> Camera:
    table = tomllib.loads(recording_text(found.fields, "camera"))
    return read_camera(CameraTable.of(table, Path("recording.toml"), "camera"))


def assert_same(one: Camera, other: Camera) -> None:
    for name in ("K", "R_camera_world", "t_camera_world", "distortion"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)
    assert (one.width_px, one.height_px) == (other.width_px, other.height_px)
    assert one.assumed == other.assumed


def test_an_assumed_camera_is_level_over_the_floor_and_says_how_unsure_it_is() -> None:
    found = assumed_camera(1080, 1920, LENS, Field(None, Origin.FILE, "walk.mp4"))
    assert not found.placed
    assert_same(read_back(found), found.camera)
    np.testing.assert_allclose(found.camera.center_world, [0, 0, HEIGHT])
    np.testing.assert_allclose(found.camera.project([5.0, 0.0, HEIGHT]), [540.0, 960.0])
    assert found.camera.project([5.0, 0.0, 0.0])[1] > 960.0  # the floor is below
    uncertainty = read_back(found).uncertainty
    assert uncertainty is not None
    assert vars(uncertainty) == pytest.approx(
        {
            "focal": 0.1,
            "tilt": np.radians(SIGMA_PITCH_DEG),
            "height": SIGMA_HEIGHT,
            "k1": 0.05,
            "roll": np.radians(SIGMA_ROLL_DEG),
            "of_motion": False,
        }
    )
    said = [sentence for origin, sentence in summaries(found.fields) if origin is Origin.ASSUMED]
    assert said == [
        "focal length 1480 px ± 10 % (a phone's lens)",
        "the camera is 1.2 ± 0.4 m over the floor, and level ± 10 degrees (roll 4)",
    ]


def test_a_calibrated_camera_is_kept_as_it_is(tmp_path: Path, camera: Camera) -> None:
    write_camera_toml(tmp_path / "calib.toml", {"left": camera, "right": camera})
    size = camera.width_px, camera.height_px
    found = calibrated_camera(tmp_path / "calib.toml", "left", size, "walk.mp4")
    assert found.placed
    assert found.camera.uncertainty is None
    assert_same(read_back(found), camera)
    assert next(summaries(found.fields)) == (Origin.FILE, "the camera of calib.toml, camera left")


def test_a_calibration_of_another_image_is_refused(tmp_path: Path, camera: Camera) -> None:
    write_camera_toml(tmp_path / "calib.toml", {"left": camera})
    with pytest.raises(InvalidInputError, match="walk.mp4 has 640 x 480 px; give the calib"):
        calibrated_camera(tmp_path / "calib.toml", None, (640, 480), "walk.mp4")


def test_a_calibrated_lens_without_a_place_gets_the_assumed_one(tmp_path: Path, camera: Camera) -> None:
    write_camera_toml(tmp_path / "calib.toml", {"one": replace(camera, assumed=("pose",))})
    found = calibrated_camera(tmp_path / "calib.toml", None, None, "")
    assert not found.placed
    np.testing.assert_allclose(found.camera.K, camera.K)
    np.testing.assert_allclose(found.camera.center_world, [0, 0, HEIGHT])
    assert found.camera.uncertainty.focal == 0.0
    assert_same(read_back(found), found.camera)


# OpenCV's wheel needs a system library that machines without a screen may lack.
cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("av", exc_type=ImportError)

RATE, T = 30.0, 75
CAMERA = Camera.looking_at([0.0, 0, 0], [1.0, 0, 0], 360.0, 432, 242)
DOWN = so3.exp(np.radians([-10.0, 0, 0]))  # the middle orientation looks downwards
GUESS = Camera.looking_at([0.0, 0, 0], [1.0, 0, 0], 330.0, 432, 242)
BOXES = np.tile([150.0, 50, 230, 230], (T, 1))
SEED, OFFSET = 5, 12.5
PEOPLE = Detections(BOXES.reshape(T, 1, 2, 2), np.ones((T, 1, 2)), np.arange(T) / RATE)


def log(path: Path, seed: int = SEED) -> Path:
    """The log of a phone whose clock is ahead, held in landscape, from two seconds before the video."""
    times = np.arange(-2.0, T / RATE + 1, 0.01)
    R = pan_and_shake(np.random.default_rng(seed), times) @ HELD["landscape left"]
    w = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * 100
    up_middle = DOWN @ [0.0, -1.0, 0.0]
    f = 9.81 * np.einsum("tji,j->ti", R, up_middle)[1:]
    rows = (",".join(map(str, row)) for row in np.column_stack([times[1:] - 0.005 + OFFSET, w, f]))
    path.write_text("\n".join(["time,wx,wy,wz,fx,fy,fz", *rows]))
    return path


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Array]:
    R = pan_and_shake(np.random.default_rng(SEED), np.arange(T) / RATE)
    path = tmp_path_factory.mktemp("video") / "handheld.mp4"
    write_turning_video(path, R, CAMERA, RATE, BOXES)
    return path, R[0].T @ R


def test_turning_focal_length_and_tilt_are_found_from_nothing(filmed: tuple[Path, Array], tmp_path: Path) -> None:
    path, R_true = filmed
    found = rotation_of_video(path, PEOPLE, GUESS, 0.15, phone=log(tmp_path / "gyro.csv"))
    assert found.camera.K[0, 0] == pytest.approx(360, rel=0.02)
    off = np.degrees(so3.angle_between(found.motion.R_first_camera, R_true))
    assert off.max() < 0.15
    up_first = pan_and_shake(np.random.default_rng(SEED), np.zeros(1))[0].T @ DOWN @ [0.0, -1.0, 0.0]
    assert found.motion.up_first is not None
    assert np.degrees(np.arccos(found.motion.up_first @ up_first)) < 1.0


def test_detect_writes_the_motion_and_what_to_declare(
    filmed: tuple[Path, Array], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("rtof_kin.cli.record.detector_of", lambda *_: None)
    monkeypatch.setattr("rtof_kin.vision.video.detect_video", lambda *_, **__: PEOPLE)
    order = ["detect", str(filmed[0]), "-o", str(tmp_path / "k.npz")]
    order += ["--camera-motion", str(tmp_path / "m.npz")]
    assert main(order) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert '[camera.motion] file = "m.npz"' in said
    assert "with focal_px = 36" in said
    motion = read_camera_motion(tmp_path / "m.npz")
    assert np.degrees(so3.angle_between(motion.R_first_camera, filmed[1])).max() < 0.15
    assert main(order) == 2  # nothing is replaced
    assert main([*order[:1], "0", *order[2:]]) == 2  # a webcam


def test_recording_of_a_handheld_video_is_stabilised_and_of_a_tripod_is_not(tmp_path: Path) -> None:
    motion = walking()
    still = replace(watching(motion), K=np.array([[312.5, 0, 240], [0, 312.5, 135], [0, 0, 1]]))
    still = replace(still, width_px=480, height_px=270)
    uv = points_px("halpe26", motion, still)
    R = pan_and_shake(np.random.default_rng(8), np.arange(len(uv)) / RATE, 8.0)
    rays = np.einsum("tji,tkj->tki", R, bearings(still, uv))  # in the camera that turns
    seen = rays[..., :2] / rays[..., 2:] * 312.5 + [240, 135]
    found = {}
    for name, turn, points in (("handheld", R, seen), ("tripod", np.tile(np.eye(3), (50, 1, 1)), uv)):
        boxes = np.concatenate([points.min(axis=1), points.max(axis=1)], axis=-1)
        write_turning_video(tmp_path / f"{name}.mp4", turn, still, RATE, boxes)
        scores = np.full((*points.shape[:2], 1), 0.9)
        np.savez(tmp_path / f"{name}.npz", keypoints=np.concatenate([points, scores], axis=-1)[:, None])
        sources = Sources(tmp_path / f"{name}.mp4", tmp_path / f"{name}.npz")
        settings = SetupSettings(height=1.8)
        find_people(sources, settings, tmp_path / name, lambda _: PEOPLE)
        findings = write_recording(sources, settings, tmp_path / name)
        found[name] = Recording.load(tmp_path / name).video
        assert any("the camera turned by up to" in s for s in findings.found) == (name == "handheld")
    assert found["handheld"].camera.stabilised
    assert found["handheld"].camera.K[0, 0] == pytest.approx(312.5, rel=0.03)
    assert not found["tripod"].camera.stabilised
    # But for the mean orientation, it is what a camera that stands still sees.
    own, other = (found[name].select([n for n in found[name].names if ":" in n]) for name in ("handheld", "tripod"))
    a, b = bearings(still, other.uv_px).reshape(-1, 3), bearings(own.camera, own.uv_px).reshape(-1, 3)
    R_tripod_own = turn_between(a, b, 1.0).R_a_b
    assert np.degrees(np.linalg.norm(a - b @ R_tripod_own.T, axis=-1)).max() < 0.4


def test_video_that_tells_nothing_leaves_the_camera_and_says_so(tmp_path: Path) -> None:
    film = cv2.VideoWriter(str(tmp_path / "plain.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (432, 242))
    for _ in range(8):
        film.write(np.full((242, 432, 3), 90, np.uint8))
    film.release()
    camera = assumed_camera(432, 242, lens_prior(432, 242), Field(None))
    found = filming_camera(tmp_path / "plain.mp4", PEOPLE, camera, None, lambda *_: None)
    assert found.camera is camera
    assert found.motion is None
    assert "whether the camera stood still is not known" in found.doubts[0]
    with pytest.raises(InvalidInputError, match="give the video too"):
        filming_camera(None, PEOPLE, camera, tmp_path / "gyro.csv", lambda *_: None)


def test_log_of_another_take_is_not_used(
    filmed: tuple[Path, Array], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = rotation_of_video(filmed[0], PEOPLE, GUESS, 0.15, phone=log(tmp_path / "gyro.csv", seed=6))
    assert found.motion.up_first is None
    assert "is it the file of this video" in caplog.text
