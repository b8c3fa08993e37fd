"""What cameras write into their files is read, and rubbish there is not believed."""

from __future__ import annotations

from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from rtof_kin.core.errors import FileFormatError
from rtof_kin.vision.video_metadata import VideoMetadata, read_photo_metadata, read_video_metadata

pytest.importorskip("av")
pytest.importorskip("onnx")
from dot_detector import write_video

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


def test_a_file_without_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(FileFormatError, match="text.mp4: not a readable video"):
        read_video_metadata(tmp_path / "text.mp4")


def test_a_photo_tells_the_camera(tmp_path: Path) -> None:
    image, exif = Image.new("RGB", (40, 30)), Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "samsung", "SM-S911B"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 24
    image.save(tmp_path / "photo.jpg", exif=exif)
    expected = VideoMetadata(40, 30, make="samsung", model="SM-S911B", focal_35mm_mm=24.0)
    assert read_photo_metadata(tmp_path / "photo.jpg") == expected
    image.save(tmp_path / "plain.png")
    assert read_photo_metadata(tmp_path / "plain.png") == VideoMetadata(40, 30)
    (tmp_path / "text.jpg").write_text("no photo")
    for name in ("text.jpg", "none.jpg"):
        with pytest.raises(FileFormatError, match=f"{name}: not a readable photo"):
            read_photo_metadata(tmp_path / name)
