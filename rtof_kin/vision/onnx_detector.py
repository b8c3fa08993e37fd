"""People and their keypoints by ONNX models (RTMPose, RTMO; YOLOX, RTMDet), run by ``rtmlib``.

The kind of a model follows from its inputs and outputs: RTMPose has outputs (K, x) and (K, y), RTMO has boxes
and keypoints, a person detector (YOLOX, RTMDet) has boxes only.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.packages import optional
from rtof_kin.vision.detections import Person

_MODELS = (
    "put an RTMPose body model (body with feet gives 26 points, body 17) and, for more than one person "
    "or a person far away, a YOLOX or RTMDet person detector there as .onnx files"
)


class _ModelFile(NamedTuple):
    """An ONNX file of a detector."""

    path: Path
    kind: Literal["pose", "pose and people", "people"]  # RTMPose, RTMO, or a person detector
    height: int  # of the input, px
    width: int
    points: int  # 0 for a person detector


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
    runtime = optional("onnxruntime", "video")
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


class OnnxDetector:
    """Detector of people and their keypoints; without a person model the image is one person."""

    def __init__(self, folder: str | Path):
        """Load the models of a folder; rtmlib never downloads, as it gets files that exist.

        Raises:
            FileFormatError: no pose model, several of a kind, or another kind of model.
            RtofError: the extra ``video`` is not installed.
        """
        pose, people = _find_models(folder)
        rtmlib = optional("rtmlib", "video")
        self.points = pose.points
        self._one_stage = pose.kind != "pose"
        make = rtmlib.RTMO if self._one_stage else rtmlib.RTMPose
        size = (pose.height, pose.width) if self._one_stage else (pose.width, pose.height)
        self._pose = _loaded(make, pose, size)
        self._people: Any = None
        if people is not None:
            boxes = rtmlib.RTMDet if "rtmdet" in people.path.stem.lower() else rtmlib.YOLOX
            self._people = _loaded(boxes, people, (people.height, people.width))

        names = [model.path.name for model in (pose, people) if model is not None]
        self.name = " and ".join(names)

    def find(self, image: NDArray[np.uint8], time: float) -> list[Person]:  # noqa: ARG002
        """Return the people in an image.

        Args:
            image: (height, width, 3), BGR. time: of the image, s; not used.
        """
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

    def close(self) -> None:
        """Nothing to release."""


def _loaded(make: Any, model: _ModelFile, size: tuple[int, int]) -> Any:
    """Load a model; rtmlib prints while it does."""
    with contextlib.redirect_stdout(io.StringIO()):
        return make(str(model.path), model_input_size=size, backend="onnxruntime", device="cpu")
