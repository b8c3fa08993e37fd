"""Detection of people in a video file or a webcam by the user's ONNX models.

found = detect_video("walk.mp4", "models/")       # or detect_video(0, "models/", seconds=20)
write_detections("walk.npz", found)               # a file for recording.toml

The models are run by ``rtmlib`` (the optional extra ``video``). None ships with this package and none is
downloaded. The kind of a model follows from its inputs and outputs: RTMPose has outputs (K, x) and (K, y),
RTMO has boxes and keypoints, a person detector (YOLOX, RTMDet) has boxes only.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.vision.detections import Detections, Person

Progress = Callable[[str, int, int], None]
_INSTALL = "pip install 'rtof_kin[video]'"
_MODELS = (
    "put an RTMPose body model (body with feet gives 26 points, body 17) and, for more than one person "
    "or a person far away, a YOLOX or RTMDet person detector there as .onnx files; RTMPose's authors "
    "publish them under their own licences"
)


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
        FileFormatError: the video or the models cannot be read, or no person was found.
        InvalidInputError: a webcam without `seconds`. RtofError: the extra is not installed.
    """
    detector = _PersonDetector(models)
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
    cv2 = _library("cv2")
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


class _ModelFile(NamedTuple):
    """An ONNX file of a detector."""

    path: Path
    kind: Literal["pose", "pose and people", "people"]  # RTMPose, RTMO, or a person detector
    height: int  # of the input, px
    width: int
    points: int  # 0 for a person detector


def _library(name: str) -> Any:
    """Import a module of the optional extra."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise RtofError(
            f"{name} is not installed, which detecting people in a video needs ({error}): {_INSTALL}; "
            "model files are yours to provide"
        ) from error


def _find_models(folder: str | Path) -> tuple[_ModelFile, _ModelFile | None]:
    """Return the pose model of a folder and its person detector, if one is needed and present."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, f"there is no such folder of models; {_MODELS}")
    models = [_described(path) for path in sorted(folder.glob("*.onnx"))]
    poses = [model for model in models if model.points]
    people = [model for model in models if not model.points]
    if not poses:
        have = ", ".join(model.path.name for model in models) or "no .onnx file"
        raise FileFormatError(folder, f"no pose model in this folder, only {have}; {_MODELS}")
    for what, some in (("poses", poses), ("people", people)):
        if len(some) > 1:
            names = ", ".join(model.path.name for model in some)
            raise FileFormatError(folder, f"several models of {what}: {names}; leave one of them there")
    return poses[0], people[0] if people and poses[0].kind == "pose" else None


def _described(path: Path) -> _ModelFile:
    """Return the kind and sizes of an ONNX model from its inputs and outputs."""
    runtime = _library("onnxruntime")
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        raise FileFormatError(path, f"not a readable ONNX model: {error}") from error
    inputs = [tuple(value.shape) for value in session.get_inputs()]
    outputs = [tuple(value.shape) for value in session.get_outputs()]
    ranks = [len(shape) for shape in outputs]
    image = inputs[0] if len(inputs) == 1 else ()
    if len(image) != 4 or image[1] != 3 or not all(isinstance(n, int) for n in image[2:]):
        raise FileFormatError(path, f"its inputs {inputs} are not one image (N, 3, height, width)")
    kind: Literal["pose", "pose and people", "people"] = "people"
    points = 0
    if ranks == [3, 3] and outputs[0][1] == outputs[1][1]:
        kind, points = "pose", outputs[0][1]
    elif ranks == [3, 4]:
        kind, points = "pose and people", outputs[1][2]
    elif not ranks or ranks[0] != 3:
        raise FileFormatError(path, f"its outputs {outputs} are not RTMPose's, RTMO's, YOLOX's or RTMDet's")
    if not isinstance(points, int):
        raise FileFormatError(path, f"its outputs {outputs} do not state the number of points")
    return _ModelFile(path, kind, image[2], image[3], points)


class _PersonDetector:
    """Detector of people and their keypoints; without a person model the image is one person."""

    def __init__(self, folder: str | Path):
        pose, people = _find_models(folder)
        rtmlib = _library("rtmlib")
        self._one_stage = pose.kind != "pose"
        make = rtmlib.RTMO if self._one_stage else rtmlib.RTMPose
        size = (pose.height, pose.width) if self._one_stage else (pose.width, pose.height)
        self._pose = _loaded(make, pose, size)
        self._people: Any = None
        if people is not None:
            boxes = rtmlib.RTMDet if "rtmdet" in people.path.stem.lower() else rtmlib.YOLOX
            self._people = _loaded(boxes, people, (people.height, people.width))

    def find(self, image: NDArray[np.uint8]) -> list[Person]:
        """Return the people in an image (height, width, 3), BGR."""
        if self._one_stage:
            points, scores = self._pose(image)
        else:
            height, width = image.shape[:2]
            boxes = [[0, 0, width, height]] if self._people is None else self._people(image)
            if len(boxes) == 0:
                return []
            points, scores = self._pose(image, bboxes=boxes)
        people = [
            Person(np.column_stack([uv, np.clip(c, 0.0, 1.0)]).astype(np.float64))
            for uv, c in zip(points, scores, strict=True)
        ]
        return [person for person in people if np.any(person.points[:, 2] > 0)]


def _loaded(make: Any, model: _ModelFile, size: tuple[int, int]) -> Any:
    """Load a model; rtmlib prints while it does."""
    with contextlib.redirect_stdout(io.StringIO()):
        return make(str(model.path), model_input_size=size, backend="onnxruntime", device="cpu")
