"""Pictures that a motion is drawn on: the frames of a video, or a plain background."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.view.overlay.canvas import Image
from rtof_kin.view.overlay.picture_view import PictureView
from rtof_kin.view.overlay.settings import Background
from rtof_kin.vision.video import read_video
from rtof_kin.vision.video_metadata import VideoMetadata, read_video_metadata

_COLOURS: Final[dict[Background, int]] = {"white": 255, "dark": 32}
_ASPECT: Final = 0.01
"""Largest relative difference of aspect ratios of the same picture: encoders cut or add some pixels."""
_ROUNDING_PX: Final = 2.0
"""Largest difference of a side by rounding."""
_USUAL_HZ: Final = 30.0
"""Assumed of a video that does not state its frame rate."""
_RATE: Final = 0.02
"""Largest relative difference of frame rates that is not pointed out."""


@dataclass(frozen=True)
class Picture:
    """A picture to be drawn on."""

    image: Image
    """(height, width, 3), BGR."""
    time: float
    """s, on the clock of --from and --to."""
    stamp: float
    """s, in the file that is written."""
    index: int
    """Counted from 0."""
    total: int
    """Number of pictures; 0 where unknown."""


class FilmSource(Protocol):
    """Where pictures come from."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        ...

    @property
    def rate_hz(self) -> float:
        """Mean rate of the pictures in the file that is written, Hz."""
        ...

    def pictures(self) -> Iterator[Picture]:
        """Generate the pictures."""
        ...


@dataclass(frozen=True)
class VideoSource:
    """The frames of a video file, upright."""

    path: Path
    """The video."""
    metadata: VideoMetadata
    """Of the file."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.metadata.width_px, self.metadata.height_px

    @property
    def rate_hz(self) -> float:
        """Mean rate of the frames in the file, Hz."""
        return (self.metadata.rate_hz or _USUAL_HZ) / self.metadata.slowed

    def pictures(self) -> Iterator[Picture]:
        """Generate the frames; stamps are those of the file, also of slow motion."""
        for frame in read_video(self.path):
            image = frame.image if frame.image.flags.writeable else frame.image.copy()
            yield Picture(image, frame.time, frame.time * self.metadata.slowed, frame.index, frame.total)


@dataclass(frozen=True)
class PlainSource:
    """A plain background at the times of a motion."""

    size: tuple[int, int]
    """Width and height, px."""
    times: Array
    """(T,) s of the motion."""
    background: Background
    """Its colour."""

    @property
    def rate_hz(self) -> float:
        """Mean rate, Hz; 60 for a single picture."""
        return float(1 / np.median(np.diff(self.times))) if len(self.times) > 1 else 60.0

    def pictures(self) -> Iterator[Picture]:
        """Generate a picture for each frame of the motion."""
        width, height = self.size
        for i, time in enumerate(self.times.tolist()):
            image = np.full((height, width, 3), _COLOURS[self.background], dtype=np.uint8)
            yield Picture(image, time, time - float(self.times[0]), i, len(self.times))


def open_source(path: str | Path, view: PictureView) -> VideoSource:
    """Return the frames of a video whose picture has the shape of a view's.

    Raises:
        FileFormatError: not a readable video. InvalidInputError: its picture has another shape.
    """
    metadata = read_video_metadata(path)
    camera = view.camera
    across, down = metadata.width_px / camera.width_px, metadata.height_px / camera.height_px
    if abs(across / down - 1) > _ASPECT:
        raise InvalidInputError(
            f"{path}: is {metadata.width_px} x {metadata.height_px} px upright, the camera of this motion "
            f"{camera.width_px} x {camera.height_px}; give the video that the motion was computed from, "
            "uncropped, or --view for another camera"
        )
    return VideoSource(Path(path), metadata)


def scale_of(size: tuple[int, int], view: PictureView) -> float:
    """Return pixels of a picture per pixel of a view's image.

    Where the sides differ, pixels were cut or added at the right or lower edge.

    Args:
        size: width and height of the picture, px.
    """
    across, down = size[0] / view.camera.width_px, size[1] / view.camera.height_px
    return min((across, down), key=lambda scale: abs(scale - 1))


def check_size(source: VideoSource, view: PictureView) -> tuple[str, ...]:
    """Return a sentence if some pixels were cut off or added."""
    camera, size, scale = view.camera, source.size, scale_of(source.size, view)
    wrong = max(abs(size[0] - scale * camera.width_px), abs(size[1] - scale * camera.height_px))
    if wrong <= _ROUNDING_PX:
        return ()
    return (
        f"{source.path} is {size[0]} x {size[1]} px upright, the camera {camera.width_px} x "
        f"{camera.height_px}: taken as cut or extended by {wrong:.0f} px at the right or lower edge",
    )


def check_times(source: VideoSource, view: PictureView, shift: float) -> tuple[str, ...]:
    """Return sentences on what does not fit between a video and a motion.

    Args:
        shift: s, added to the times of the video.

    Raises:
        InvalidInputError: no frame of the video is at a time of the motion.
    """
    first, last = float(view.video_times[0]), float(view.video_times[-1])
    seconds, rate = source.metadata.seconds, source.metadata.rate_hz
    path, notes = source.path, []
    step = float(np.median(np.diff(view.video_times))) if len(view.video_times) > 1 else 0.0
    span = f"the motion is from {first:.2f} to {last:.2f} s of the video that people were detected in"
    if seconds is not None:
        begin, end = shift, shift + seconds
        if end < first - step or begin > last + step:
            raise InvalidInputError(
                f"{path}: with --shift {shift:g} it is from {begin:.2f} to {end:.2f} s, but {span}; give "
                "that video, or by --shift how much later this one begins, s"
            )
        if end < last - 2 * step or begin > first + 2 * step:
            notes.append(
                f"{path} is from {begin:.2f} to {end:.2f} s, but {span}: is it another video, or a cut one? "
                "Then give by --shift how much later it begins, s"
            )
    if rate is not None and step > 0 and abs(rate * step - 1) > _RATE:
        notes.append(
            f"{path} has {rate:.2f} frames per second, the motion {1 / step:.2f}: poses are interpolated; "
            "is it the same video?"
        )
    return tuple(notes)
