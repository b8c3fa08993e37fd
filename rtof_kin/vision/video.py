"""Detection of people in a video file or a webcam. No image is kept or written, and none leaves the machine.

found = detect_video("walk.mp4")                  # or detect_video(0, "models/", seconds=20): a webcam
write_detections("walk.npz", found)               # a file for recording.toml

Files are read by PyAV: upright however the camera was held, with the time stamps of the frames, also where
their rate varies. Webcams are read by OpenCV. Both come with the optional extra ``video``.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, reading
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.packages import optional
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.person_detector import Detector, choose_detector
from rtof_kin.vision.video_metadata import frame_count, frame_rate, open_video, slow_motion, upright_image

Progress = Callable[[str, int, int], None]
H264_ENCODERS: Final = ("libx264", "libopenh264")  #: Of those that are tried, the best first
_AHEAD: Final = 3  #: Images of a file that are decoded before they are looked at
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class VideoFrame:
    """One image of a video."""

    time: float  #: s, real time since the first frame
    image: NDArray[np.uint8]  #: (height, width, 3), BGR, upright
    index: int  #: Counted from 0
    total: int  #: Number of frames according to the file; 0 where unknown


def detect_video(
    source: str | Path | int,
    detector: Detector | str | Path | None = None,
    *,
    every: int = 1,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Detect the people in each frame of a video. The next images of a file are decoded meanwhile.

    Args:
        source: video file, or number of a webcam; a webcam may be stopped with Ctrl-C.
        detector: one that was not used for another video, or the models for `choose_detector`; None: the one at hand.
        every: look at every so many frames only: the motion has their rate.
        seconds: duration after which to stop; required for a webcam.
        progress: called with ("detect", frames done, frames in total).

    Raises:
        FileFormatError: the video or the models cannot be read, or no person was found.
        InvalidInputError: a webcam without `seconds`; `every` is less than 1. RtofError: no detector, or the extra is
            not installed.
    """
    if isinstance(source, int) and seconds is None:
        raise InvalidInputError(f"webcam {source}: give seconds, the duration of the recording")
    if every < 1:
        raise InvalidInputError(f"every: {every}; give 1 or more: 2 is every second frame")
    chosen = choose_detector(detector) if isinstance(detector, str | Path | None) else detector
    times: list[float] = []
    people: list[list[Person]] = []
    spent: list[float] = []
    frames = read_video(source, every)
    with closing(chosen), closing(frames if isinstance(source, int) else _ahead(frames)) as coming:
        try:
            for frame in coming:
                if seconds is not None and frame.time > seconds:
                    break
                began = time.perf_counter()
                seen = chosen.find(frame.image, frame.time)
                spent.append(time.perf_counter() - began)
                people.append(seen)
                times.append(frame.time)
                if progress is not None:
                    total = max(frame.total, frame.index + 1)
                    progress("detect", min(frame.index + every, total), total)
        except KeyboardInterrupt:
            if not isinstance(source, int) or not times:
                raise
    with reading(_name(source)):
        found = Detections.of_frames(dict(enumerate(people)), np.array(times))
    rate_hz = 1 / np.mean(spent[1:] or spent)  # the first image also prepares the model
    return replace(found, detector=f"{chosen.name}, {rate_hz:.3g} frames per second")


def _ahead(frames: Generator[VideoFrame]) -> Generator[VideoFrame]:
    """Generate frames that a thread decodes while the ones before are looked at."""
    with closing(frames), ThreadPoolExecutor(1) as thread:
        coming = deque(thread.submit(next, frames, None) for _ in range(_AHEAD))
        while (frame := coming.popleft().result()) is not None:
            yield frame
            coming.append(thread.submit(next, frames, None))


def read_video(source: str | Path | int, every: int = 1) -> Generator[VideoFrame]:
    """Generate the frames of a video file or a webcam, upright; every so many of them.

    Times are the time stamps of the file, in real time where it is slow motion (`VideoMetadata.slowed`), or follow from
    its frame rate where stamps are missing. Damaged parts of a file are skipped. `FileFormatError`: no such file, or
    not readable. `RtofError`: the extra is not installed.
    """
    return _webcam(source, every) if isinstance(source, int) else _file(source, every)


def _file(path: str | Path, every: int) -> Generator[VideoFrame]:
    with open_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        slowed = slow_motion(container, stream)
        total = frame_count(container, stream)
        rate_hz, index, first, now = frame_rate(stream), -1, None, -np.inf
        for index, frame in enumerate(_decoded(path, container, stream)):
            first = (frame.time or 0.0) if first is None else first
            now = _next_time(path, now, None if frame.time is None else frame.time - first, rate_hz)
            if index % every == 0:
                yield VideoFrame(now / slowed, upright_image(frame, stream), index, total)
        if index < 0:
            raise FileFormatError(path, "there is no readable frame in it")


def h264_encoder() -> str:
    """Return the name of the best encoder of H.264 that this PyAV has; `RtofError` where it has none."""
    known = [name for name in H264_ENCODERS if name in optional("av", "video").codecs_available]
    if not known:
        raise RtofError(f"this PyAV has none of the encoders {', '.join(H264_ENCODERS)}; install its wheel")
    return known[0]


def h264_frames(path: str | Path, size: tuple[int, int] | None = None) -> Iterator[tuple[float, bytes]]:
    """Generate the frames of a video file, encoded anew, upright: time, s, and an access unit of H.264 in Annex B,
    without B frames and with a key frame every 60, as Foxglove and Rerun decode them. size: width and height, px;
    default: those of the file. Errors as `read_video`.
    """
    av, encoder = optional("av", "video"), None
    for number, frame in enumerate(read_video(path)):
        width, height = (side // 2 * 2 for side in size or frame.image.shape[1::-1])
        if encoder is None:
            encoder = av.CodecContext.create(h264_encoder(), "w")
            encoder.width, encoder.height, encoder.pix_fmt, encoder.max_b_frames = width, height, "yuv420p", 0
            encoder.time_base, encoder.gop_size = Fraction(1, 1000), 60
            if encoder.name == "libx264":
                encoder.options = {"preset": "superfast", "tune": "zerolatency", "crf": "23"}
        image = av.VideoFrame.from_ndarray(frame.image, format="bgr24").reformat(width, height, "yuv420p")
        image.pts = number
        yield frame.time, b"".join(map(bytes, encoder.encode(image)))


def _next_time(path: str | Path, last: float, stamp: float | None, rate_hz: float | None) -> float:
    """Return the time after `last`, s: the time stamp where it increases, else by the frame rate."""
    if stamp is None or stamp <= last:
        if rate_hz is None:
            raise FileFormatError(path, "has neither times nor a frame rate; convert it first")
        stamp = last + 1 / rate_hz
    return max(stamp, 0.0)


def _decoded(path: str | Path, container: Any, stream: Any) -> Iterator[Any]:
    """Generate the frames of PyAV; damaged packets are skipped, and the end of a damaged file is its end."""
    av, damaged = optional("av", "video"), 0
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                break
            yield from packet.decode()
        except av.InvalidDataError:
            damaged += 1
    if damaged:
        _log.warning("%s: %d damaged parts were skipped", path, damaged)


def _webcam(number: int, every: int) -> Generator[VideoFrame]:
    cv2 = optional("cv2", "video")
    capture = cv2.VideoCapture(number)
    try:
        start, index = None, 0
        while capture.isOpened():
            read, image = capture.read()
            if not read:
                break
            now = time.monotonic()
            start = now if start is None else start
            if index % every == 0:
                yield VideoFrame(now - start, image, index, 0)
            index += 1
        if index == 0:
            raise FileFormatError(_name(number), "not a camera that OpenCV can read")
    finally:
        capture.release()


def _name(source: str | Path | int) -> str | Path:
    return f"webcam {source}" if isinstance(source, int) else source


def write_detections(path: str | Path, detections: Detections, overwrite: bool = False) -> None:
    """Write uv_px, confidence, times and points in space as an .npz file that `read_detector_file` reads; errors as
    `core.files.folder.new_file`.
    """
    arrays: dict[str, NDArray[Any]] = {**detections.about, "uv_px": detections.uv_px}
    arrays["confidence"] = detections.confidence
    if detections.times is not None:
        arrays["times"] = detections.times
    write_npz(Path(path), arrays, overwrite)
