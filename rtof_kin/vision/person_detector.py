"""`choose_detector`: the detector of people that is at hand, or one message that says what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.vision.detections import Person
from rtof_kin.vision.mediapipe_detector import MediaPipeDetector, contained_models
from rtof_kin.vision.model_download import ModelSet, cached_models, model_sets
from rtof_kin.vision.onnx_detector import OnnxDetector


class PersonDetector(Protocol):
    """Finds the people in consecutive images of one video and their keypoints."""

    name: str
    """Its models, for people."""
    points: int
    """Number of points of a person."""

    def find(self, image: NDArray[np.uint8], time: float) -> list[Person]:
        """Return the people in the next image.

        Args:
            image: (height, width, 3), BGR, upright. time: of the image, s.
        """

    def close(self) -> None:
        """Release what it holds."""


def choose_detector(models: str | Path | None = None) -> PersonDetector:
    """Return the given detector, else one of downloaded models, else MediaPipe's own. Downloads nothing.

    Args:
        models: folder of .onnx files, folder with a .task file, or a .task file; None: whatever is at hand.

    Raises:
        FileFormatError: the given models, or downloaded ones, cannot be used.
        RtofError: no detector is at hand; the message has the commands that provide one.
    """
    if models is not None:
        return _given(Path(models))
    for wanted in model_sets():
        if not wanted.missing and (folder := cached_models(wanted)) is not None:
            return _given(folder)
    if contained_models() is not None:
        return MediaPipeDetector()
    raise RtofError(_missing())


def _given(path: Path) -> PersonDetector:
    if path.suffix.lower() == ".task":
        return MediaPipeDetector(path)
    bundles = sorted(path.glob("*.task")) if path.is_dir() else []
    if not bundles or any(path.glob("*.onnx")):
        return OnnxDetector(path)
    if len(bundles) > 1:
        names = ", ".join(bundle.name for bundle in bundles)
        raise FileFormatError(path, f"several models: {names}; leave one of them there")
    return MediaPipeDetector(bundles[0])


def _missing() -> str:
    """Return what would provide a detector, as one message with commands."""
    ways = [_way(wanted) for wanted in model_sets()]
    ways.append("your own .onnx or .task models: --model-dir DIR")
    ways.append("keypoints of another program: give their file instead of the video")
    listed = "\n".join(f"  {i}. {way}" for i, way in enumerate(ways, 1))
    return f"no detector of people is at hand, and nothing is downloaded unasked. Choose one:\n{listed}"


def _way(wanted: ModelSet) -> str:
    needed = f"{wanted.install}, then " if wanted.missing else ""
    what = f"downloads {wanted.title}, {wanted.megabytes} MB, licence {wanted.licence}"
    return f"{needed}add --fetch-models {wanted.name}: {what}"
