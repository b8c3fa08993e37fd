"""Readers of detectors' files: a folder or a file of JSON, arrays in .npz or .npy, columns in .csv.

==========================  ====================================================================
OpenPose                    folder of ``*_keypoints.json``, one a frame, or one JSON with many
AlphaPose, COCO results     one JSON: a list of ``image_id`` ("12.jpg" or 12: frame 12) and ``keypoints``
COCO annotations            one JSON with ``images``, ``annotations``, ``categories``
MMPose                      one JSON with ``instance_info``, or a list of frames with ``instances``
rtmlib                      what its models return, per frame: ``keypoints`` (P, K, 2) and ``scores`` (P, K)
MediaPipe                   one JSON: frames of ``x``, ``y``, ``visibility``; or CSV
CSV                         a header of ``<point>_x``, ``<point>_y``, - ``<point>_confidence`` (or
                            ``_visibility``, ``_score``; ``_u_px`` and ``_v_px`` too), or ``x0``, ``y0``,
                            ``v0``, ...; - ``time`` (s) or ``timestamp_ms``
CSV, a row for each point   ``frame``, ``point_id``, ``x``, ``y``, - ``visibility``, - ``time``; Caliscope's
DeepLabCut                  CSV of predictions, of one or several individuals
SLEAP                       analysis as CSV or ``.h5``
TRC in pixels               Sports2D's ``*_px_*.trc``
NPZ                         ``uv_px`` or ``keypoints`` (T, K, 2 or 3) or (T, P, K, 2 or 3),
                            - ``confidence`` or ``scores``, - ``times``, - ``identity`` (T, P), - ``detector``,
                            - ``p_model`` (T, P, K, 3) points in space about the hips, m
NPY                         one array like that
XDF                         one stream of channels ``<point>_x``, ``<point>_y``, - ``<point>_confidence``, px
==========================  ====================================================================

Of a whole body (133 points of COCO, 136 of Halpe) face and hands are left out, unless a layout is asked for that has
them. Coordinates that are fractions of the image need its size. Confidences are clipped to 1, and are 1 if missing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import shared
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.arrays import read_npy, read_npz
from rtof_kin.core.files.text import load_json
from rtof_kin.formats.xdf import read_xdf_points
from rtof_kin.vision.detections import (
    NO_IDENTITY,
    TIMES,
    Detections,
    Person,
    of_body,
    read_csv_table,
    read_pixel_trc,
    read_sleap_h5,
)

FORMATS = (".json", ".npz", ".npy", ".csv", ".trc", ".xdf", ".h5")
ARRAY_NAMES = ("uv_px", "keypoints", "keypoints_2d")  #: Names of the array of points in an .npz
_LARGEST_JSON = 256 * 2**20  # bytes
_WHAT = "JSON of moderate size; write one file a frame, or .npz"
_PEOPLE = ("people", "bodies", "instances")
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "joints", "keypoints", "pose_landmarks", "landmarks")
_SCORES = ("keypoint_scores", "visibility", "confidence", "score", "presence")
_FRAME_SCORES = ("keypoint_scores", "scores")
_IDENTITY = ("idx", "track_id", "person_id", "instance_id")
_LONGEST_TEXT = 200  # characters about the detector
_MOST_FRAMES_EACH = 100  # largest mean distance between frame numbers


def read_detector_file(
    path: str | Path, width_px: int | None = None, height_px: int | None = None, layout: str | None = None
) -> Detections:
    """Read the detections of all people in a video. `FileFormatError`: unknown format, damaged, or without people.

    Args:
        path: a file or folder of one of the formats above.
        width_px, height_px: size of the image, for coordinates that are fractions of it.
        layout: that is wanted of whole bodies; body and feet by default.
    """
    path = Path(path)
    with reading(path):
        return of_body(_read(path), layout).in_pixels(width_px, height_px)


def _read(path: Path) -> Detections:
    if path.is_dir():
        return _read_json_folder(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise FileFormatError(path, f"not one of {', '.join(FORMATS)}, nor a folder of OpenPose's .json files")
    if not path.is_file():
        raise FileFormatError(path, "there is no such file or folder")
    readers = {".json": _read_json, ".trc": read_pixel_trc, ".csv": read_csv_table, ".h5": read_sleap_h5}
    if suffix in readers:
        return readers[suffix](path)
    if suffix == ".xdf":
        points = read_xdf_points(path)
        return Detections(points.uv_px[:, None], points.confidence[:, None], points.times, points.names)
    arrays = {"keypoints": read_npy(path)} if suffix == ".npy" else read_npz(path)
    text = np.nan_to_num(arrays.get("detector", np.zeros(0))).clip(0, 255).astype(np.uint8).tobytes()
    about = "".join(filter(str.isprintable, text.decode(errors="replace")))[:_LONGEST_TEXT]
    return replace(_of_arrays(path, arrays), detector=about)


def _of_arrays(path: Path, arrays: dict[str, Array]) -> Detections:
    points = _one_of(path, arrays, ARRAY_NAMES)
    if points is None:
        have = ", ".join(arrays) or "nothing"
        raise FileFormatError(path, f"no array uv_px or keypoints of shape (T, K, 3); there is {have}")
    if points.ndim not in (3, 4) or points.shape[-1] not in (2, 3):
        shapes = "neither (T, K, 2 or 3) nor (T, P, K, 2 or 3)"
        raise FileFormatError(path, f"keypoints: shape {points.shape} is {shapes}")
    shared(*arrays.values())
    uv = points if points.shape[-1] == 2 else points[..., :2]
    confidence = _one_of(path, arrays, ("confidence", "scores", "keypoint_scores"))
    if confidence is None:
        confidence = points[..., 2] if points.shape[-1] == 3 else np.isfinite(uv).all(axis=-1).astype(float)
    if confidence.shape != uv.shape[:-1]:
        raise FileFormatError(path, f"confidence: expected shape {uv.shape[:-1]}, got {confidence.shape}")
    times, identity = _one_of(path, arrays, ("times", "timestamps")), None
    if "identity" in arrays:
        identity = np.nan_to_num(arrays["identity"], nan=NO_IDENTITY).astype(np.int64)
    if points.ndim == 3:
        uv, confidence = uv[:, None], confidence[:, None]
    p_model = arrays.get("p_model")
    if p_model is not None and p_model.shape != (*uv.shape[:3], 3):
        raise FileFormatError(path, f"p_model: expected shape {(*uv.shape[:3], 3)}, got {p_model.shape}")
    return Detections(uv, confidence, times, identity=identity, p_model=p_model)


def _one_of(path: Path, arrays: dict[str, Array], names: tuple[str, ...]) -> Array | None:
    found = [name for name in names if name in arrays]
    if len(found) > 1:
        raise FileFormatError(path, f"has {' and '.join(found)}; leave only one of them")
    return arrays[found[0]] if found else None


def _read_json_folder(folder: Path) -> Detections:
    """Read one file per frame, numbered by the last number in their names, from the first file on."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".json")
    if not paths:
        raise FileFormatError(folder, "there is no .json file in this folder")
    frames: dict[int, list[Person]] = {}
    for path in paths:
        number = _number(path.stem)
        if number is None or number in frames:
            problem = "its name has no frame number, or another file has the same; keep one video's files in"
            raise FileFormatError(path, f"{problem} a folder, named e.g. walk_000000000012_keypoints.json")
        frames[number] = _people(path, load_json(path, _LARGEST_JSON, _WHAT), "frame")
    first = min(frames)
    return _detections(folder, {number - first: people for number, people in frames.items()})


def _read_json(path: Path) -> Detections:
    """Read a file with one or many frames, whose format is recognised from its structure."""
    data = load_json(path, _LARGEST_JSON, _WHAT)
    if isinstance(data, list) and data and all(isinstance(e, dict) and "image_id" in e for e in data):
        return _by_image(path, data, {})
    if isinstance(data, list):
        return _of_list(path, data)
    if not isinstance(data, dict):
        raise FileFormatError(path, f"holds a {type(data).__name__}, not people's keypoints")
    if isinstance(data.get("annotations"), list):
        return _by_image(path, data["annotations"], data)
    for key in ("instance_info", "frames"):
        if isinstance(data.get(key), list):
            return _of_list(path, data[key])
    if any(key in data for key in (*_PEOPLE, *_POINTS)):
        return _detections(path, {0: _people(path, data, "frame 0")})
    # Read frames keyed by the names of their images, e.g. ``{"0.jpg": {"people": [...]}}``.
    frames: dict[int, list[Person]] = {}
    for name, frame in data.items():
        number = _number(Path(name).stem)
        if number is None or number in frames:
            known = ", ".join((*_PEOPLE, "annotations", "instance_info", "frames"))
            raise FileFormatError(path, f"{name!r} is no name of a frame with a unique number, nor {known}")
        frames[number] = _people(path, frame, f"frame {name}")
    return _detections(path, frames)


def _of_list(path: Path, entries: Sequence[Any]) -> Detections:
    frames = {i: _people(path, entry, f"frame {i}") for i, entry in enumerate(entries)}
    stamps = [_time(entry) for entry in entries]
    return _detections(path, frames, None if None in stamps else np.array(stamps, dtype=np.float64))


def _time(frame: Any) -> float | None:
    """Return the time of a frame, s, if it has one."""
    for key, unit in TIMES.items() if isinstance(frame, dict) else ():
        value = frame.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value) * unit
    return None


def _by_image(path: Path, entries: Sequence[Any], data: Mapping[str, Any]) -> Detections:
    """Read a list of people with the image of each: AlphaPose and COCO.

    Frames are numbered by the list of images, if `data` has one, else by the images' names.
    """
    images, order = data.get("images"), None
    if isinstance(images, list):
        ids = [image["id"] for image in images if isinstance(image, dict) and "id" in image]
        order = {image: i for i, image in enumerate(ids) if isinstance(image, int | str)}
    frames: dict[int, list[Person]] = {}
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict) or "image_id" not in entry:
            raise FileFormatError(path, f"entry {i}: not a person with image_id and keypoints")
        image = entry["image_id"]
        number = _image_number(image) if order is None else order.get(image)
        if number is None:
            raise FileFormatError(path, f"entry {i}: image_id {image!r} has no number, so no frame")
        people = frames.setdefault(number, [])
        if "keypoints" in entry:
            people.append(_person(path, entry, f"entry {i}"))
    return _detections(path, frames, names=_category_names(data.get("categories")))


def _category_names(categories: Any) -> tuple[str, ...] | None:
    match categories:
        case [{"keypoints": [*names]}] if all(isinstance(name, str) for name in names):
            return tuple(names)
    return None


def _image_number(image: Any) -> int | None:
    if isinstance(image, int) and not isinstance(image, bool):
        return image
    return _number(Path(image).stem) if isinstance(image, str) else None


def _number(stem: str) -> int | None:
    """Return the last number in a file name."""
    found = re.findall(r"\d+", stem)
    return int(found[-1][:18]) if found else None


def _detections(
    path: Path, frames: Mapping[int, Sequence[Person]], times: Array | None = None, names: tuple[str, ...] | None = None
) -> Detections:
    if frames and (min(frames) < 0 or max(frames) > _MOST_FRAMES_EACH * len(frames) + 1000):
        numbers = f"numbered from {min(frames)} to {max(frames)}; number them as in the video, from 0"
        raise FileFormatError(path, f"its {len(frames)} frames are {numbers}")
    return Detections.of_frames(frames, times, names)


def _people(path: Path, frame: Any, where: str) -> list[Person]:
    """Return the people of a frame in any of the structures."""
    if frame is None:
        return []
    if isinstance(frame, dict):
        for key in _PEOPLE:
            if key in frame:
                return _people_listed(path, frame[key], f"{where}, {key}")
        found = next((frame[key] for key in _POINTS if key in frame), None)
        if not found and any(key in frame for key in _POINTS):
            return []
        if isinstance(found, list) and isinstance(found[0], list) and not _is_person(found):
            return _people_listed(path, _with_scores(found, frame), where)
        return [_person(path, frame, where)]
    if isinstance(frame, list):
        return _people_listed(path, [frame] if _is_person(frame) else frame, where)
    raise FileFormatError(path, f"{where}: holds a {type(frame).__name__}, not people")


def _with_scores(people: list[Any], frame: Mapping[str, Any]) -> list[Any]:
    """Return people's points with their scores, where the frame has a list of those beside them."""
    scores = next((frame[key] for key in _FRAME_SCORES if key in frame), None)
    if not isinstance(scores, list) or len(scores) != len(people):
        return people
    pairs = zip(people, scores, strict=True)
    return [{"keypoints": points, "keypoint_scores": own} for points, own in pairs]


def _people_listed(path: Path, entries: Any, where: str) -> list[Person]:
    """Return the listed people that have detected points."""
    if not isinstance(entries, list):
        raise FileFormatError(path, f"{where}: holds a {type(entries).__name__}, not a list of people")
    entries = [{"keypoints": entry} if isinstance(entry, list) else entry for entry in entries]
    return [
        _person(path, entry, f"{where}, person {i}")
        for i, entry in enumerate(entries)
        if not isinstance(entry, dict) or any(entry.get(key) for key in _POINTS)
    ]


def _is_person(values: Sequence[Any]) -> bool:
    """Return whether a list is one person's points: numbers, rows of two or three, or tables with x."""
    first = values[0] if values else None
    if isinstance(first, list):
        return len(first) in (2, 3) and all(isinstance(value, int | float) for value in first)
    return isinstance(first, int | float) or (isinstance(first, dict) and "x" in first)


def _person(path: Path, entry: Any, where: str) -> Person:
    if not isinstance(entry, dict):
        raise FileFormatError(path, f"{where}: holds a {type(entry).__name__}, not a person")
    values = next((entry[key] for key in _POINTS if key in entry), None)
    if not isinstance(values, list) or not values:
        raise FileFormatError(path, f"{where}: has no field {', '.join(_POINTS)} with a list of points")
    with reading(path, f"{where}: its points are not numbers ({{}})", TypeError, ValueError, KeyError, OverflowError):
        points = _points(values, entry)
    if points is None:
        raise FileFormatError(path, f"{where}: {len(values)} numbers are not x, y, confidence for each point")
    return Person(points, _identity(entry))


def _points(values: Sequence[Any], entry: Mapping[str, Any]) -> Array | None:
    """Return (K, 3) x, y, confidence, or None if their number does not fit."""
    if isinstance(values[0], dict):
        columns = [[float(v["x"]), float(v["y"])] for v in values]
        known = [next((v[key] for key in _SCORES if v.get(key) is not None), 1.0) for v in values]
        return np.column_stack([columns, np.array(known, dtype=np.float64)])
    array = np.array(values, dtype=np.float64)
    if array.ndim == 1 and len(array) % 3 == 0:
        array = array.reshape(-1, 3)
        flags = array[:, 2]
        if np.any(flags == 2) and np.all(np.isin(flags, (0, 1, 2))):
            array[:, 2] = np.minimum(flags, 1)  # COCO annotations: 1 is hidden, 2 is visible
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        return None
    if array.shape[1] == 3:
        return array
    scores = next((entry[key] for key in _FRAME_SCORES if key in entry), np.ones(len(array)))
    scores = np.array(scores, dtype=np.float64)
    return None if scores.shape != (len(array),) else np.column_stack([array, scores])


def _identity(entry: Mapping[str, Any]) -> int:
    for key in _IDENTITY:
        value = entry.get(key)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return int(value) if 0 <= value < 2**53 else NO_IDENTITY
    return NO_IDENTITY
