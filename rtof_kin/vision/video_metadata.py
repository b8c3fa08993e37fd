"""`read_video_metadata`: size, orientation, times and camera of a video file, as far as the file says.

Cameras write more than they document. Read are the keys of Apple (``com.apple.quicktime.*``, of its tracks
``com.apple.quicktime.camera.*``), of Android (``com.android.*``), and the general ones of all containers
(``make``, ``model``, ``creation_time``). A file that was edited or sent by a messenger usually has none left.

Opening of video files with PyAV (the optional extra ``video``), as data of unknown origin. Only containers of cameras
and screen recorders are opened: no playlist, whose entries could name other files or servers.

`lens_prior`: focal length and distortion of a camera that was not calibrated, with standard deviations. What is known
decides: the focal length that the file states, the model's entry in ``models/phones.toml``, or nothing, where the
fields of view of phones' main cameras and of webcams give a wide prior. Focal lengths are kept relative to the longer
side of the image, so that they hold for every resolution of a camera.

An equivalent focal length f35 is stated for the diagonal of 35 mm film (43.27 mm) and the 4:3 sensor of a phone, whose
diagonal is 5/4 of its width: f / width = f35 / 34.61 mm. The iPhones of the table whose lenses were calibrated have
0.955 +- 0.017 of that in videos. A phone's own camera application then crops the image to stabilise it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.packages import optional
from rtof_kin.core.resources import model_path

_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,ogg,flv,mxf,dv"
_CONVERT = "convert it to MP4 (H.264) first"
_MOST_PIXELS = 64e6  # of one image: 8K has 33 million


@contextmanager
def open_video(path: str | Path) -> Iterator[tuple[Any, Any]]:
    """Yield the container and the first video stream of a file; errors of PyAV become `FileFormatError`, as do no such
    file, not a video, or images larger than any camera's; `RtofError`: the extra is not installed.
    """
    av = optional("av", "video")
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(path, "there is no such video")
    options = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
    try:
        with av.open(f"file:{path.resolve()}", options=options, metadata_errors="replace") as container:
            if not container.streams.video:
                raise FileFormatError(path, "has no video track; give a video file")
            stream = container.streams.video[0]
            if stream.codec_context is None or stream.width * stream.height == 0:
                raise FileFormatError(path, f"its video track is not readable; {_CONVERT}")
            if stream.width * stream.height > _MOST_PIXELS:
                raise FileFormatError(path, f"its images of {stream.width} x {stream.height} px are too large")
            yield container, stream
    except (av.FFmpegError, ValueError, OverflowError) as error:
        if isinstance(error, RtofError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise FileFormatError(path, f"not a readable video ({reason}); {_CONVERT}") from error


def turn_deg(frame: Any) -> int:
    """Return 0, 90, 180 or 270: counterclockwise turn that makes a frame upright."""
    return round(float(frame.rotation) / 90) * 90 % 360


def upright_size(frame: Any, stream: Any) -> tuple[int, int]:
    """Return width and height, px, of `upright_image`."""
    width, height = _square_width(frame, stream), frame.height
    return (height, width) if turn_deg(frame) % 180 else (width, height)


def upright_image(frame: Any, stream: Any) -> NDArray[np.uint8]:
    """Return the image of a frame, upright and with square pixels, (height, width, 3), BGR."""
    image = frame.to_ndarray(format="bgr24", width=_square_width(frame, stream), height=frame.height)
    return np.ascontiguousarray(np.rot90(image, turn_deg(frame) // 90))


def _square_width(frame: Any, stream: Any) -> int:
    """Return the width of a frame with square pixels."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return round(int(frame.width) * (aspect if 0.25 < aspect < 4 else 1.0))


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

    width_px: int  #: Width of the upright image, px
    height_px: int  #: Height of the upright image, px
    rotation_deg: int = 0  #: 0, 90, 180 or 270: turn of the stored images, counterclockwise, that makes them upright
    rate_hz: float | None = None  #: Mean frame rate in real time, Hz
    frames: int | None = None  #: Number of frames; where the file does not state it, from duration and rate
    seconds: float | None = None  #: Duration in real time, s
    slowed: float = 1.0  #: Factor by which the file is slower than real time: slow motion of some phones
    start_utc: datetime | None = None
    """Start of the recording; Android's cameras write its end in some models. The clock is the phone's."""
    make: str | None = None  #: Maker of the camera
    model: str | None = None  #: Model of the camera
    lens: str | None = None  #: The camera's words for its lens, e.g. 'iPhone 15 Pro back camera 6.765mm f/1.78'.
    focal_35mm_mm: float | None = None  #: Focal length as an equivalent for 35 mm film, mm, where the file states it


def read_video_metadata(path: str | Path) -> VideoMetadata:
    """Read the metadata of a video; decodes one image. Errors as `open_video`."""
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


UNKNOWN_FOCAL: Final = 0.76  #: Focal length over the longer side of the image of an unknown camera: 67 degrees of view
UNKNOWN_SIGMA: Final = 0.15  #: Its relative standard deviation: 55 to 80 degrees of view are one away
STABILISED, STABILISED_SIGMA = 1.08, 0.07
"""Factor on the focal length by cropping to stabilise, 0 to about 20 %, and its standard deviation."""
_FILM_WIDTH_MM = 34.61  # diagonal of 35 mm film times 4/5
_VIDEO = 0.955  # of the stated equivalent focal length, in videos
_UNKNOWN_K1_SIGMA = 0.08
_UNKNOWN = (UNKNOWN_FOCAL, UNKNOWN_SIGMA, 0.0, _UNKNOWN_K1_SIGMA)
_STATED_SIGMA = 0.04  # relative, of a whole number of mm
_SAME_LENS = 0.12  # relative difference in focal length below which a stated one is the main camera's
_OTHER_LENSES = {"front": _UNKNOWN, "ultra": (0.42, 0.15, 0.0, 0.1), "tele": (1.9, 0.4, 0.0, 0.05)}
_ODD_SIGMA = 0.12  # relative, for images cropped to another shape than 4:3 to 16:9
_SHAPES = (1.25, 1.95)


@dataclass(frozen=True)
class LensPrior:
    """Lens of a camera before calibration."""

    focal_px: float  #: Focal length, px
    sigma_focal: float  #: Relative standard deviation of the focal length
    k1: float  #: First radial coefficient of OpenCV's distortion model
    sigma_k1: float  #: Its standard deviation
    source: str  #: Where this is from: a sentence for reports


class Phone(NamedTuple):
    """Main camera of a phone or tablet in ``models/phones.toml``."""

    make: str
    models: tuple[str, ...]  #: Names in files, as patterns of `fnmatch`
    focal: float  #: Focal length over the longer side of the image, without stabilisation
    sigma: float  #: Relative standard deviation of `focal`
    k1: float
    sigma_k1: float
    source: str


def lens_prior(width_px: int, height_px: int, metadata: VideoMetadata | None = None) -> LensPrior:
    """Return what can be assumed of the lens of an uncalibrated camera, by the video's metadata where there is some;
    `InvalidInputError` where a size is not positive.
    """
    if min(width_px, height_px) <= 0:
        raise InvalidInputError(f"image of {width_px} x {height_px} px: both have to be positive")
    long, shape = max(width_px, height_px), max(width_px, height_px) / min(width_px, height_px)
    focal, sigma, k1, sigma_k1, source = _lens(metadata)
    if not _SHAPES[0] <= shape <= _SHAPES[1]:
        sigma = math.hypot(sigma, _ODD_SIGMA)
        source += f"; the image of {width_px} x {height_px} px is cropped, by an unknown factor"
    degrees = math.degrees(2 * math.atan(0.5 / focal))
    view = f"field of view {degrees:.0f} degrees along the longer side, focal length +- {100 * sigma:.0f} %"
    return LensPrior(focal * long, sigma, k1, sigma_k1, f"{view}: {source}")


def _lens(metadata: VideoMetadata | None) -> tuple[float, float, float, float, str]:
    """Return focal length over the longer side, relative sd, k1, its sd and the source."""
    if metadata is None:
        return *_UNKNOWN, "that of phones and webcams in general, as nothing is known of the camera"
    cropped = "with an allowance for stabilisation, which crops the image by up to 20 %"
    camera = f"{metadata.make or ''} {metadata.model or 'camera'}".strip()
    phone = find_phone(metadata.make, metadata.model)
    if metadata.focal_35mm_mm is not None:
        focal = metadata.focal_35mm_mm * _VIDEO / _FILM_WIDTH_MM
        main = phone is not None and abs(focal / phone.focal - 1) < _SAME_LENS
        if phone is None or not main:
            sigma = math.hypot(_STATED_SIGMA, STABILISED_SIGMA)
            stated = f"{metadata.focal_35mm_mm:g} mm (as for 35 mm film), as the file of this {camera} states"
            return focal * STABILISED, sigma, 0.0, _UNKNOWN_K1_SIGMA, f"{stated}, {cropped}"
    else:
        for word, of_other in _OTHER_LENSES.items():
            if word in (metadata.lens or "").lower():
                return (*of_other, f"that of phones' {word} lenses in general, which this {camera} used")
    if phone is None:
        known = f"{camera} is not in the table of phones" if metadata.model else "the file does not name it"
        return *_UNKNOWN, f"that of phones and webcams in general, as the camera is unknown ({known})"
    sigma = math.hypot(phone.sigma, STABILISED_SIGMA)
    source = f"main camera of {camera} ({phone.source}), {cropped}"
    return phone.focal * STABILISED, sigma, phone.k1, phone.sigma_k1, source


def find_phone(make: str | None, model: str | None) -> Phone | None:
    """Return the entry of a phone or tablet, by maker and model as in files, case aside, in the shipped table; or
    None.
    """
    wanted, maker = (model or "").strip().lower(), (make or "").strip().lower()
    for phone in phone_table():
        own = phone.make.lower() in (maker or phone.make.lower())
        if own and any(fnmatchcase(wanted, name.lower()) for name in phone.models):
            return phone
    return None


@cache
def phone_table() -> tuple[Phone, ...]:
    """Return the shipped table of phones."""
    data, phones = load_toml(model_path("phones.toml")), list[Phone]()
    for entry in data["phone"]:
        source, models = data["sources"][entry["source"]], tuple(entry["models"])
        focal = entry["focal"] if "focal" in entry else entry["focal_35mm_mm"] * _VIDEO / _FILM_WIDTH_MM
        lens = focal, source["sigma"], float(entry.get("k1", source["k1"])), source["sigma_k1"]
        phones.append(Phone(entry["make"], models, *lens, source["title"]))
    return tuple(phones)
