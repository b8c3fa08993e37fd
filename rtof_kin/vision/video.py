"""People in a video file or in front of a webcam, by the user's own models (`rtof_kin.vision.detector_models`).

found = detect_video("walk.mp4", "models/")       # or detect_video(0, "models/", seconds=20)
write_detections("walk.npz", found)               # which recording.toml can name
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.detector_models import PersonDetector, library

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class VideoFrame:
    """One image and when it was taken."""

    time: float
    """s, from the file; of a webcam, since its first frame."""
    image: NDArray[np.uint8]
    """(height, width, 3), as OpenCV reads it."""
    index: int
    """Counted from 0."""
    total: int
    """How many frames the file says it has; 0 where that is not known."""


def detect_video(
    source: str | Path | int,
    models: str | Path,
    *,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Everybody's points in each frame of a video.

    Args:
        source: a video file, or the number of a webcam.
        models: folder of the user's .onnx files.
        seconds: stop after so many; needed for a webcam, which never ends. A webcam may also be stopped
            with Ctrl-C: what was seen so far is returned.
        progress: called with ("detect", frames done, frames in all).

    Raises:
        FileFormatError: the video or the models cannot be read, or nobody was found.
        RtofError: the extra is not installed.
    """
    detector = PersonDetector(models)
    if isinstance(source, int) and seconds is None:
        raise ShapeError(f"webcam {source}: give seconds, how long to look; it never ends by itself")
    times: list[float] = []
    frames: list[list[Person]] = []
    try:
        for frame in read_video(source):
            if seconds is not None and frame.time > seconds:
                break
            frames.append(detector.find(frame.image))
            times.append(frame.time)
            if progress is not None:
                progress("detect", frame.index + 1, max(frame.total, frame.index + 1))
    except KeyboardInterrupt:
        if not isinstance(source, int) or not times:
            raise
    try:
        return Detections.of_frames(frames, np.array(times))
    except InvalidInputError as error:
        raise FileFormatError(_name(source), f"{error}") from error


def read_video(source: str | Path | int) -> Iterator[VideoFrame]:
    """The frames of a video file or of a webcam.

    Times are the file's own; where it has none, they follow from its frame rate.

    Raises:
        FileFormatError: no such file, or not a video that OpenCV can read.
        RtofError: the extra is not installed.
    """
    cv2 = library("cv2")
    if not isinstance(source, int) and not Path(source).is_file():
        raise FileFormatError(source, "there is no such video")
    capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
    try:
        if not capture.isOpened():
            raise FileFormatError(_name(source), "not a video or camera that OpenCV can read")
        clock = _webcam_clock() if isinstance(source, int) else _FileClock(source, cv2, capture)
        total = 0 if isinstance(source, int) else max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        index = 0
        while True:
            read, image = capture.read()
            if not read:
                break
            yield VideoFrame(clock(index), image, index, total)
            index += 1
        if index == 0:
            raise FileFormatError(_name(source), "there is no frame in it that OpenCV can read")
    finally:
        capture.release()


def _name(source: str | Path | int) -> str | Path:
    return f"webcam {source}" if isinstance(source, int) else source


def _webcam_clock() -> Callable[[int], float]:
    started: list[float] = []

    def clock(_: int) -> float:
        started.append(time.monotonic()) if not started else None
        return time.monotonic() - started[0]

    return clock


class _FileClock:
    """Times of a file's frames: its time stamps as long as they increase, else its frame rate's."""

    def __init__(self, path: str | Path, cv2: Any, capture: Any):
        self._path, self._capture, self._stamp = path, capture, cv2.CAP_PROP_POS_MSEC
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        self._step = 1 / rate if np.isfinite(rate) and 1e-3 < rate < 1e5 else None
        self._last = -np.inf

    def __call__(self, index: int) -> float:
        stamp = float(self._capture.get(self._stamp)) / 1000
        if not (np.isfinite(stamp) and stamp > self._last):
            if self._step is None:
                raise FileFormatError(self._path, "has neither times nor a frame rate; convert it first")
            stamp = self._last + self._step if index else 0.0
        self._last = stamp
        return stamp


def write_detections(path: str | Path, detections: Detections, overwrite: bool = False) -> None:
    """Write what `rtof_kin.vision.keypoint_files` reads back: uv_px, confidence and times.

    Raises:
        OutputExistsError: it exists and overwriting was not asked for. RtofError: it cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {"uv_px": detections.uv_px, "confidence": detections.confidence}
    if detections.times is not None:
        arrays["times"] = detections.times
    write_npz(Path(path), arrays, overwrite)
