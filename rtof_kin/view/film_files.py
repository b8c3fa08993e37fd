"""Films: pictures that a motion is drawn on, of a video or plain, and the MP4 that is written.

No sound and no metadata of a source (place, time, device) is copied, because only pictures are passed on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, WritingError
from rtof_kin.core.packages import optional
from rtof_kin.view.canvas import Image
from rtof_kin.view.overlay_settings import Background
from rtof_kin.view.projected_motion import PictureView
from rtof_kin.vision.video import h264_encoder, read_video
from rtof_kin.vision.video_metadata import VideoMetadata, read_video_metadata

_COLOURS: Final[dict[Background, int]] = {"white": 255, "dark": 32}
_ASPECT: Final = 0.01
"""Largest relative difference of aspect ratios of the same picture: encoders cut or add some pixels."""
_ROUNDING_PX: Final = 2.0  # Largest difference of a side by rounding
_USUAL_HZ: Final = 30.0  # Assumed of a video that does not state its frame rate
_RATE: Final = 0.02  # Largest relative difference of frame rates that is not pointed out
_ENCODERS: Final[dict[str, dict[str, str]]] = {
    "libx264": {"preset": "superfast", "crf": "21"},
    "libopenh264": {"rc_mode": "quality"},
}
"""Options of the encoders of `vision.video.H264_ENCODERS`."""
_TICKS: Final = 90_000  # Ticks per second of time stamps
_BT709: Final = 1  # FFmpeg's number of the colour space of BT.709


@dataclass(frozen=True)
class Picture:
    """A picture to be drawn on."""

    image: Image  #: (height, width, 3), BGR
    time: float  #: s, on the clock of --start and --stop
    stamp: float  #: s, in the file that is written
    index: int  #: Counted from 0
    total: int  #: Number of pictures; 0 where unknown


@dataclass(frozen=True)
class FilmSource:
    """Pictures that are drawn on: of a video file, upright, or plain at the times of a motion."""

    size: tuple[int, int]  #: Width and height, px
    rate_hz: float  #: Mean rate in the file that is written, Hz
    pictures: Iterator[Picture]
    metadata: VideoMetadata | None = None  #: Of the video; None without one

    @classmethod
    def of_video(cls, path: str | Path, view: PictureView) -> Self:
        """Return the frames of a video whose picture has the shape of a view's; stamps are those of the file.
        `FileFormatError`: not a readable video; `InvalidInputError`: its picture has another shape.
        """
        metadata, camera = read_video_metadata(path), view.camera
        across, down = metadata.width_px / camera.width_px, metadata.height_px / camera.height_px
        if abs(across / down - 1) > _ASPECT:
            raise InvalidInputError(
                f"{path}: is {metadata.width_px} x {metadata.height_px} px upright, the camera of this motion "
                f"{camera.width_px} x {camera.height_px}; give the video that the motion was computed from, "
                "uncropped, or --view for another camera"
            )

        def pictures() -> Iterator[Picture]:
            for frame in read_video(path):
                image = frame.image if frame.image.flags.writeable else frame.image.copy()
                yield Picture(image, frame.time, frame.time * metadata.slowed, frame.index, frame.total)

        rate_hz = (metadata.rate_hz or _USUAL_HZ) / metadata.slowed
        return cls((metadata.width_px, metadata.height_px), rate_hz, pictures(), metadata)

    @classmethod
    def plain(cls, size: tuple[int, int], times: Array, background: Background) -> Self:
        """Return a picture of one colour for each frame of a motion. `size`: px. `times`: (T,) s."""

        def pictures() -> Iterator[Picture]:
            for i, time in enumerate(times.tolist()):
                image = np.full((size[1], size[0], 3), _COLOURS[background], dtype=np.uint8)
                yield Picture(image, time, time - float(times[0]), i, len(times))

        return cls(size, float(1 / np.median(np.diff(times))) if len(times) > 1 else 60.0, pictures())


def scale_of(size: tuple[int, int], view: PictureView) -> float:
    """Return pixels of a picture per pixel of a view's image.

    Where the sides differ, pixels were cut or added at the right or lower edge.

    `size`: width and height of the picture, px.
    """
    across, down = size[0] / view.camera.width_px, size[1] / view.camera.height_px
    return min((across, down), key=lambda scale: abs(scale - 1))


def check_size(path: str | Path, size: tuple[int, int], view: PictureView) -> tuple[str, ...]:
    """Return a sentence if some pixels of a video were cut off or added. `size`: width and height of it, px."""
    camera, scale = view.camera, scale_of(size, view)
    wrong = max(abs(size[0] - scale * camera.width_px), abs(size[1] - scale * camera.height_px))
    if wrong <= _ROUNDING_PX:
        return ()
    return (
        f"{path} is {size[0]} x {size[1]} px upright, the camera {camera.width_px} x "
        f"{camera.height_px}: taken as cut or extended by {wrong:.0f} px at the right or lower edge",
    )


def check_times(path: str | Path, metadata: VideoMetadata, view: PictureView, shift: float) -> tuple[str, ...]:
    """Return sentences on what does not fit between a video and a motion. `shift`: s, added to the times of the video.
    `InvalidInputError`: no frame of the video is at a time of the motion.
    """
    first, last = float(view.video_times[0]), float(view.video_times[-1])
    seconds, rate, notes = metadata.seconds, metadata.rate_hz, list[str]()
    step = float(np.median(np.diff(view.video_times))) if len(view.video_times) > 1 else 0.0
    span = f"the motion is from {first:.2f} to {last:.2f} s of the video that people were detected in"
    if seconds is not None:
        begin, end = shift, shift + seconds
        if end < first - step or begin > last + step:
            raise InvalidInputError(
                f"{path}: with --video-shift {shift:g} it is from {begin:.2f} to {end:.2f} s, but {span}; give "
                "that video, or by --video-shift how much later this one begins, s"
            )
        if end < last - 2 * step or begin > first + 2 * step:
            notes.append(
                f"{path} is from {begin:.2f} to {end:.2f} s, but {span}: is it another video, or a cut one? "
                "Then give by --video-shift how much later it begins, s"
            )
    if rate is not None and step > 0 and abs(rate * step - 1) > _RATE:
        notes.append(
            f"{path} has {rate:.2f} frames per second, the motion {1 / step:.2f}: poses are interpolated; "
            "is it the same video?"
        )
    return tuple(notes)


class Mp4Writer:
    """An MP4 of H.264; pictures keep their time stamps."""

    def __init__(self, path: Path, size: tuple[int, int], rate_hz: float):
        self._av = optional("av", "view")
        self.encoder = h264_encoder()
        self._path, self._size, self._rate = path, size, rate_hz
        self._first: float | None = None
        self._last = -1
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> Self:
        self._container = self._av.open(str(self._path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"})
        rate = Fraction(self._rate).limit_denominator(1001)
        stream = self._container.add_stream(self.encoder, rate=rate, options=_ENCODERS[self.encoder])
        width, height = self._size
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = stream.time_base = Fraction(1, _TICKS)
        context.max_b_frames = 0  # the first time stamp stays 0
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = 1  # 16 to 235
        self._stream = stream
        return self

    def write(self, image: Image, stamp: float) -> None:
        """Add a picture. `image`: (height, width, 3), BGR. `stamp`: s."""
        first = self._first = stamp if self._first is None else self._first
        base = self._stream.codec_context.time_base
        self._last = max(self._last + 1, round((stamp - first) / base))
        odd = image.shape[0] % 2, image.shape[1] % 2
        if any(odd):
            image = np.pad(image, ((0, odd[0]), (0, odd[1]), (0, 0)), mode="edge")
        frame = self._av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(image), format="bgr24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        frame.pts, frame.time_base = self._last, base
        self._mux(frame)

    def _mux(self, frame: Any) -> None:
        try:
            self._container.mux(self._stream.encode(frame))
        except self._av.FFmpegError as error:
            raise self._failed(error) from error

    def _failed(self, error: Exception) -> WritingError:
        reason = getattr(error, "strerror", None) or error
        return WritingError(f"{self._path.name}: cannot be written by {self.encoder} ({reason})")

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None and self._first is not None:
                self._mux(None)
        finally:
            try:
                self._container.close()
            except self._av.FFmpegError as error:
                if kind is None:  # else another error is on its way
                    raise self._failed(error) from error
