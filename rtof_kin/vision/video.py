"""People in a video file or a webcam, by the user's models (`rtof_kin.vision.detector_models`).

found = detect_video("walk.mp4", "models/")       # or detect_video(0, "models/", seconds=20)
write_detections("walk.npz", found)               # a file for recording.toml
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.detector_models import PersonDetector, library

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class VideoFrame:
    """One image of a video."""

    time: float
    """s, from the file; for a webcam, since its first frame."""
    image: NDArray[np.uint8]
    """(height, width, 3), BGR."""
    index: int
    """Counted from 0."""
    total: int
    """Number of frames according to the file; 0 where unknown."""


def detect_video(
    source: str | Path | int,
    models: str | Path,
    *,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Detect the people in each frame of a video.

    Args:
        source: video file, or number of a webcam; a webcam may be stopped with Ctrl-C.
        models: folder of the user's .onnx files.
        seconds: duration after which to stop; required for a webcam.
        progress: called with ("detect", frames done, frames in total).

    Raises:
        FileFormatError: the video or the models cannot be read, or nobody was found.
        InvalidInputError: a webcam without `seconds`. RtofError: the extra is not installed.
    """
    detector = PersonDetector(models)
    if isinstance(source, int) and seconds is None:
        raise InvalidInputError(f"webcam {source}: give seconds, the duration of the recording")
    times: list[float] = []
    people: list[list[Person]] = []
    try:
        for frame in read_video(source):
            if seconds is not None and frame.time > seconds:
                break
            people.append(detector.find(frame.image))
            times.append(frame.time)
            if progress is not None:
                progress("detect", frame.index + 1, max(frame.total, frame.index + 1))
    except KeyboardInterrupt:
        if not isinstance(source, int) or not times:
            raise
    try:
        return Detections.of_frames(dict(enumerate(people)), np.array(times))
    except InvalidInputError as error:
        raise FileFormatError(_name(source), f"{error}") from error


def read_video(source: str | Path | int) -> Iterator[VideoFrame]:
    """Generate the frames of a video file or a webcam.

    Times are the time stamps of the file or, without those, follow from its frame rate.

    Args:
        source: video file, or number of a webcam.

    Raises:
        FileFormatError: no such file, or not readable by OpenCV.
        RtofError: the extra is not installed.
    """
    cv2 = library("cv2")
    if not isinstance(source, int) and not Path(source).is_file():
        raise FileFormatError(source, "there is no such video")
    capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
    try:
        if not capture.isOpened():
            raise FileFormatError(_name(source), "not a video or camera that OpenCV can read")
        clock = _WebcamClock() if isinstance(source, int) else _FileClock(source, cv2, capture)
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


class _WebcamClock:
    """Clock of a webcam: time since the first frame."""

    def __call__(self, index: int) -> float:
        now = time.monotonic()
        if index == 0:
            self._start = now
        return now - self._start


class _FileClock:
    """Times of a file's frames: its time stamps while they increase, else the frame rate."""

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
    """Write uv_px, confidence and times as an .npz file that `read_detector_file` reads.

    Args:
        path: .npz file. detections: of all people. overwrite: whether to replace an existing file.

    Raises:
        OutputExistsError: the file exists. RtofError: it cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {"uv_px": detections.uv_px, "confidence": detections.confidence}
    if detections.times is not None:
        arrays["times"] = detections.times
    write_npz(Path(path), arrays, overwrite)
