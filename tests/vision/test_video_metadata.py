"""What cameras write into their files is read, and rubbish there is not believed."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dot_detector import write_video

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.vision.video_metadata import (
    STABILISED,
    VideoMetadata,
    find_phone,
    lens_prior,
    phone_table,
    read_video_metadata,
)

pytest.importorskip("av")
pytest.importorskip("onnx")

FOCAL = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
IMAGES = [np.full((64, 96, 3), 90, dtype=np.uint8)] * 5


def read(path: Path, **how: Any) -> VideoMetadata:
    return read_video_metadata(write_video(path, IMAGES, **how))


def test_a_portrait_video_of_an_iphone(tmp_path: Path) -> None:
    tags = {
        "com.apple.quicktime.make": "Apple",
        "com.apple.quicktime.model": "iPhone 15 Pro",
        "com.apple.quicktime.creationdate": "2024-05-01T10:00:00+0200",
        "com.apple.quicktime.camera.lens_model": "iPhone 15 Pro back camera 6.765mm f/1.78",
        FOCAL: "24",
    }
    found = read(tmp_path / "iphone.mp4", metadata=tags, rotation=-90)
    assert (found.width_px, found.height_px, found.rotation_deg) == (64, 96, 270)
    assert (found.make, found.model, found.focal_35mm_mm) == ("Apple", "iPhone 15 Pro", 24.0)
    assert found.lens == "iPhone 15 Pro back camera 6.765mm f/1.78"
    assert found.start_utc == datetime(2024, 5, 1, 8, 0, tzinfo=UTC)
    assert (found.frames, found.slowed) == (5, 1.0)
    assert found.rate_hz == pytest.approx(25.0)
    assert found.seconds == pytest.approx(0.2)


def test_slow_motion_of_an_android_phone_is_in_real_time(tmp_path: Path) -> None:
    tags = {"com.android.manufacturer": "Google", "com.android.model": "Pixel 8"}
    found = read(tmp_path / "slow.mp4", metadata=tags | {"com.android.capture.fps": "240.0"})
    assert (found.make, found.model, found.slowed) == ("Google", "Pixel 8", pytest.approx(9.6))
    assert found.rate_hz == pytest.approx(240.0)
    assert found.seconds == pytest.approx(5 / 240)
    dark = [0, 66, 133, 200, 266]  # 15 Hz as exposures are long; not slow motion
    found = read(tmp_path / "dark.mp4", metadata={"com.android.capture.fps": "30"}, times_ms=dark)
    assert found.slowed == 1.0


def test_a_file_that_says_nothing(tmp_path: Path) -> None:
    found = read(tmp_path / "plain.mkv", codec="ffv1")
    assert found == VideoMetadata(96, 64, 0, pytest.approx(25.0), 5, pytest.approx(0.2))


def test_pixels_that_are_not_square_widen_the_image(tmp_path: Path) -> None:
    found = read(tmp_path / "wide.mp4", aspect=Fraction(4, 3), rotation=90)
    assert (found.width_px, found.height_px) == (64, 128)


@pytest.mark.parametrize(
    "tags",
    [
        {"com.apple.quicktime.creationdate": "yesterday", "com.android.capture.fps": "nan"},
        {"creation_time": "1904-01-01T00:00:00Z", "com.android.capture.fps": "-240"},
        {"com.apple.quicktime.creationdate": "2024-05-01T10:00:00"},  # of no time zone
        {FOCAL: "0", "com.android.capture.fps": "1e9"},
        {"com.apple.quicktime.camera.focal_length.35mm_equivalent": "inf", "com.apple.quicktime.model": " \n "},
    ],
)
def test_rubbish_is_not_believed(tags: dict[str, str], tmp_path: Path) -> None:
    found = read(tmp_path / "film.mp4", metadata=tags)
    assert (found.start_utc, found.focal_35mm_mm, found.model, found.slowed) == (None, None, None, 1.0)


def test_long_and_unprintable_names_are_cut(tmp_path: Path) -> None:
    found = read(tmp_path / "film.mp4", metadata={"com.android.model": "\x1b[31mPixel" + "x" * 5000})
    assert found.model is not None
    assert found.model.startswith("[31mPixelxx")
    assert len(found.model) == 100


STATED_MM = {  # equivalent focal lengths of main cameras, from Apple's data sheets
    "iPhone 6s": 29,
    "iPhone 8": 28,
    "iPhone X": 28,
    "iPhone XS": 26,
    "iPhone 11": 26,
    "iPhone 12": 26,
    "iPhone 13 Pro": 26,
    "iPhone 14 Pro": 24,
    "iPhone 15": 26,
    "iPhone 16 Pro": 24,
    "iPhone SE (3rd generation)": 28,
}


def of(model: str | None, **more: object) -> VideoMetadata:
    return VideoMetadata(1920, 1080, model=model, **more)  # type: ignore[arg-type]


def test_the_stated_focal_length_agrees_with_the_calibrated_one() -> None:
    for model, focal_mm in STATED_MM.items():
        calibrated = lens_prior(1920, 1080, of(model, make="Apple"))
        stated = lens_prior(1920, 1080, of("unknown", focal_35mm_mm=focal_mm))
        assert stated.focal_px == pytest.approx(calibrated.focal_px, rel=0.055), model
        assert "calibrated by OpenCap" in calibrated.source
        assert f"{focal_mm} mm (as for 35 mm film)" in stated.source


def test_real_cameras_are_inside_the_prior() -> None:
    # Focal length over the longer side of cameras calibrated by others: four of Pose2Sim's demonstration, an
    # unstabilised iPhone 12 of OpenCap, and the view of 78 degrees along the diagonal of a common webcam.
    webcam = 0.5 * math.hypot(16, 9) / 16 / math.tan(math.radians(39))
    for focal in (0.8761, 0.8722, 0.8763, 0.8730, 0.711, webcam):
        prior = lens_prior(1920, 1080)
        assert abs(focal * 1920 - prior.focal_px) < 1.1 * prior.sigma_focal * prior.focal_px
    prior = lens_prior(1920, 1080, of("iPhone 12"))
    for cropped in (1.0, 1.0 * STABILISED, 1.2):
        assert abs(0.711 * 1920 * cropped - prior.focal_px) < 2 * prior.sigma_focal * prior.focal_px


def test_the_prior_is_one_of_the_camera_not_of_the_resolution_or_the_turn() -> None:
    for metadata in (None, of("Pixel 6")):
        full, small = lens_prior(3840, 2160, metadata), lens_prior(1080, 1920, metadata)
        assert full.focal_px == pytest.approx(2 * small.focal_px)
        assert full.source == small.source
        assert full.sigma_focal == small.sigma_focal


def test_less_knowledge_is_a_larger_standard_deviation() -> None:
    sigmas = [lens_prior(1920, 1080, m).sigma_focal for m in (of("iPhone 12"), of("SM-S911B"), None)]
    assert sigmas == sorted(sigmas)
    assert 0.07 < sigmas[0] < sigmas[2] == 0.15
    assert lens_prior(1080, 1080).sigma_focal > 0.18
    assert "cropped, by an unknown factor" in lens_prior(1080, 1080).source


def test_another_lens_than_the_main_one_is_noticed() -> None:
    wide = lens_prior(1920, 1080, of("iPhone 13 Pro", make="Apple", focal_35mm_mm=13.0))
    main = lens_prior(1920, 1080, of("iPhone 13 Pro", make="Apple"))
    assert wide.focal_px == pytest.approx(0.5 * main.focal_px, rel=0.06)
    lens = "iPhone 13 Pro back ultra wide camera 1.54mm f/1.8"
    named = lens_prior(1920, 1080, of("iPhone 13 Pro", lens=lens))
    assert abs(named.focal_px - wide.focal_px) < named.sigma_focal * named.focal_px
    assert "ultra lenses" in named.source
    assert lens_prior(1920, 1080, of("iPhone 13 Pro", make="Apple", focal_35mm_mm=26.0)) == main


def test_what_is_unknown_is_said() -> None:
    assert "nothing is known of the camera" in lens_prior(640, 480).source
    assert "Acme X1 is not in the table of phones" in lens_prior(640, 480, of("X1", make="Acme")).source
    assert "the file does not name it" in lens_prior(640, 480, of(None)).source
    assert "field of view 67 degrees along the longer side, focal length +- 15 %" in lens_prior(640, 480).source
    with pytest.raises(InvalidInputError, match="image of 0 x 480 px"):
        lens_prior(0, 480)


def test_models_are_found_by_their_own_names() -> None:
    assert find_phone("Apple", "iPhone 12 Pro") != find_phone("Apple", "iPhone 12")
    assert find_phone("samsung", "SM-G991B") is not None
    assert find_phone("SAMSUNG", "sm-g991u1") == find_phone(None, "SM-G991B")
    assert find_phone("Google", "iPhone 12") is None
    assert find_phone("Apple", "iPhone 99") is None
    assert find_phone("Apple", None) is None


def test_every_phone_of_the_table_has_a_phones_field_of_view() -> None:
    names = [name for phone in phone_table() for name in phone.models]
    assert len(names) == len(set(names)) > 60
    for phone in phone_table():
        assert 55 < math.degrees(2 * math.atan(0.5 / phone.focal)) < 78
        assert 0.02 <= phone.sigma <= 0.1
