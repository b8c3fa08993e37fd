"""`choose_detector`: the detector of people that is at hand, or one message that says what is missing.

People and their 33 keypoints by MediaPipe's Pose Landmarker. Older packages (0.10) contain its models, newer ones (1.x)
need a ``.task`` file. Both are run in the same way: contained models are bundled, in memory, with what a bundle states
beside them, the normalisation of images to [-1, 1] for the detector of people and to [0, 1] for the landmarks.

People and their keypoints by ONNX models, run by the classes of ``rtmlib`` in ONNX Runtime on the processor or, by an
execution provider, on a graphics card. Which class runs a model follows from its outputs (`_class_of`).
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.choices import Provider
from rtof_kin.core.errors import FileFormatError, InvalidInputError, MissingPackageError, RtofError, reading
from rtof_kin.core.packages import optional
from rtof_kin.vision.detections import Person
from rtof_kin.vision.model_download import cached_models, model_sets

Image = NDArray[np.uint8]


class Detector(Protocol):
    """Finds the people in consecutive images of one video and their keypoints."""

    name: str  #: Its models, for people
    points: int  #: Number of points of a person

    def find(self, image: Image, time: float) -> list[Person]:
        """Return the people in the next image. image: (height, width, 3), BGR, upright. time: of the image, s."""

    def close(self) -> None:
        """Release what it holds."""


_SURE, _MARGIN = 0.3, 0.125
"""Least score of a point by which a person is followed; space on either side of such points, as a share of theirs."""
_WANTED = (
    "put an RTMPose body model (body with feet gives 26 points, body 17) and, for more than one person "
    "or a person far away, a YOLOX or RTMDet person detector there as .onnx files"
)
_ALONE: Final = "pip uninstall onnxruntime, then pip install"
_PROVIDERS: Final[dict[Provider, tuple[str, str]]] = {
    "cpu": ("CPUExecutionProvider", "pip install onnxruntime"),
    "cuda": ("CUDAExecutionProvider", f'{_ALONE} "onnxruntime-gpu[cuda,cudnn]" (an NVIDIA card and its driver)'),
    "coreml": ("CoreMLExecutionProvider", "pip install onnxruntime, on a Mac"),
    "openvino": ("OpenVINOExecutionProvider", f"{_ALONE} onnxruntime-openvino (Intel; Linux, Windows)"),
}
"""Provider -> its name in ONNX Runtime, and what brings it."""


class _Model(NamedTuple):
    """An ONNX model, loaded."""

    path: Path
    kind: str  #: Class of ``rtmlib`` that runs it
    points: int  #: 0 of one that finds people only
    size_px: tuple[int, int]  #: Height and width of the input
    session: Any


def _find_models(folder: str | Path, provider: Provider) -> tuple[_Model, _Model | None]:
    """Return the pose model of a folder and its person detector, if one is needed and present."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, f"there is no such folder of models; {_WANTED}")
    models = [_loaded(path, provider) for path in sorted(folder.glob("*.onnx"))]
    poses = [model for model in models if model.points]
    people = [model for model in models if not model.points]
    if not poses:
        have = ", ".join(model.path.name for model in models) or "no .onnx file"
        raise FileFormatError(folder, f"no pose model in this folder, only {have}; {_WANTED}")
    for what, some in (("poses", poses), ("people", people)):
        if len(some) > 1:
            names = ", ".join(model.path.name for model in some)
            raise FileFormatError(folder, f"several models of {what}: {names}; leave one of them there")
    return poses[0], people[0] if people and poses[0].kind != "RTMO" else None


def _loaded(path: Path, provider: Provider) -> _Model:
    """Load a model, and recognise it by its inputs and outputs."""
    runtime = optional("onnxruntime", "video")
    name, remedy = _PROVIDERS[provider]
    if name not in (have := runtime.get_available_providers()):
        known = ", ".join(one.removesuffix("ExecutionProvider") for one in have)
        raise MissingPackageError(f"provider {provider}: ONNX Runtime has {known} here; {remedy}")
    with _native_messages_hidden(), contextlib.redirect_stdout(io.StringIO()):
        if provider == "cuda" and hasattr(runtime, "preload_dlls"):
            runtime.preload_dlls()  # of NVIDIA's Python packages
        with reading(path, "not a readable ONNX model: {}", Exception):  # onnxruntime's errors have no common base
            session = runtime.InferenceSession(str(path), providers=list(dict.fromkeys([name, _PROVIDERS["cpu"][0]])))
    if name not in session.get_providers():
        raise MissingPackageError(f"provider {provider}: does not start, its driver or libraries are missing; {remedy}")
    inputs = [tuple(value.shape) for value in session.get_inputs()]
    image = inputs[0] if len(inputs) == 1 else ()
    if len(image) != 4 or image[1] != 3 or not all(isinstance(n, int) for n in image[2:]):
        raise FileFormatError(path, f"its inputs {inputs} are not one image (N, 3, height, width)")
    outputs = [tuple(value.shape) for value in session.get_outputs()]
    kind, points = _class_of(path, outputs)
    if not isinstance(points, int):
        raise FileFormatError(path, f"its outputs {outputs} do not state the number of points")
    return _Model(path, kind, points, image[2:], session)


def _class_of(path: Path, outputs: list[tuple[Any, ...]]) -> tuple[str, Any]:
    """Return the class of ``rtmlib`` that runs a model, and its number of points K; 0 of one that gives boxes only."""
    ranks, K = [len(shape) for shape in outputs], [shape[1] for shape in outputs if len(shape) > 1]
    if ranks == [3, 3] and outputs[0][2] == 4:  # boxes and classes
        return "RFDETR", 0
    if ranks in ([3, 3], [3, 3, 3]) and len(set(K)) == 1:  # a line of scores along x, y (and z)
        return ("RTMPose", "RTMPose3d")[len(ranks) - 2], K[0]
    if ranks == [4]:  # an image of scores
        return "ViTPose", K[0]
    if ranks == [3, 4]:  # boxes and points
        return "RTMO", outputs[1][2]
    if ranks[:1] == [3]:
        return "RTMDet" if "rtmdet" in path.stem.lower() else "YOLOX", 0
    raise FileFormatError(path, f"its outputs {outputs} are not RTMPose's, ViTPose's, RTMO's, YOLOX's or RTMDet's")


class RtmlibDetector:
    """People and points by a class of ``rtmlib`` that takes an image alone: RTMO, Body, BodyWithFeet, Wholebody,
    Wholebody3d, Custom, PoseTracker.

    `model`: gives points and scores of each person, one in space last also the points in the image, px. `points`:
    number of points of a person. `name`: for people; default: the class.
    """

    def __init__(self, model: Callable[[Image], Any], points: int, name: str = ""):
        """Take a model that is loaded."""
        self._model, self.points, self.name = model, points, name or f"rtmlib's {type(model).__name__}"

    def find(self, image: Image, time: float) -> list[Person]:  # noqa: ARG002
        """Return the people in an image. image: (height, width, 3), BGR. time: of the image, s; not used."""
        points, scores, *in_space = self._model(image)
        people = [
            Person(np.column_stack([uv, np.clip(c, 0.0, 1.0)]).astype(np.float64))
            for uv, c in zip(in_space[-1] if in_space else points, scores, strict=True)
        ]
        return [person for person in people if np.any(person.points[:, 2] > 0)]

    def close(self) -> None:
        """Nothing to release."""


class OnnxDetector(RtmlibDetector):
    """Detector of people and their keypoints; without a person model the image is one person.

    People may be found in some images only, and looked for around their last points in those between (Bazarevsky et
    al., BlazePose, 2020; Jiang et al., RTMPose, 2023), but are found anew where one of them has become unsure.
    """

    def __init__(self, folder: str | Path, provider: Provider = "cpu", people_every: int = 1):
        """Load the models of a folder; rtmlib never downloads, as it gets files that exist. `people_every`: people are
        found in every so many images. `FileFormatError` without pose model, for several of a kind, or another kind;
        `InvalidInputError`: `people_every` is less than 1; `RtofError` without the extra ``video`` or the provider.
        """
        pose, people = _find_models(folder, provider)
        points, boxes = _run(pose), None if people is None else _run(people)
        if people_every < 1:
            raise InvalidInputError(f"people_every: {people_every}; give 1 or more: 10 is in every tenth image")
        self._around: list[NDArray[np.float64]] = []
        self._every, self._since = people_every, -1

        def of_boxes(image: Image) -> Any:
            height, width = image.shape[:2]
            self._since = (self._since + 1) % people_every
            found: Any = self._around if self._since else []
            if not len(found):
                found, self._since = [[0, 0, width, height]] if boxes is None else boxes(image), 0
            return points(image, bboxes=found) if len(found) else ([], [])

        names = " and ".join(model.path.name for model in (pose, people) if model is not None)
        super().__init__(points if pose.kind == "RTMO" else of_boxes, pose.points, f"{names} on {provider}")

    def find(self, image: Image, time: float) -> list[Person]:
        """Return the people in the next image of a video. image: (height, width, 3), BGR. time: of the image, s."""
        people = super().find(image, time)
        if self._every > 1:
            people = _without_doubles(people)
            self._around = _around(people)
        return people


def _around(people: list[Person]) -> list[NDArray[np.float64]]:
    """Return boxes x, y, x, y, px, around the sure points of people; none where one has few."""
    boxes = []
    for person in people:
        uv = person.points[person.points[:, 2] > _SURE, :2]
        if len(uv) < len(person.points) / 2:
            return []
        low, high = uv.min(axis=0), uv.max(axis=0)
        boxes.append(np.concatenate([low, high]) + _MARGIN * np.concatenate([low - high, high - low]))
    return boxes


def _run(model: _Model) -> Callable[..., Any]:
    """Return the class of ``rtmlib`` that runs a model, in the session that is loaded."""
    size = model.size_px[::-1] if model.kind in ("RTMPose", "RTMPose3d", "ViTPose") else model.size_px
    make = getattr(optional("rtmlib", "video"), model.kind)
    with contextlib.redirect_stdout(io.StringIO()):
        run: Any = make(str(model.path), model_input_size=size, backend="onnxruntime", device="cpu")
    run.session = model.session
    return run  # type: ignore[no-any-return]


MOST_PEOPLE: Final = 4
"""People that are looked for; with more than one, MediaPipe does not smooth, which would delay the points."""
_DOUBLE = 0.4
"""Median distance of the points of two people, in sizes of one, below which they are the same. On two real
videos of two people these were 0.5 and more apart, and two findings of one person rarely."""
_WRITER = "mediapipe.tasks.python.metadata.metadata_writers.metadata_writer"
_MODELS = {
    "pose_detector.tflite": ("pose_detection/pose_detection.tflite", 127.5, 127.5),
    "pose_landmarks_detector.tflite": ("pose_landmark/pose_landmark_full.tflite", 0.0, 255.0),
}
"""Name in a bundle -> file in the package, mean and standard deviation of its image."""


def contained_models() -> dict[str, Path] | None:
    """Return the models inside the installed package by their names in a bundle; None if it has none."""
    found = importlib.util.find_spec("mediapipe")
    if found is None or not found.submodule_search_locations:
        return None
    folder = Path(next(iter(found.submodule_search_locations))) / "modules"
    files = {name: folder / file for name, (file, _, _) in _MODELS.items()}
    return files if all(path.is_file() for path in files.values()) else None


class MediaPipeDetector:
    """MediaPipe's Pose Landmarker on consecutive frames of one video."""

    points: int = 33

    def __init__(self, model: str | Path | None = None, people: int = MOST_PEOPLE):
        """Load a model, by default the ``.task`` file inside the package; `FileFormatError` where it cannot be read,
        `RtofError` without MediaPipe, or where that has no model.
        """
        self._mediapipe = optional("mediapipe", "mediapipe")
        tasks = optional("mediapipe.tasks.python", "mediapipe")
        vision = optional("mediapipe.tasks.python.vision", "mediapipe")
        self.name = "MediaPipe Pose Landmarker" + ("" if model is None else f" ({Path(model).name})")
        if model is not None and not Path(model).is_file():
            raise FileFormatError(model, "there is no such model")
        bundle = _bundle() if model is None else Path(model).read_bytes()
        try:
            options = vision.PoseLandmarkerOptions(
                base_options=tasks.BaseOptions(model_asset_buffer=bundle),
                running_mode=vision.RunningMode.VIDEO,
                num_poses=people,
            )
            with _native_messages_hidden():
                self._landmarker = vision.PoseLandmarker.create_from_options(options)
        except (RuntimeError, ValueError, OSError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise FileFormatError(model or "MediaPipe's own model", f"not loaded: {reason}") from error
        self._stamp_ms, self._started = -1, False

    def find(self, image: Image, time: float) -> list[Person]:
        """Return the people in the next image (height, width, 3), BGR, of a video, at a time, s, the surest first."""
        self._stamp_ms = max(self._stamp_ms + 1, round(1000 * time))
        rgb = np.ascontiguousarray(image[..., ::-1])
        picture = self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=rgb)
        with contextlib.nullcontext() if self._started else _native_messages_hidden():
            found = self._landmarker.detect_for_video(picture, self._stamp_ms)
        self._started |= bool(found.pose_landmarks)
        height, width = image.shape[:2]
        in_space = (np.array([[p.x, p.y, p.z] for p in each]) for each in found.pose_world_landmarks)
        pairs = zip(found.pose_landmarks, in_space, strict=True)
        return _without_doubles([Person(_points(each, width, height), p_model=p) for each, p in pairs])

    def close(self) -> None:
        """Release the model."""
        with _native_messages_hidden():
            self._landmarker.close()


@contextlib.contextmanager
def _native_messages_hidden() -> Iterator[None]:
    """Hide what C++ libraries write to the error stream: notes on their build. Exceptions stay."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _points(landmarks: Any, width: int, height: int) -> NDArray[np.float64]:
    """Return (33, 3) x, y in px and visibility; landmarks outside the image are extrapolated ones: 0."""
    points = np.array([[p.x, p.y, p.visibility] for p in landmarks], dtype=np.float64)
    inside = np.all((points[:, :2] >= 0) & (points[:, :2] <= 1), axis=1)
    points[:, 2] = np.where(inside, np.clip(points[:, 2], 0.0, 1.0), 0.0)
    return points * [width, height, 1]


def _without_doubles(people: list[Person]) -> list[Person]:
    """Return the people without the less sure of two findings of one person, which MediaPipe often makes."""
    kept: list[Person] = []
    for person in sorted(people, key=lambda each: -float(each.points[:, 2].sum())):
        uv = person.points[:, :2]
        near = (np.median(np.linalg.norm(uv - other.points[:, :2], axis=1)) for other in kept)
        if all(far > _DOUBLE * np.ptp(uv, axis=0).max() for far in near):
            kept.append(person)
    return kept


def _bundle() -> bytes:
    """Return the package's own models as a ``.task`` bundle."""
    files = contained_models()
    if files is None:
        raise RtofError("this version of MediaPipe contains no model: give a .task file, or fetch one")
    writer = optional(_WRITER, "mediapipe").MetadataWriter
    bundle = io.BytesIO()
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_STORED) as archive:
        for name, path in files.items():
            _, mean, sd = _MODELS[name]
            described = writer.create(bytearray(path.read_bytes())).add_image_input([mean], [sd])
            archive.writestr(name, bytes(described.populate()[0]))
    return bundle.getvalue()


def choose_detector(models: str | Path | None = None, provider: Provider = "cpu", people_every: int = 1) -> Detector:
    """Return the given detector (folder of .onnx files or with a .task file, or a .task file), else one of downloaded
    models, else MediaPipe's own. `provider`, `people_every`: of .onnx models, see `OnnxDetector`. Downloads nothing.
    `FileFormatError`: the models cannot be used; `RtofError`: the provider is not at hand, or no detector; the message
    has the commands that provide one.
    """
    if models is not None:
        return _given(Path(models), provider, people_every)
    for wanted in model_sets():
        if not wanted.missing and (folder := cached_models(wanted)) is not None:
            return _given(folder, provider, people_every)
    if contained_models() is not None:
        return _mediapipe(None, provider)
    ways = []
    for wanted in model_sets():
        needed = f"{wanted.install}, then " if wanted.missing else ""
        what = f"downloads {wanted.title}, {wanted.megabytes} MB, licence {wanted.licence}"
        ways.append(f"{needed}add --fetch-models {wanted.name}: {what}")
    ways.append("your own .onnx or .task models: --model-dir DIR")
    ways.append("keypoints of another program: give their file instead of the video")
    listed = "\n".join(f"  {i}. {way}" for i, way in enumerate(ways, 1))
    raise RtofError(f"no detector of people is at hand, and nothing is downloaded unasked. Choose one:\n{listed}")


def _given(path: Path, provider: Provider, people_every: int) -> Detector:
    if path.suffix.lower() == ".task":
        return _mediapipe(path, provider)
    bundles = sorted(path.glob("*.task")) if path.is_dir() else []
    if not bundles or any(path.glob("*.onnx")):
        return OnnxDetector(path, provider, people_every)
    if len(bundles) > 1:
        names = ", ".join(bundle.name for bundle in bundles)
        raise FileFormatError(path, f"several models: {names}; leave one of them there")
    return _mediapipe(bundles[0], provider)


def _mediapipe(model: Path | None, provider: Provider) -> Detector:
    if provider != "cpu":
        ways = "take such models (--fetch-models rtmpose, --model-dir DIR), or leave the provider out"
        raise InvalidInputError(f"provider {provider}: runs .onnx models, and MediaPipe's is none; {ways}")
    return MediaPipeDetector(model)
