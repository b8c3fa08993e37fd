"""The camera that a recording gets: assumed, or from a file."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.recording.cameras import read_camera
from rtof_kin.recording.tables import CameraTable
from rtof_kin.setup.camera import (
    HEIGHT,
    SIGMA_HEIGHT,
    SIGMA_PITCH_DEG,
    SIGMA_ROLL_DEG,
    SetupCamera,
    assumed_camera,
    calibrated_camera,
)
from rtof_kin.setup.recording_text import Field, Origin, recording_text, summaries
from rtof_kin.vision.video_metadata import LensPrior

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
    assert found.camera.uncertainty is not None
    assert found.camera.uncertainty.focal == 0.0
    assert_same(read_back(found), found.camera)
