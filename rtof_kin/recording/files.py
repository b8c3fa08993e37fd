"""Parts of a recording folder, read and written. The format is described in docs/recording.md."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnitError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv, read_npz
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.video_arrays import VIDEO_AXES, VIDEO_CONSTANTS, with_video
from rtof_kin.recording.sources import Source, Table
from rtof_kin.recording.streams import Stream
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.layouts import detector_table, is_detector_point

_OWN_LAYOUT: Final = "joints"
_PERSON: Final = ("person_number", "person")
RECOGNISE: Final = "auto"  # a detector's layout that is to be recognised
_KEYPOINT_COLUMNS: Final = ("_u_px", "_v_px", "_confidence")
_KEYPOINT_AXES: Final = {"uv_px": 3, "confidence": 2, "times": 1}
_TRUTH_AXES: Final = {
    "times": 1,
    "p_world_joint": 3,
    "R_world_bone": 4,
    "provenance": 2,
    "valid": 2,
    "orientation_observed": 2,
}
"""Number of axes of arrays with a row for each sample; with fewer they hold for all samples."""
TRUTH: Final = tuple(_TRUTH_AXES)
"""Fields of `PoseSequence` in a file."""
_log = logging.getLogger(__name__)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the name of a file in front of errors that data types raise inside."""
    try:
        yield
    except UnitError as error:
        raise UnitError(f"{path}: {error}") from error
    except (InvalidInputError, CalibrationError) as error:
        raise FileFormatError(path, str(error)) from error


def read_arrays(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Read the arrays of an .npz file.

    Args:
        wanted: names that it may have; others raise `UnknownNameError`.
    """
    arrays = read_npz(path)
    unknown = sorted(set(arrays) - set(wanted))
    if unknown:
        raise UnknownNameError(f"array in {path}", unknown, wanted)
    return arrays


def needed(path: Path, shapes: Mapping[str, tuple[int, ...]], name: str, shape: str) -> tuple[int, ...]:
    """Return the shape of a required array, or raise `FileFormatError`.

    Args:
        shape: its axes, e.g. ``"(T, S, 4)"``.
    """
    if name not in shapes:
        have = ", ".join(shapes) or "nothing"
        raise FileFormatError(path, f"no array {name!r} of shape {shape}; there is {have}")
    if len(shapes[name]) != shape.count(",") + 1:
        raise FileFormatError(path, f"{name}: expected shape {shape}, got {shapes[name]}")
    return shapes[name]


def data_path(section: Section, or_folder: bool = False, field: str = "file") -> Path:
    """Return the file (or folder) inside the recording's folder that a field of a section names."""
    name = section.text(field)
    path = path_inside(section.path.parent, name)
    if path is None:
        raise section.error(field, f"{name!r} leads out of the folder; name a file inside it")
    if not path.is_file() and not (or_folder and path.is_dir()):
        raise section.error(field, f"there is no file {path}; put it there or correct the name")
    return path


def times_of(section: Section, path: Path, table: Table, T: int) -> Array:
    """Return times (T,) in s: those of the file, or evenly spaced at ``rate_hz``; ``start_s`` is added."""
    times = table.column("times")
    if not section.has("rate_hz"):
        if times is None:
            raise section.error("rate_hz", f"missing, and {path} has no times; give one of the two")
        return times + section.number("start_s", 0.0)
    if times is not None:
        raise section.error("rate_hz", f"{path} has times of its own; give only one of the two")
    rate = section.number("rate_hz")
    if rate <= 0:
        raise section.error("rate_hz", f"{rate:g} is not a positive number of samples per second")
    return section.number("start_s", 0.0) + np.arange(T) / rate


# --- keypoints -----------------------------------------------------------------------------------


def keypoint_stream(
    section: Section, camera: Camera, skeleton: SkeletonModel, source: Source
) -> Stream[KeypointSequence]:
    """Open keypoints whose names are landmarks of the skeleton.

    Args:
        section: table ``[keypoints]``.
    """
    if section.text("layout", _OWN_LAYOUT) != _OWN_LAYOUT or any(map(section.has, _PERSON)):
        return source.keep(_read_detected(section, camera, skeleton))
    path = data_path(section)
    is_csv = path.suffix.lower() == ".csv"
    if is_csv and section.has("layout"):
        raise section.error("layout", "a .csv names its points itself; leave the layout out")
    names, table = source.csv(path, arranged_keypoints) if is_csv else _keypoint_npz(section, path, skeleton, source)
    unknown = [n for n in names if n and n not in skeleton.landmarks and not is_detector_point(n)]
    if unknown:
        where = str(path) if is_csv else f"{section.path}, {section.where('landmarks')}"
        raise UnknownNameError(f"landmark in {where}", unknown, list(skeleton.landmarks))
    kept = [i for i, name in enumerate(names) if name]
    with naming(path):
        times, named = times_of(section, path, table, table.shapes["uv_px"][0]), tuple(names[i] for i in kept)
        start = section.number("start_s", 0.0)
        section.close()

    def part(rows: slice) -> KeypointSequence:
        arrays = table.rows(rows)
        with naming(path):
            uv, confidence = keypoint_arrays(arrays)
            keypoints = KeypointSequence(camera, times[rows], uv[:, kept], confidence[:, kept], named)
            return with_video(_on_video(keypoints, start), arrays)

    return Stream(times, part)


def keypoint_arrays(arrays: dict[str, Array]) -> tuple[Array, Array]:
    """Return pixels and confidences, 1 for every point seen where the file has none.

    Args:
        arrays: uv_px (T, L, 2) and maybe confidence (T, L).
    """
    uv = arrays["uv_px"]
    confidence: Array = arrays.get("confidence", np.isfinite(uv).all(axis=-1).astype(float))
    if confidence.shape != uv.shape[:2]:
        raise InvalidInputError(f"confidence: expected shape {uv.shape[:2]} as uv_px has, got {confidence.shape}")
    return uv, confidence


def _keypoint_npz(
    section: Section, path: Path, skeleton: SkeletonModel, source: Source
) -> tuple[tuple[str, ...], Table]:
    table = source.npz(path, _KEYPOINT_AXES | VIDEO_AXES, VIDEO_CONSTANTS)
    points = needed(path, table.shapes, "uv_px", "(T, L, 2)")[1]
    names = section.optional_names("landmarks")
    if section.has("layout"):
        if names is not None:
            raise section.error("layout", "stands beside landmarks; give only one of the two")
        names = skeleton.names
    if names is None:
        raise section.error("landmarks", "missing; list the names of the points in the file's order")
    if len(names) != points:
        raise section.error(
            "landmarks",
            f'{len(names)} names, but {path} has {points} points; name each one, with "" for those to leave out',
        )
    return names, table


def _read_detected(section: Section, camera: Camera, skeleton: SkeletonModel) -> KeypointSequence:
    """Read keypoints from a detector's own file or folder, in its own layout; see `rtof_kin.vision`."""
    layout = section.text("layout")
    known = ", ".join((RECOGNISE, *detector_table().layouts))
    if layout not in known.split(", "):
        raise section.error("layout", f"{layout!r} is not known; write one of {known}, or list landmarks")
    if section.has("landmarks"):
        raise section.error("layout", "stands beside landmarks; give only one of the two")
    if skeleton.name != "total_capture":
        raise section.error(
            "layout",
            f"{layout!r} is for the skeleton total_capture, not {skeleton.name}; list the "
            f"names of the points in landmarks, or write {_OWN_LAYOUT!r} for its joints in their order",
        )
    found = read_detector_keypoints(
        data_path(section, or_folder=True),
        camera,
        layout=None if layout == RECOGNISE else layout,
        rate_hz=section.optional_number("rate_hz"),
        start=(start := section.number("start_s", 0.0)),
        person=_person(section),
        frame=section.integer("frame") if section.has("frame") else None,
    )
    chosen = any(map(section.has, _PERSON))
    section.close()
    several = found.track.people > 1 and not chosen
    doubtful = several or bool(np.any(found.track.ambiguous | found.track.lost))
    _log.log(logging.WARNING if doubtful else logging.INFO, "%s: %s", section.path, found.summary)
    return _on_video(found.keypoints, start)


def _person(section: Section) -> int | None:
    """Return the index of the person from 0; None where the likely one is meant."""
    if section.has("person_number"):
        if section.has("person"):
            raise section.error("person", "stands beside person_number; give only one of the two")
        return section.integer("person_number") - 1
    return section.integer("person") if section.has("person") else None


def _on_video(keypoints: KeypointSequence, start: float) -> KeypointSequence:
    """Return keypoints whose times are those of the video, s, and `start`."""
    return replace(keypoints, own_times=keypoints.times - start) if start else keypoints


def read_keypoint_csv(path: Path) -> tuple[tuple[str, ...], dict[str, Array]]:
    """Return landmark names and the arrays uv_px (T, L, 2), confidence (T, L) and, if present, times (T,).

    Args:
        path: a .csv file with the columns of a recording's keypoints.
    """
    return arranged_keypoints(path, read_csv(path))


def arranged_keypoints(path: Path, columns: dict[str, Array]) -> tuple[tuple[str, ...], dict[str, Array]]:
    """Return what `read_keypoint_csv` does of columns.

    Args:
        columns: (T,) by name.
    """
    arrays = {"times": columns["time"]} if "time" in columns else {}
    names = csv_names(path, [name for name in columns if name != "time"], _KEYPOINT_COLUMNS, optional=1)
    uv = np.stack([[columns[n + end] for end in _KEYPOINT_COLUMNS[:2]] for n in names]).transpose(2, 0, 1)
    seen = np.isfinite(uv).all(axis=-1).astype(float)
    given = [columns.get(f"{n}_confidence", seen[:, i]) for i, n in enumerate(names)]
    return names, arrays | {"uv_px": uv, "confidence": np.stack(given, axis=1)}


def csv_names(path: Path, columns: list[str], endings: Sequence[str], optional: int = 0) -> tuple[str, ...]:
    """Return names in the order of their first column.

    Args:
        endings: of the columns of each name. optional: number of the last endings that are not required.
    """
    names: dict[str, None] = {}
    for column in columns:
        ending = next((end for end in endings if column.endswith(end)), None)
        if ending is None:
            raise FileFormatError(
                path, f"column {column!r}: expected 'time', or a name with one of the endings {', '.join(endings)}", 1
            )
        names[column.removesuffix(ending)] = None
    if not names:
        raise FileFormatError(path, f"no column ends in {endings[0]}", 1)
    required = endings[: len(endings) - optional]
    missing = [name + end for name in names for end in required if name + end not in columns]
    if missing:
        raise FileFormatError(path, f"the column {missing[0]!r} is missing", 1)
    return tuple(names)


# --- truth ---------------------------------------------------------------------------------------


def truth_stream(section: Section, skeleton: SkeletonModel, source: Source) -> Stream[PoseSequence]:
    """Open known poses, joints in the skeleton's order.

    Args:
        section: table ``[truth]``.
    """
    path = data_path(section)
    table = source.npz(path, _TRUTH_AXES)
    for name, shape in zip(TRUTH[:3], ("(T)", "(T, J, 3)", "(T, J, 3, 3)"), strict=True):
        needed(path, table.shapes, name, shape)
    section.close()
    times = table.column("times")
    assert times is not None  # needed

    def part(rows: slice) -> PoseSequence:
        with naming(path):
            return PoseSequence(names=skeleton.names, **table.rows(rows))  # type: ignore[arg-type]

    return Stream(times, part)
