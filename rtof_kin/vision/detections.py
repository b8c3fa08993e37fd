"""`Detections`: the keypoints of all people that a detector found in a video, in the detector's layout.

Keypoints in tables: columns for each point, a row for each point of each frame, DeepLabCut's and SLEAP's, or markers in
pixels. Rows for each point are written by people who save MediaPipe's landmarks as they come, and by Caliscope
(``sync_index``, ``port``, ``frame_time``, ``point_id``, ``img_loc_x``, ``img_loc_y``), whose file has all cameras: keep
the rows of one. Points are numbered from 0; of Caliscope's holistic tracker, whose hands begin at 100 and face at 500,
only the body is read.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError, reading
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.text import numbers_of, read_text
from rtof_kin.data.keypoints import blanked
from rtof_kin.formats.channels import POINT_ENDINGS, PointChannels, point_part
from rtof_kin.formats.markers import read_trc
from rtof_kin.vision.layouts import detector_table

Ints = NDArray[np.int64]
NO_IDENTITY: Final = -1
_LARGEST_RELATIVE = 3.0  # coordinates of which none is larger are fractions of the image size
_MOST_PEOPLE, _MOST_NUMBERS = 500, 2**27
_HIGHEST_CONFIDENCE = 10.0


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
        uv = readonly("detections uv_px", self.uv_px, ("T", "P", "K", 2))
        confidence = readonly("detections confidence", self.confidence, uv.shape[:3])
        if 0 in uv.shape:
            raise InvalidInputError("there is no person in any frame; check the detector's output")
        low, high = float(np.nanmin(confidence, initial=0.0)), float(np.nanmax(confidence, initial=0.0))
        if high > _HIGHEST_CONFIDENCE or low < 0:
            problem = f"ranges from {low:g} to {high:g}; give values from 0 to 1 (divide by the detector's maximum)"
            raise InvalidInputError(f"detections confidence: {problem}")
        uv, confidence = blanked(uv, np.minimum(confidence, 1.0) if high > 1 else confidence)
        set_(self, "uv_px", uv)
        set_(self, "confidence", confidence)
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
        """Create detections from the people of each frame. `InvalidInputError`: no people, different numbers of points,
        or too much data.

        Args:
            frames: frame number -> people; frames without an entry are empty. times: (T,) s.
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
        `InvalidInputError`: the image size is missing.
        """
        largest = max(float(np.nanmax(self.uv_px, initial=0.0)), -float(np.nanmin(self.uv_px, initial=0.0)))
        if largest > _LARGEST_RELATIVE:
            return self
        if width_px is None or height_px is None:
            raise InvalidInputError(
                f"the coordinates are fractions of the image (the largest is {largest:.2g}), so its "
                "width_px and height_px are needed"
            )
        return replace(self, uv_px=self.uv_px * [width_px, height_px])


def of_body(found: Detections, layout: str | None = None) -> Detections:
    """Return the points that a layout takes of a whole body's; without a layout the first one that takes points of as
    many, so without face and hands; unchanged where there is none.
    """
    K = found.uv_px.shape[2]
    forms = [form for form in detector_table().layouts.values() if layout in (None, form.name)]
    at = next((at for form in forms for count, at in form.whole if count == K), None)
    if at is None:
        return found
    return replace(found.of_points(at), names=None if found.names is None else tuple(found.names[i] for i in at))


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
_SCORER, _SLEAP_FRAME, _LONGEST_LINE = "scorer", "frame_idx", 2**20
"""First cell of DeepLabCut's tables, a column of SLEAP's, and the characters in which they are looked for."""
_LARGEST_METRES: Final = 50.0  #: Coordinates of markers beyond this are no metres, whatever their file says
TIMES: Final = {"time": 1.0, "time_s": 1.0, "timestamp": 1.0, "timestamp_ms": 1e-3}
"""Names of a column of times, and their unit, s."""
_NO_POINTS = {"frame", "frame_id", "index", ""}


def read_csv_table(path: Path) -> Detections:
    """Read a .csv of any form; `FileFormatError` where it is unreadable, or its columns are no points."""
    with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8-sig", newline="") as stream:
        first = stream.readline(_LONGEST_LINE).split(",")
        if first[0].strip() == _SCORER or _SLEAP_FRAME in map(str.strip, first):
            return (_read_deeplabcut if first[0].strip() == _SCORER else _read_sleap_csv)(path)
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
    if has_rows(cells := line.strip().split(",")) or cells[0].strip() == _SCORER or _SLEAP_FRAME in cells:
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


def _read_deeplabcut(path: Path) -> Detections:
    """Read DeepLabCut's predictions: rows scorer, (individuals,) bodyparts, coords; then one for each frame."""
    rows = _cells(path, "DeepLabCut's predictions as .csv")
    heads = {cells[0].strip(): cells[1:] for cells in rows[:4]}
    if not {"bodyparts", "coords"} <= set(heads):
        raise FileFormatError(path, "no rows bodyparts and coords below scorer, as DeepLabCut writes them", 1)
    begin = 4 if "individuals" in heads else 3
    who = heads.get("individuals", [""] * len(heads["coords"]))
    people, names = (tuple(dict.fromkeys(cells)) for cells in (who, heads["bodyparts"]))
    frames = [_integer(path, cells[0], "the frame's number", begin + i + 1) for i, cells in enumerate(rows[begin:])]
    parts = {"x": 0, "y": 1, "likelihood": 2}
    values, first = _empty(path, frames, len(people), len(names)), min(frames)
    for column, (person, name, part) in enumerate(zip(who, heads["bodyparts"], heads["coords"], strict=True), start=1):
        if part.strip() in parts:
            numbers = [_decimal(path, cells[column], begin + i + 1) for i, cells in enumerate(rows[begin:])]
            at = people.index(person), names.index(name), parts[part.strip()]
            values[(np.array(frames) - first, *at)] = numbers
    return _of_values(values, names, identity=len(people) > 1)


def _read_sleap_csv(path: Path) -> Detections:
    """Read SLEAP's analysis as a table: track, frame_idx, instance.score, and x, y and score of every node."""
    header, *rows = _cells(path, "SLEAP's analysis as .csv")
    columns = [name.strip() for name in header]
    names = tuple(dict.fromkeys(name[:-2] for name in columns if name.endswith(".x")))
    if lacking := [f"{name}.y" for name in names if f"{name}.y" not in columns]:
        raise FileFormatError(path, f"no column {lacking[0]} beside {names[0]}.x; export the analysis again", 1)
    at = columns.index(_SLEAP_FRAME)
    frames = [_integer(path, cells[at], _SLEAP_FRAME, i) for i, cells in enumerate(rows, start=2)]
    track = columns.index("track") if "track" in columns else None
    tracks, slots, count = dict[str, int](), list[int](), Counter[int]()
    for frame, cells in zip(frames, rows, strict=True):
        named = "" if track is None else cells[track].strip()
        slots.append(tracks.setdefault(named, len(tracks)) if named else count[frame])
        count[frame] += 1
    values, first = _empty(path, frames, max(slots, default=0) + 1, len(names)), min(frames)
    for i, cells in enumerate(rows):
        for k, name in enumerate(names):
            for part, ending in enumerate(("x", "y", "score")):
                if (column := f"{name}.{ending}") in columns:
                    number = _decimal(path, cells[columns.index(column)], i + 2)
                    values[frames[i] - first, slots[i], k, part] = number
    return _of_values(values, names, identity=len(tracks) > 1)


def read_sleap_h5(path: Path) -> Detections:
    """Read SLEAP's analysis as HDF5; `FileFormatError` where it is unreadable, another file, or leads to one."""
    import h5py

    from rtof_kin.core.files.hdf5 import held

    problem = "not SLEAP's analysis, with tracks and node_names ({})"
    with reading(path, problem, OSError, KeyError, ValueError, TypeError), h5py.File(path, "r") as file:
        within = partial(held, path, file)
        tracks = np.asarray(within("tracks"), dtype=np.float64)  # (P, 2, K, T)
        names = tuple(one.decode() if isinstance(one, bytes) else str(one) for one in within("node_names")[()])
        scores = np.asarray(within("point_scores"), dtype=np.float64) if "point_scores" in file else None
    if tracks.ndim != 4 or tracks.shape[1:3] != (2, len(names)):
        raise FileFormatError(path, f"tracks: expected shape (P, 2, {len(names)}, T), got {tracks.shape}")
    if scores is None:
        scores = np.isfinite(tracks).all(axis=1).astype(float)
    if scores.shape != (len(tracks), *tracks.shape[2:]):
        raise FileFormatError(path, f"point_scores: shape {scores.shape}, which is not that of the tracks")
    values = np.moveaxis(np.concatenate([tracks, scores[:, None]], axis=1), (0, 1, 2, 3), (1, 3, 2, 0))
    return _of_values(values, names, identity=len(tracks) > 1)


def _cells(path: Path, what: str) -> list[list[str]]:
    """Return the rows of a .csv with as many cells as the first."""
    rows = [cells for cells in csv.reader(read_text(path, what).splitlines()) if cells]
    for line, cells in enumerate(rows, start=1):
        if len(cells) != len(rows[0]):
            raise FileFormatError(path, f"expected {len(rows[0])} cells, found {len(cells)}", line)
    return rows


def _integer(path: Path, cell: str, what: str, line: int) -> int:
    if not (cell.strip().isdigit() and len(cell) < 12):
        raise FileFormatError(path, f"{cell[:40]!r} is not {what}; give the predictions of a video", line)
    return int(cell)


def _decimal(path: Path, cell: str, line: int) -> float:
    return math.nan if cell == "nan" or not cell.strip() else numbers_of(path, line, [cell], 1)[0]


def _empty(path: Path, frames: Sequence[int], people: int, points: int) -> Array:
    """Return (T, P, K, 3) of NaN for frames of these numbers."""
    if not frames:
        raise FileFormatError(path, "there is no frame")
    T = max(frames) - min(frames) + 1
    if 100 * len(frames) + 1000 < T or T * people * points > _MOST_NUMBERS:
        raise FileFormatError(path, f"{T} frames of {points} points of {people} for {len(frames)} rows; number from 0")
    return np.full((T, people, points, 3), np.nan)


def _of_values(values: Array, names: tuple[str, ...], identity: bool) -> Detections:
    """Return detections of x, y, likelihood (T, P, K, 3); a likelihood that is missing everywhere is 1."""
    uv, sure = values[..., :2], values[..., 2]
    if np.isnan(sure).all():
        sure = np.isfinite(uv).all(axis=-1).astype(float)
    tracks = np.tile(np.arange(uv.shape[1]), (len(uv), 1)) if identity else None
    return Detections(uv, np.clip(np.nan_to_num(sure), 0.0, 1.0), names=names, identity=tracks)


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
