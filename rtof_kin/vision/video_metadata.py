"""`read_video_metadata`: size, orientation, times and camera of a video file, as far as the file says.

Cameras write more than they document. Read are the keys of Apple (``com.apple.quicktime.*``, of its tracks
``com.apple.quicktime.camera.*``), of Android (``com.android.*``), and the general ones of all containers
(``make``, ``model``, ``creation_time``). A file that was edited or sent by a messenger usually has none left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rtof_kin.core.errors import FileFormatError
from rtof_kin.vision.video_file import open_video, turn_deg, upright_size

_MAKE = ("com.apple.quicktime.make", "com.android.manufacturer", "make", "manufacturer")
_MODEL = ("com.apple.quicktime.model", "com.android.model", "model")
_FOCAL = ("com.apple.quicktime.camera.focal_length.35mm_equivalent", "focallengthin35mmformat")
_LENS = ("com.apple.quicktime.camera.lens_model", "lens_model")
_START = ("com.apple.quicktime.creationdate", "creation_time", "date")
_CAPTURE = "com.android.capture.fps"
_SLOW_MOTION_HZ, _SLOWED = 90.0, 1.9  # [Hz] lowest capture rate of slow motion; [-] least ratio to the file's
_EARLIEST = 1990  # cameras without a clock write 1904 or 1970
_FOCAL_MM = (5.0, 1000.0)
_LONGEST_TEXT = 100


@dataclass(frozen=True)
class VideoMetadata:
    """What a video file says about itself; None where it says nothing."""

    width_px: int
    """Width of the upright image, px."""
    height_px: int
    """Height of the upright image, px."""
    rotation_deg: int = 0
    """0, 90, 180 or 270: turn of the stored images, counterclockwise, that makes them upright."""
    rate_hz: float | None = None
    """Mean frame rate in real time, Hz."""
    frames: int | None = None
    """Number of frames; where the file does not state it, from duration and rate."""
    seconds: float | None = None
    """Duration in real time, s."""
    slowed: float = 1.0
    """Factor by which the file is slower than real time: slow motion of some phones."""
    start_utc: datetime | None = None
    """Start of the recording; Android's cameras write its end in some models. The clock is the phone's."""
    make: str | None = None
    """Maker of the camera."""
    model: str | None = None
    """Model of the camera."""
    lens: str | None = None
    """The camera's words for its lens, e.g. 'iPhone 15 Pro back camera 6.765mm f/1.78'."""
    focal_35mm_mm: float | None = None
    """Focal length as an equivalent for 35 mm film, mm, where the file states it."""


def read_video_metadata(path: str | Path) -> VideoMetadata:
    """Read the metadata of a video; decodes one image.

    Raises:
        FileFormatError: no such file, or not a readable video.
        RtofError: the extra ``video`` is not installed.
    """
    with open_video(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise FileFormatError(path, "there is no readable frame in it")
        width, height = upright_size(frame, stream)
        tags = _tags(container, stream)
        rate, slowed = frame_rate(stream), slow_motion(container, stream)
        seconds = _duration(container, stream)
        return VideoMetadata(
            width_px=width,
            height_px=height,
            rotation_deg=turn_deg(frame),
            rate_hz=None if rate is None else rate * slowed,
            frames=frame_count(container, stream) or None,
            seconds=None if seconds is None else seconds / slowed,
            slowed=slowed,
            start_utc=_start(tags),
            make=_text(tags, _MAKE),
            model=_text(tags, _MODEL),
            lens=_text(tags, _LENS),
            focal_35mm_mm=_number(tags, _FOCAL, *_FOCAL_MM),
        )


def read_photo_metadata(path: str | Path) -> VideoMetadata:
    """Read the camera from the EXIF data of a photo that it took, without its rotation.

    Raises:
        FileFormatError: no such file, or not a readable image.
    """
    from PIL import ExifTags, Image  # of matplotlib

    try:
        with Image.open(path) as image:
            exif = image.getexif()
            inner = exif.get_ifd(ExifTags.IFD.Exif)
            width, height = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise FileFormatError(path, f"not a readable photo: {error}") from error
    tags = {
        "make": str(exif.get(ExifTags.Base.Make, "")),
        "model": str(exif.get(ExifTags.Base.Model, "")),
        "lens_model": str(inner.get(ExifTags.Base.LensModel, "")),
        "focallengthin35mmformat": str(inner.get(ExifTags.Base.FocalLengthIn35mmFilm, "")),
    }
    return VideoMetadata(
        width,
        height,
        make=_text(tags, _MAKE),
        model=_text(tags, _MODEL),
        lens=_text(tags, _LENS),
        focal_35mm_mm=_number(tags, _FOCAL, *_FOCAL_MM),
    )


def slow_motion(container: Any, stream: Any) -> float:
    """Return the factor by which a file is slower than real time: 1, or more for slow motion of Android."""
    captured = _number(_tags(container, stream), (_CAPTURE,), _SLOW_MOTION_HZ, 1e4)
    rate = frame_rate(stream)
    if captured is None or rate is None or captured < _SLOWED * rate:
        return 1.0
    return captured / rate


def frame_count(container: Any, stream: Any) -> int:
    """Return the number of frames, from duration and rate where the file does not state it; 0 where unknown."""
    return int(stream.frames) or round((_duration(container, stream) or 0.0) * (frame_rate(stream) or 0.0))


def _tags(container: Any, stream: Any) -> dict[str, str]:
    """Return all keys of a file in lower case; those of the container before those of its tracks."""
    found: dict[str, str] = {}
    for part in (container, stream, *container.streams):
        for key, value in part.metadata.items():
            found.setdefault(str(key).lower(), str(value))
    return found


def _text(tags: dict[str, str], keys: tuple[str, ...]) -> str | None:
    for key in keys:
        value = "".join(c for c in tags.get(key, "") if c.isprintable()).strip()[:_LONGEST_TEXT]
        if value:
            return value
    return None


def _number(tags: dict[str, str], keys: tuple[str, ...], low: float, high: float) -> float | None:
    for key in keys:
        try:
            value = float(tags.get(key, ""))
        except ValueError:
            continue
        if low <= value <= high:
            return value
    return None


def _start(tags: dict[str, str]) -> datetime | None:
    for key in _START:
        try:
            start = datetime.fromisoformat(tags.get(key, ""))
        except ValueError:
            continue
        if start.tzinfo is not None and start.year >= _EARLIEST:
            return start.astimezone(UTC)
    return None


def frame_rate(stream: Any) -> float | None:
    """Return the mean rate of the frames in a file, Hz; None where unknown."""
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    return rate if math.isfinite(rate) and 1e-3 < rate < 1e5 else None


def _duration(container: Any, stream: Any) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        seconds = float(stream.duration * stream.time_base)
    else:
        seconds = (container.duration or 0) / 1e6  # PyAV's unit is 1 us
    return seconds if 0 < seconds < 1e7 else None
