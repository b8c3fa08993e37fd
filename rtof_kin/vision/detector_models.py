"""The user's own ONNX files of a 2D detector, run by ``rtmlib`` (the optional extra ``video``).

No model file comes with this package, and none is ever fetched: rtmlib is given local files alone. What
a file does is told by its inputs and outputs: RTMPose has two outputs (K, x) and (K, y); RTMO has boxes
and keypoints; anything with boxes alone finds people (YOLOX, RTMDet).
"""

from __future__ import annotations

import contextlib
import importlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.vision.detections import Person

INSTALL = "pip install 'rtof_kin[video]'"
MODELS = (
    "put an RTMPose body model (body with feet gives 26 points, body 17) and, for more than one person "
    "or a person far away, a YOLOX or RTMDet person detector there as .onnx files; RTMPose's authors "
    "publish them, and their licences are between them and you"
)


@dataclass(frozen=True)
class ModelFile:
    """What an ONNX file is."""

    path: Path
    kind: str
    """'pose' (RTMPose), 'pose and people' (RTMO) or 'people'."""
    height: int
    """Of its input, px."""
    width: int
    """Of its input, px."""
    points: int
    """How many points it finds; 0 for 'people'."""


def library(name: str) -> Any:
    """A module of the optional extra.

    Raises:
        RtofError: it is not installed; the message says how to get it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise RtofError(
            f"{name} is not installed, which detecting people in a video needs ({error}): {INSTALL}; "
            "model files are yours to provide"
        ) from error


def find_models(folder: str | Path) -> tuple[ModelFile, ModelFile | None]:
    """The model of poses in a folder, and the one that finds people, where there is one.

    Raises:
        FileFormatError: no such folder, no model of poses in it, several of a kind, or a damaged file.
        RtofError: the extra is not installed.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, f"there is no such folder of models; {MODELS}")
    models = [describe(path) for path in sorted(folder.glob("*.onnx"))]
    poses = [model for model in models if model.points]
    people = [model for model in models if not model.points]
    if not poses:
        have = ", ".join(model.path.name for model in models) or "no .onnx file"
        raise FileFormatError(folder, f"no model of poses in this folder, only {have}; {MODELS}")
    for what, some in (("poses", poses), ("people", people)):
        if len(some) > 1:
            names = ", ".join(model.path.name for model in some)
            raise FileFormatError(folder, f"several models of {what}: {names}; leave one of them there")
    return poses[0], people[0] if people and poses[0].kind == "pose" else None


def describe(path: Path) -> ModelFile:
    """What an ONNX file is, from its inputs and outputs.

    Raises:
        FileFormatError: not an ONNX model, or none of those known.
    """
    try:
        session = library("onnxruntime").InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except RtofError:
        raise
    except Exception as error:  # onnxruntime's errors have no common base
        raise FileFormatError(path, f"not a readable ONNX model: {error}") from error
    inputs = [tuple(value.shape) for value in session.get_inputs()]
    outputs = [tuple(value.shape) for value in session.get_outputs()]
    ranks = [len(shape) for shape in outputs]
    image = inputs[0] if len(inputs) == 1 else ()
    if len(image) != 4 or image[1] != 3 or not all(isinstance(n, int) for n in image[2:]):
        raise FileFormatError(path, f"its inputs {inputs} are not one image (N, 3, height, width)")
    kind, points = "people", 0
    if ranks == [3, 3] and outputs[0][1] == outputs[1][1]:
        kind, points = "pose", outputs[0][1]
    elif ranks == [3, 4]:
        kind, points = "pose and people", outputs[1][2]
    elif not ranks or ranks[0] != 3:
        known = "RTMPose's, RTMO's, YOLOX's or RTMDet's"
        raise FileFormatError(path, f"its outputs {outputs} are not {known}")
    if not isinstance(points, int):
        raise FileFormatError(path, f"its outputs {outputs} do not say how many points it finds")
    return ModelFile(path, kind, image[2], image[3], points)


class PersonDetector:
    """Finds people and their points in images.

    Attributes:
        pose: the model of poses. people: the one that finds people; without one, everything in the image
            counts as one person.
    """

    def __init__(self, folder: str | Path):
        """Load the models of a folder; see `find_models` for what is raised."""
        self.pose, self.people = find_models(folder)
        rtmlib = library("rtmlib")
        makers = {"pose": rtmlib.RTMPose, "pose and people": rtmlib.RTMO}
        size = (self.pose.width, self.pose.height)
        self._one_stage = self.pose.kind != "pose"
        self._pose = _quietly(makers[self.pose.kind], self.pose, size[::-1] if self._one_stage else size)
        self._people: Any = None
        if self.people is not None:
            boxes = rtmlib.RTMDet if "rtmdet" in self.people.path.stem.lower() else rtmlib.YOLOX
            self._people = _quietly(boxes, self.people, (self.people.height, self.people.width))

    def find(self, image: NDArray[np.uint8]) -> list[Person]:
        """The people in one image (height, width, 3), as OpenCV reads it."""
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


def _quietly(make: Any, model: ModelFile, size: tuple[int, int]) -> Any:
    """A model of rtmlib, which prints when it loads one."""
    with contextlib.redirect_stdout(io.StringIO()):
        return make(str(model.path), model_input_size=size, backend="onnxruntime", device="cpu")
