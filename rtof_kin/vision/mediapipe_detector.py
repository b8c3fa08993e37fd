"""People and their 33 keypoints by MediaPipe's Pose Landmarker.

Older packages (0.10) contain its models, newer ones (1.x) need a ``.task`` file. Both are run in the same
way: contained models are bundled, in memory, with what a bundle states beside them, the normalisation of
images to [-1, 1] for the detector of people and to [0, 1] for the landmarks.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.packages import optional
from rtof_kin.vision.detections import Person

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
        """Load a model.

        Args:
            model: ``.task`` file; None: the model inside the package.

        Raises:
            FileFormatError: it cannot be read. RtofError: MediaPipe is not installed, or without a model.
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

    def find(self, image: NDArray[np.uint8], time: float) -> list[Person]:
        """Return the people in the next image of a video, the surest first.

        Args:
            image: (height, width, 3), BGR. time: of the image, s.
        """
        self._stamp_ms = max(self._stamp_ms + 1, round(1000 * time))
        rgb = np.ascontiguousarray(image[..., ::-1])
        picture = self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=rgb)
        with contextlib.nullcontext() if self._started else _native_messages_hidden():
            found = self._landmarker.detect_for_video(picture, self._stamp_ms)
        self._started |= bool(found.pose_landmarks)
        height, width = image.shape[:2]
        return _without_doubles([Person(_points(each, width, height)) for each in found.pose_landmarks])

    def close(self) -> None:
        """Release the model."""
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
