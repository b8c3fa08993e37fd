"""People out of the JSON that detectors write: OpenPose, AlphaPose, COCO results, MMPose, MediaPipe.

The structure tells the format: what a frame is, where its people are, what a person's points are. Only
values are read; nothing in a file is ever executed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_json
from rtof_kin.vision.detections import NO_IDENTITY, Detections, Person

Array = NDArray[np.float64]
LARGEST_JSON = 256 * 2**20
"""A JSON file larger than this many bytes is refused."""
_WHAT = "JSON of moderate size; write one file a frame, or .npz"
_PEOPLE = ("people", "bodies", "instances")
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "joints", "keypoints", "pose_landmarks", "landmarks")
_SCORES = ("keypoint_scores", "visibility", "confidence", "score", "presence")
_IDENTITY = ("idx", "track_id", "person_id", "instance_id")
_MOST_FRAMES_EACH = 100
"""Frame numbers may leave gaps, but not so many per frame that is there."""


def read_json_folder(folder: Path) -> Detections:
    """One file a frame, as OpenPose's ``--write_json`` has it: the last number in each name counts them.

    The first file is the first frame; numbers that are left out are frames without anybody.
    """
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".json")
    if not paths:
        raise FileFormatError(folder, "there is no .json file in this folder")
    frames: dict[int, list[Person]] = {}
    for path in paths:
        number = _number(path.stem)
        if number is None or number in frames:
            raise FileFormatError(
                path, "its name has no frame number, or another file has the same; keep one video's "
                "files in a folder, named e.g. walk_000000000012_keypoints.json"
            )  # fmt: skip
        frames[number] = _people(path, load_json(path, LARGEST_JSON, _WHAT), "frame")
    first = min(frames)
    return _detections(folder, {number - first: people for number, people in frames.items()})


def read_json(path: Path) -> Detections:
    """One file with one or many frames."""
    data = load_json(path, LARGEST_JSON, _WHAT)
    if isinstance(data, list) and data and all(isinstance(e, dict) and "image_id" in e for e in data):
        return _by_image(path, data, None)
    if isinstance(data, list):
        return _of_list(path, data)
    if not isinstance(data, dict):
        raise FileFormatError(path, f"holds {_kind(data)}, not people's keypoints")
    if isinstance(data.get("annotations"), list):
        return _by_image(path, data["annotations"], data)
    for key in ("instance_info", "frames"):
        if isinstance(data.get(key), list):
            return _of_list(path, data[key])
    if any(key in data for key in (*_PEOPLE, *_POINTS)):
        return _detections(path, {0: _people(path, data, "frame 0")})
    return _by_name(path, data)


# --- frames --------------------------------------------------------------------------------------


def _of_list(path: Path, entries: Sequence[Any]) -> Detections:
    frames = [_people(path, entry, f"frame {i}") for i, entry in enumerate(entries)]
    stamps = [_time(entry) for entry in entries]
    times = None if None in stamps else np.array(stamps, dtype=np.float64)
    return _detections(path, dict(enumerate(frames)), times)


def _time(frame: Any) -> float | None:
    """Time of a frame, s, where it says."""
    if not isinstance(frame, dict):
        return None
    for key, unit in (("time", 1.0), ("time_s", 1.0), ("timestamp", 1.0), ("timestamp_ms", 1e-3)):
        value = frame.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value) * unit
    return None


def _by_name(path: Path, data: Mapping[str, Any]) -> Detections:
    """Frames by the names of their images, e.g. ``{"0.jpg": {"people": [...]}}``."""
    frames = {}
    for name, frame in data.items():
        number = _number(Path(name).stem)
        if number is None or number in frames:
            known = ", ".join((*_PEOPLE, "annotations", "instance_info", "frames"))
            raise FileFormatError(
                path, f"{name!r} is no frame's name with a number of its own, nor one of {known}"
            )
        frames[number] = _people(path, frame, f"frame {name}")
    return _detections(path, frames)


def _by_image(path: Path, entries: Sequence[Any], data: Mapping[str, Any] | None) -> Detections:
    """A list of people, each with the image they are in: AlphaPose's and COCO's."""
    frames: dict[int, list[Person]] = {}
    order = _image_order(data)
    for i, entry in enumerate(entries):
        where = f"entry {i}"
        if not isinstance(entry, dict) or "image_id" not in entry:
            raise FileFormatError(path, f"{where}: not a person with image_id and keypoints")
        image = entry["image_id"]
        number = order.get(image) if order is not None else _image_number(image)
        if number is None:
            raise FileFormatError(path, f"{where}: image_id {image!r} has no number, so no frame")
        people = frames.setdefault(number, [])
        if "keypoints" in entry:
            people.append(_person(path, entry, where))
    return _detections(path, frames, names=_category_names(data))


def _image_order(data: Mapping[str, Any] | None) -> dict[Any, int] | None:
    """Frame of each image where a COCO file lists its images: their order."""
    if data is None or not isinstance(data.get("images"), list):
        return None
    ids = [image["id"] for image in data["images"] if isinstance(image, dict) and "id" in image]
    return {image: i for i, image in enumerate(ids) if isinstance(image, int | str)}


def _category_names(data: Mapping[str, Any] | None) -> tuple[str, ...] | None:
    categories = data.get("categories") if data is not None else None
    if isinstance(categories, list) and len(categories) == 1 and isinstance(categories[0], dict):
        names = categories[0].get("keypoints")
        if isinstance(names, list) and all(isinstance(name, str) for name in names):
            return tuple(names)
    return None


def _image_number(image: Any) -> int | None:
    if isinstance(image, int) and not isinstance(image, bool):
        return image
    return _number(Path(image).stem) if isinstance(image, str) else None


def _number(stem: str) -> int | None:
    """The last number in a file's name."""
    found = re.findall(r"\d+", stem)
    return int(found[-1][:18]) if found else None


def _detections(
    path: Path, frames: Mapping[int, Sequence[Person]], times: Array | None = None,
    names: tuple[str, ...] | None = None,
) -> Detections:  # fmt: skip
    if frames and (min(frames) < 0 or max(frames) > _MOST_FRAMES_EACH * len(frames) + 1000):
        raise FileFormatError(
            path, f"its {len(frames)} frames are numbered from {min(frames)} to {max(frames)}; number "
            "them as in the video, from 0"
        )  # fmt: skip
    try:
        return Detections.of_frames(frames, times, names)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


# --- people --------------------------------------------------------------------------------------


def _people(path: Path, frame: Any, where: str) -> list[Person]:
    """The people of a frame, whatever way it lists them."""
    if frame is None:
        return []
    if isinstance(frame, dict):
        for key in _PEOPLE:
            if key in frame:
                return _people_listed(path, frame[key], f"{where}, {key}")
        found = next((frame[key] for key in _POINTS if key in frame), None)
        if not found and any(key in frame for key in _POINTS):
            return []
        several = isinstance(found, list) and isinstance(found[0], list) and not _is_person(found)
        return _people_listed(path, found, where) if several else [_person(path, frame, where)]
    if isinstance(frame, list):
        one = [{"keypoints": frame}] if _is_person(frame) else frame
        return _people_listed(path, one, where)
    raise FileFormatError(path, f"{where}: holds {_kind(frame)}, not people")


def _people_listed(path: Path, entries: Any, where: str) -> list[Person]:
    if not isinstance(entries, list):
        raise FileFormatError(path, f"{where}: holds {_kind(entries)}, not a list of people")
    people = []
    for i, entry in enumerate(entries):
        person = {"keypoints": entry} if isinstance(entry, list) else entry
        if isinstance(person, dict) and not any(person.get(key) for key in _POINTS):
            continue  # a person of whom nothing was found
        people.append(_person(path, person, f"{where}, person {i}"))
    return people


def _is_person(values: Sequence[Any]) -> bool:
    """Whether a list is one person's points: numbers, rows of two or three, or tables with x."""
    first = values[0] if values else None
    if isinstance(first, list):
        return len(first) in (2, 3) and all(isinstance(value, int | float) for value in first)
    return isinstance(first, int | float) or (isinstance(first, dict) and "x" in first)


def _person(path: Path, entry: Any, where: str) -> Person:
    """One person's points and identity."""
    if not isinstance(entry, dict):
        raise FileFormatError(path, f"{where}: holds {_kind(entry)}, not a person")
    values = next((entry[key] for key in _POINTS if key in entry), None)
    if not isinstance(values, list) or not values:
        known = ", ".join(_POINTS)
        raise FileFormatError(path, f"{where}: has none of the fields {known} with a list of points")
    try:
        points = _points(values, entry)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise FileFormatError(path, f"{where}: its points are not numbers ({error})") from error
    if points is None:
        raise FileFormatError(path, f"{where}: {len(values)} numbers are not x, y, confidence for each point")
    return Person(points, _identity(entry))


def _points(values: Sequence[Any], entry: Mapping[str, Any]) -> Array | None:
    """(K, 3) x, y, confidence; None where their number does not fit."""
    if isinstance(values[0], dict):
        return np.array([[float(v["x"]), float(v["y"]), _score(v)] for v in values])
    array = np.array(values, dtype=np.float64)
    if array.ndim == 1:
        if len(array) % 3:
            return None
        return _flags_to_confidence(array.reshape(-1, 3))
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        return None
    if array.shape[1] == 3:
        return array
    scores = np.array(entry.get("keypoint_scores", np.ones(len(array))), dtype=np.float64)
    return None if scores.shape != (len(array),) else np.column_stack([array, scores])


def _score(point: Mapping[str, Any]) -> float:
    value = next((point[key] for key in _SCORES if point.get(key) is not None), 1.0)
    return float(value)


def _flags_to_confidence(points: Array) -> Array:
    """COCO's annotations have 1 for hidden and 2 for visible instead of a confidence; both are seen."""
    flags = points[:, 2]
    if np.any(flags == 2) and np.all(np.isin(flags, (0, 1, 2))):
        points[:, 2] = np.minimum(flags, 1)
    return points


def _identity(entry: Mapping[str, Any]) -> int:
    for key in _IDENTITY:
        value = entry.get(key)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return int(value) if 0 <= value < 2**53 else NO_IDENTITY
    return NO_IDENTITY


def _kind(value: Any) -> str:
    names = {dict: "a table", list: "a list", str: "text", type(None): "nothing", bool: "true or false"}
    return names.get(type(value), "a number")
