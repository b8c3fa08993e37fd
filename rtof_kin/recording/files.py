"""The parts of a recording folder, read and written; `rtof_kin.recording.recording` documents the format."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import (
    CalibrationError,
    FileFormatError,
    InvalidInputError,
    UnitError,
    UnknownNameError,
)
from rtof_kin.core.files.arrays import read_csv, read_npz
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.layouts import detector_table

Array = NDArray[np.float64]
OWN_LAYOUT, RECOGNISE = "joints", "auto"
"""Layouts of keypoints: the skeleton's joints in their order; a detector's, to be recognised."""
_SHORTEST_FOCAL = 0.1
"""A focal length below this share of the image's width is in another unit."""
_log = logging.getLogger(__name__)
_KEYPOINT_COLUMNS = ("_u_px", "_v_px", "_confidence")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the data types, raised inside, leave with the name of the file in front."""
    try:
        yield
    except UnitError as error:
        raise UnitError(f"{path}: {error}") from error
    except (InvalidInputError, CalibrationError) as error:
        raise FileFormatError(path, str(error)) from error


def data_path(section: Section, or_folder: bool = False) -> Path:
    """The file (or folder) that a section's field ``file`` names, inside the recording's folder."""
    name = section.text("file")
    path = path_inside(section.path.parent, name)
    if path is None:
        raise section.error("file", f"{name!r} leads out of the folder; name a file inside it")
    if not path.is_file() and not (or_folder and path.is_dir()):
        raise section.error("file", f"there is no file {path}; put it there or correct the name")
    return path


def read_arrays(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """The arrays of an .npz file, of which only `wanted` may be there."""
    arrays = read_npz(path)
    unknown = sorted(set(arrays) - set(wanted))
    if unknown:
        raise UnknownNameError(f"array in {path}", unknown, wanted)
    return arrays


def needed(path: Path, arrays: dict[str, Array], name: str, shape: str) -> Array:
    """An array that must be there, of as many axes as `shape` names, e.g. ``"(T, S, 4)"``."""
    if name not in arrays:
        have = ", ".join(arrays) or "nothing"
        raise FileFormatError(path, f"no array {name!r} of shape {shape}; there is {have}")
    if arrays[name].ndim != shape.count(",") + 1:
        raise FileFormatError(path, f"{name}: expected shape {shape}, got {arrays[name].shape}")
    return arrays[name]


def read_times(section: Section, path: Path, arrays: dict[str, Array], T: int) -> Array:
    """Times (T,) in s: the file's own, or evenly spaced at ``rate_hz`` from ``start_s``."""
    if not section.has("rate_hz"):
        if "times" not in arrays:
            raise section.error("rate_hz", f"missing, and {path} has no times; give one of the two")
        return arrays["times"] + section.number("start_s", 0.0)
    if "times" in arrays:
        raise section.error("rate_hz", f"{path} has times of its own; give only one of the two")
    rate = section.number("rate_hz")
    if rate <= 0:
        raise section.error("rate_hz", f"{rate:g} is not a positive number of samples per second")
    return section.number("start_s", 0.0) + np.arange(T) / rate


# --- camera --------------------------------------------------------------------------------------


def read_camera(section: Section) -> Camera:
    """The camera, by its matrices or by position, target and focal length."""
    width, height = section.integer("width_px"), section.integer("height_px")
    distortion = section.optional_array("distortion", (5,))
    with naming(section.path):
        if section.has("position_m") or section.has("target_m"):
            position = section.array("position_m", (3,))
            target = section.array("target_m", (3,))
            if np.linalg.norm(np.cross(target - position, [0, 0, 1])) < 1e-6:
                raise section.error(
                    "target_m", "straight above, below or at position_m, so upright is undefined; "
                    "give R_camera_world and t_camera_world_m"
                )  # fmt: skip
            aimed = Camera.looking_at(position, target, 1.0, max(width, 1), max(height, 1))
            R, t = aimed.R_camera_world, aimed.t_camera_world
        else:
            R = section.array("R_camera_world", (3, 3))
            t = section.array("t_camera_world_m", (3,))
        K = _intrinsics(section, width, height)
        assumed = section.optional_names("assumed") or ()
        camera = Camera(K, R, t, width, height, distortion, assumed)  # type: ignore[arg-type]
    if K[0, 0] < _SHORTEST_FOCAL * width:
        field = "K" if section.has("K") else "focal_px"
        raise section.error(
            field, f"a focal length of {K[0, 0]:g} px in images {width} px wide sees nearly everything "
            "before the camera; is it in mm? Give px: mm / width of the sensor in mm * width_px"
        )  # fmt: skip
    section.close()
    return camera


def _intrinsics(section: Section, width: int, height: int) -> Array:
    if section.has("K"):
        return section.array("K", (3, 3))
    focal = section.number("focal_px")
    centre = section.optional_array("principal_point_px", (2,))
    cx, cy = (width / 2, height / 2) if centre is None else centre
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def camera_table(camera: Camera) -> dict[str, Any]:
    """What `read_camera` reads back to the same bits."""
    assumed = {"assumed": list(camera.assumed)} if camera.assumed else {}
    return {
        **assumed,
        "width_px": int(camera.width_px),
        "height_px": int(camera.height_px),
        "K": camera.K.tolist(),
        "R_camera_world": camera.R_camera_world.tolist(),
        "t_camera_world_m": camera.t_camera_world.tolist(),
        "distortion": camera.distortion.tolist(),
    }


# --- keypoints -----------------------------------------------------------------------------------


def read_keypoints(section: Section, camera: Camera, skeleton: SkeletonModel) -> KeypointSequence:
    """The keypoints, with names that are landmarks of the skeleton."""
    if section.text("layout", OWN_LAYOUT) != OWN_LAYOUT:
        return _read_detected(section, camera, skeleton)
    path = data_path(section)
    is_csv = path.suffix.lower() == ".csv"
    names, arrays = read_keypoint_csv(path) if is_csv else _keypoint_npz(section, path, skeleton)
    unknown = [name for name in names if name and name not in skeleton.landmarks]
    if unknown:
        where = str(path) if is_csv else f"{section.path}, {section.where('landmarks')}"
        raise UnknownNameError(f"landmark in {where}", unknown, list(skeleton.landmarks))
    if is_csv and section.has("layout"):
        raise section.error("layout", "a .csv names its points itself; leave the layout out")
    uv = arrays["uv_px"]
    confidence: Array = np.asarray(np.isfinite(uv).all(axis=-1), dtype=np.float64)
    confidence = arrays.get("confidence", confidence)
    kept = [i for i, name in enumerate(names) if name]
    with naming(path):
        if confidence.shape != uv.shape[:2]:
            raise InvalidInputError(
                f"confidence: expected shape {uv.shape[:2]} as uv_px has, got {confidence.shape}"
            )
        sequence = KeypointSequence(
            camera=camera,
            times=read_times(section, path, arrays, len(uv)),
            uv_px=uv[:, kept],
            confidence=confidence[:, kept],
            names=tuple(names[i] for i in kept),
        )
    section.close()
    return sequence


def _keypoint_npz(
    section: Section, path: Path, skeleton: SkeletonModel
) -> tuple[tuple[str, ...], dict[str, Array]]:
    arrays = read_arrays(path, ("uv_px", "confidence", "times"))
    uv = needed(path, arrays, "uv_px", "(T, L, 2)")
    names = section.optional_names("landmarks")
    if section.has("layout"):
        if names is not None:
            raise section.error("layout", "stands beside landmarks; give only one of the two")
        names = skeleton.names
    if names is None:
        raise section.error("landmarks", "missing; list the names of the points in the file's order")
    if len(names) != uv.shape[1]:
        raise section.error(
            "landmarks", f"{len(names)} names, but {path} has {uv.shape[1]} points; name each one, "
            'with "" for those to leave out'
        )  # fmt: skip
    return names, arrays


def _read_detected(section: Section, camera: Camera, skeleton: SkeletonModel) -> KeypointSequence:
    """Keypoints from a detector's own file or folder, in its own layout; see `rtof_kin.vision`."""
    layout: str | None = section.text("layout")
    layouts = detector_table().layouts
    if layout not in (RECOGNISE, *layouts):
        known = ", ".join((RECOGNISE, *layouts))
        raise section.error(
            "layout", f"{layout!r} is not known; write one of {known}, or list names in landmarks"
        )  # fmt: skip
    if section.has("landmarks"):
        raise section.error("layout", "stands beside landmarks; give only one of the two")
    if skeleton.name != "total_capture":
        raise section.error(
            "layout", f"{layout!r} is for the skeleton total_capture, not {skeleton.name}; list the "
            f"names of the points in landmarks, or write {OWN_LAYOUT!r} for its joints in their order"
        )  # fmt: skip
    found = read_detector_keypoints(
        data_path(section, or_folder=True),
        camera,
        layout=None if layout == RECOGNISE else layout,
        rate_hz=section.optional_number("rate_hz"),
        start=section.number("start_s", 0.0),
        person=section.integer("person") if section.has("person") else None,
        frame=section.integer("frame") if section.has("frame") else None,
    )
    section.close()
    doubtful = found.track.people > 1 or bool(np.any(found.track.ambiguous | found.track.lost))
    _log.log(logging.WARNING if doubtful else logging.INFO, "%s: %s", section.path, found.summary)
    return found.keypoints


def read_keypoint_csv(path: Path) -> tuple[tuple[str, ...], dict[str, Array]]:
    """Landmark names and the arrays ``uv_px``, ``confidence`` and, where it has them, ``times``."""
    columns = read_csv(path)
    arrays = {"times": columns.pop("time")} if "time" in columns else {}
    names = csv_names(path, list(columns), _KEYPOINT_COLUMNS, optional=1)
    u, v = (np.stack([columns[n + end] for n in names], axis=1) for end in _KEYPOINT_COLUMNS[:2])
    arrays["uv_px"] = np.stack([u, v], axis=-1)
    seen = np.isfinite(arrays["uv_px"]).all(axis=-1).astype(float)
    given = [columns.get(f"{n}_confidence", seen[:, i]) for i, n in enumerate(names)]
    arrays["confidence"] = np.stack(given, axis=1)
    return names, arrays


def csv_names(path: Path, columns: list[str], endings: Sequence[str], optional: int = 0) -> tuple[str, ...]:
    """Names in the order of their first column; all columns but the last `optional` are needed."""
    names: dict[str, None] = {}
    for column in columns:
        ending = next((end for end in endings if column.endswith(end)), None)
        if ending is None:
            raise FileFormatError(
                path, f"column {column!r}: expected 'time', or a name with one of the endings "
                f"{', '.join(endings)}", 1
            )  # fmt: skip
        names[column.removesuffix(ending)] = None
    if not names:
        raise FileFormatError(path, f"no column ends in {endings[0]}", 1)
    required = endings[: len(endings) - optional]
    missing = [name + end for name in names for end in required if name + end not in columns]
    if missing:
        raise FileFormatError(path, f"the column {missing[0]!r} is missing", 1)
    return tuple(names)


# --- truth ---------------------------------------------------------------------------------------

_TRUTH = ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed")


def read_truth(section: Section, skeleton: SkeletonModel) -> PoseSequence:
    """Known poses, joints in the skeleton's order."""
    path = data_path(section)
    arrays = read_arrays(path, _TRUTH)
    for name, shape in zip(_TRUTH[:3], ("(T)", "(T, J, 3)", "(T, J, 3, 3)"), strict=True):
        needed(path, arrays, name, shape)
    section.close()
    with naming(path):
        return PoseSequence(names=skeleton.names, **arrays)  # type: ignore[arg-type]


def truth_arrays(truth: PoseSequence) -> dict[str, NDArray[Any]]:
    """The arrays that `read_truth` reads back to the same bits."""
    return {name: getattr(truth, name) for name in _TRUTH}
