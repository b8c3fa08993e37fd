"""`Detections`: the keypoints of all people that a detector found in a video, in the detector's layout.

Keypoints in tables: columns for each point, a row for each point of each frame, or markers in pixels. Rows for each
point are written by people who save MediaPipe's landmarks as they come, and by Caliscope (``sync_index``, ``port``,
``frame_time``, ``point_id``, ``img_loc_x``, ``img_loc_y``), whose file has all cameras: keep the rows of one. Points
are numbered from 0; of Caliscope's holistic tracker, whose hands begin at 100 and face at 500, only the body is read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.formats.channels import POINT_ENDINGS, PointChannels, point_part
from rtof_kin.formats.markers import read_trc
from rtof_kin.vision.layouts import detector_table

Ints = NDArray[np.int64]
NO_IDENTITY: Final = -1
_LARGEST_RELATIVE = 3.0  # coordinates of which none is larger are fractions of the image size
_MOST_PEOPLE, _MOST_NUMBERS = 500, 2**27
_HIGHEST_CONFIDENCE = 10.0
_BODY_OF_WHOLE: Final = {133: 23, 136: 26}
"""Points of a whole body (COCO's, Halpe's) -> of its body and feet, which come first."""


@dataclass(frozen=True)
class Person:
    """One person in one frame."""

    points: Array  #: (K, 3) x, y, confidence
    identity: int = NO_IDENTITY  #: Number given by a tracker, -1 without one
    p_model: Array | None = None  #: (K, 3) m the points in space about the hips, where the detector gives them


@dataclass(frozen=True)
class Detections:
    """Points of up to P people in T frames; the order of people may change between frames."""

    uv_px: Array  #: (T, P, K, 2); NaN where not detected
    confidence: Array  #: (T, P, K) in [0, 1]; 0 where not detected
    times: Array | None = None  #: (T,) s, if the file has them
    names: tuple[str, ...] | None = None  #: K names of the points in the file, if it has them
    identity: Ints | None = None  #: (T, P) numbers given by a tracker, -1 where there is none; None without a tracker
    detector: str = ""  #: What found them and how fast, if the file says it
    p_model: Array | None = None
    """(T, P, K, 3) m the points in space about the hips, which `vision.lift_points` reads; NaN where missing."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        uv = np.array(readonly("detections uv_px", self.uv_px, ("T", "P", "K", 2)))
        confidence = np.array(readonly("detections confidence", self.confidence, uv.shape[:3]))
        if 0 in uv.shape:
            raise InvalidInputError("there is no person in any frame; check the detector's output")
        low, high = float(np.nanmin(confidence, initial=0.0)), float(np.nanmax(confidence, initial=0.0))
        if high > _HIGHEST_CONFIDENCE or low < 0:
            problem = f"ranges from {low:g} to {high:g}; give values from 0 to 1 (divide by the detector's maximum)"
            raise InvalidInputError(f"detections confidence: {problem}")
        confidence = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
        missing = ~np.isfinite(uv).all(axis=-1) | (confidence == 0)
        uv[missing], confidence[missing] = np.nan, 0.0
        set_(self, "uv_px", readonly("detections uv_px", uv, uv.shape))
        set_(self, "confidence", readonly("detections confidence", confidence, uv.shape[:3]))
        if self.times is not None:
            times = checked_times("detections times", self.times)
            set_(self, "times", times)
            if len(times) != len(uv):
                raise ShapeError(f"detections times: {len(times)}, but there are {len(uv)} frames")
        if self.names is not None and len(self.names) != uv.shape[2]:
            raise ShapeError(f"detections: {len(self.names)} names for {uv.shape[2]} points")
        if self.identity is not None:
            identity = readonly("detections identity", self.identity, uv.shape[:2], np.int64)
            set_(self, "identity", identity)
        if self.p_model is not None:
            set_(self, "p_model", readonly("detections p_model", self.p_model, (*uv.shape[:3], 3)))

    @classmethod
    def of_frames(
        cls, frames: Mapping[int, Sequence[Person]], times: Array | None = None, names: tuple[str, ...] | None = None
    ) -> Self:
        """Create detections from the people of each frame.

        Args:
            frames: frame number -> people; frames without an entry are empty. times: (T,) s.

        Raises:
            InvalidInputError: no people, different numbers of points, or too much data.
        """
        sizes = {number: {len(p.points) for p in people} for number, people in frames.items()}
        K = next((size for some in sizes.values() for size in some), None)
        if K is None:
            raise InvalidInputError("there is no person in any frame; check the detector's output")
        for number, some in sizes.items():
            if some - {K}:
                problem = f"a person has {max(some - {K})} points, others have {K}; use one layout"
                raise InvalidInputError(f"frame {number}: {problem}")
        T, P = max(frames) + 1, max(map(len, frames.values()))
        if P > _MOST_PEOPLE or T * P * K > _MOST_NUMBERS:
            raise InvalidInputError(f"{T} frames of up to {P} people with {K} points are too much; split the recording")
        points, identity = np.zeros((T, P, K, 3)), np.full((T, P), NO_IDENTITY)
        p_model = np.full((T, P, K, 3), np.nan)
        for number, people in frames.items():
            for p, person in enumerate(people):
                points[number, p], identity[number, p] = person.points, person.identity
                if person.p_model is not None:
                    p_model[number, p] = person.p_model
        tracked, in_space = np.any(identity != NO_IDENTITY), np.isfinite(p_model).any()
        found = cls(points[..., :2], points[..., 2], times, names, identity if tracked else None)
        return replace(found, p_model=p_model) if in_space else found

    def __len__(self) -> int:
        return len(self.uv_px)

    def of_points(self, order: Sequence[int]) -> Self:
        """Return some of the points in another order, without names."""
        p = None if self.p_model is None else self.p_model[:, :, order]
        uv, confidence = self.uv_px[:, :, order], self.confidence[:, :, order]
        return replace(self, uv_px=uv, confidence=confidence, names=None, p_model=p)

    @property
    def about(self) -> dict[str, NDArray[Any]]:
        """Arrays of a file, where they are known: `detector`, text in UTF-8, and `p_model`."""
        text = self.detector.encode()
        in_space = {} if self.p_model is None else {"p_model": self.p_model}
        return in_space | ({"detector": np.frombuffer(text, np.uint8)} if text else {})

    @property
    def present(self) -> Mask:
        """(T, P) True where a person was detected."""
        return np.asarray((self.confidence > 0).any(axis=-1))

    def in_pixels(self, width_px: int | None, height_px: int | None) -> Self:
        """Return detections in pixels; coordinates up to 3 are taken as fractions of the image size.

        Raises:
            InvalidInputError: the image size is missing.
        """
        largest = float(np.nanmax(np.abs(self.uv_px), initial=0.0))
        if largest > _LARGEST_RELATIVE:
            return self
        if width_px is None or height_px is None:
            raise InvalidInputError(
                f"the coordinates are fractions of the image (the largest is {largest:.2g}), so its "
                "width_px and height_px are needed"
            )
        return replace(self, uv_px=self.uv_px * [width_px, height_px])


def of_body(found: Detections) -> Detections:
    """Return detections without face and hands, where they are of a whole body; else unchanged."""
    K = _BODY_OF_WHOLE.get(found.uv_px.shape[2])
    if K is None:
        return found
    return replace(found.of_points(range(K)), names=None if found.names is None else found.names[:K])


_ROWS: Final = {
    "frame": ("sync_index", "frame", "frame_index", "frame_id", "frame_number"),
    "point": ("point_id", "landmark", "landmark_id", "landmark_index", "keypoint", "keypoint_id", "joint", "id"),
    "x": ("img_loc_x", "x", "x_px", "u", "u_px"),
    "y": ("img_loc_y", "y", "y_px", "v", "v_px"),
    "confidence": ("visibility", "confidence", "score", "likelihood"),
    "time": ("frame_time", "time", "time_s", "timestamp"),
    "camera": ("port", "camera", "cam", "cam_id"),
}
"""Meaning -> names of its column."""
_NEEDED: Final = ("frame", "point", "x", "y")
_LARGEST_STEP: Final = 30  #: Largest difference of the numbers of points of one body, some of which may never be seen
_HANDS, _LAST_OF_HOLISTIC = 100, 32  #: First number of hands, and last of the body, of Caliscope's holistic tracker
_LARGEST_METRES: Final = 50.0  #: Coordinates of markers beyond this are no metres, whatever their file says
TIMES: Final = {"time": 1.0, "time_s": 1.0, "timestamp": 1.0, "timestamp_ms": 1e-3}
"""Names of a column of times, and their unit, s."""
_NO_POINTS = {"frame", "frame_id", "index", ""}


def read_csv_table(path: Path) -> Detections:
    """Read a .csv of either form; `FileFormatError` where it is unreadable, or its columns are no points."""
    columns = read_csv(path)
    return _of_rows(path, columns) if has_rows(columns) else _of_columns(path, columns)


def _of_columns(path: Path, columns: Mapping[str, Array]) -> Detections:
    """Return the detections of a table with columns for each point, of one person."""
    labels = [name for name in columns if name.strip().lower() not in (*TIMES, *_NO_POINTS)]
    for label in labels:
        if point_part(label) is None:
            known = f"time, or a point's name and one of {', '.join(POINT_ENDINGS)}"
            raise FileFormatError(path, f"column {label!r}: expected {known}", 1)
    try:
        found = PointChannels.of(path.stem, labels)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error), 1) from error
    numbers = _numbers(found.names)
    order = np.argsort(numbers) if numbers else np.arange(len(found.names))
    values = np.stack([columns[label] for label in labels], axis=-1)
    uv = values[:, found.uv[order]]
    given = found.confidence[order]
    confidence = np.where(given < 0, np.isfinite(uv).all(axis=-1), values[:, given])
    stamps = next(((name, unit) for name in columns if (unit := TIMES.get(name.strip().lower()))), None)
    times = columns[stamps[0]] * stamps[1] if stamps else None
    return Detections(uv[:, None], confidence[:, None], times, None if numbers else found.names)


def _numbers(names: Sequence[str]) -> list[int]:
    """Return the numbers at the end of names that are otherwise the same, e.g. landmark_0; else none."""
    found = [re.fullmatch(r"(\D*)(\d{1,4})", name) for name in names]
    same = len({match[1] for match in found if match}) == 1 and all(found)
    return [int(match[2]) for match in found if match] if same else []


def is_keypoint_header(line: str) -> bool:
    """Return whether the first line of a .csv names the columns of detected points."""
    if has_rows(line.strip().split(",")):
        return True
    labels = [one for one in line.split(",") if one.strip().lower() not in (*TIMES, *_NO_POINTS)]
    if None in map(point_part, labels):
        return False
    parts = set(map(point_part, labels))
    return any((point, "y") in parts for point, part in filter(None, parts) if part == "x")


def _found(names: Iterable[str]) -> dict[str, str]:
    """Return the columns that are there, by their meaning."""
    own = {name.strip().lower(): name for name in names}
    pairs = {what: next((own[n] for n in known if n in own), None) for what, known in _ROWS.items()}
    return {what: name for what, name in pairs.items() if name is not None}


def has_rows(names: Iterable[str]) -> bool:
    """Return whether columns are those of a table with a row for each point."""
    return set(_NEEDED) <= set(_found(names))


def _of_rows(path: Path, columns: Mapping[str, Array]) -> Detections:
    """Return the detections of a table with a row for each point, of one person."""
    found = {what: columns[name] for what, name in _found(columns).items()}
    if "camera" in found and len(np.unique(found["camera"])) > 1:
        cameras = ", ".join(f"{one:g}" for one in np.unique(found["camera"])[:10])
        raise FileFormatError(path, f"has the cameras {cameras}; keep the rows of one in a file")
    numbers = np.stack([found["frame"], found["point"]])
    if not (np.isfinite(numbers).all() and np.all(numbers == np.round(numbers)) and numbers.min() >= 0):
        raise FileFormatError(path, "frames and points must have whole numbers, from 0 on")
    ids = np.unique(numbers[1])
    last = ids[int(np.argmax(np.append(np.diff(ids), np.inf) > _LARGEST_STEP))]  # of the body
    if ids[-1] >= _HANDS:
        last = max(last, _LAST_OF_HOLISTIC)
    rows = numbers[1] <= last
    frames, points = numbers[:, rows].astype(np.int64)
    frames = frames - frames.min()
    T, K = int(frames.max()) + 1, int(last) + 1
    if min(_MOST_NUMBERS, 100 * rows.sum() + 1000) < T * K:
        raise FileFormatError(path, f"{T} frames of {K} points for {rows.sum()} rows; number frames from 0")
    if len(np.unique(frames * K + points)) < len(frames):
        raise FileFormatError(path, "a frame has a point twice; keep the rows of one person in a file")
    uv, confidence = np.full((T, 1, K, 2), np.nan), np.zeros((T, 1, K))
    uv[frames, 0, points] = np.stack([found["x"], found["y"]], axis=1)[rows]
    confidence[frames, 0, points] = found["confidence"][rows] if "confidence" in found else 1.0
    return Detections(uv, confidence, _times(found, rows, frames, T))


def _times(found: Mapping[str, Array], rows: Array, frames: Array, T: int) -> Array | None:
    """Return times (T,), interpolated where a frame has no row; None where there are none that increase."""
    if "time" not in found:
        return None
    known, first = np.unique(frames, return_index=True)
    times = found["time"][rows][first]
    if not np.all(np.diff(times) > 0):
        return None
    return np.asarray(np.interp(np.arange(T), known, times))


def read_pixel_trc(path: Path) -> Detections:
    """Read the keypoints of one person from a TRC file in pixels, as Sports2D writes it; its header says metres. Points
    of the layout that its markers belong to and that it lacks are missing. `FileFormatError`: unreadable, in metres, or
    of markers that are no detector's points.
    """
    markers = read_trc(path, up="z")
    uv = markers.p_world[..., :2]
    if not np.nanmax(np.abs(uv), initial=0.0) > _LARGEST_METRES:
        raise FileFormatError(path, "its markers are in metres, in space; give Sports2D's file in pixels, *_px_*.trc")
    form, order = detector_table().nearest(markers.names)
    if form is None:
        raise FileFormatError(path, f"no layout of a detector has its markers {', '.join(markers.names[:8])}, ...")
    out = np.full((len(uv), 1, len(form), 2), np.nan)
    at = [i for i, index in enumerate(order) if index is not None]
    out[:, 0, at] = uv[:, [index for index in order if index is not None]]
    confidence = np.isfinite(out).all(axis=-1).astype(float)
    return Detections(out, confidence, markers.times, form.names)
