"""Parts of a recording folder, read and written. The format is described in docs/recording.md."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
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
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.cameras import read_camera as read_camera_file
from rtof_kin.formats.imu_calibration_toml import calibration_of
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.layouts import detector_table, is_detector_point

_OWN_LAYOUT: Final = "joints"
RECOGNISE: Final = "auto"  # a detector's layout that is to be recognised
_SHORTEST_FOCAL: Final = 0.1  # of the image's width; a shorter focal length is in another unit
_QUATERNION_TOLERANCE: Final = 1e-3
_KEYPOINT_COLUMNS: Final = ("_u_px", "_v_px", "_confidence")
_IMU_COLUMNS: Final = ("_qw", "_qx", "_qy", "_qz", "_fx", "_fy", "_fz")
TRUTH: Final = ("times", "p_world_joint", "R_world_bone", "provenance", "valid", "orientation_observed")
"""Fields of `PoseSequence` in a file."""
_log = logging.getLogger(__name__)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the name of a file in front of errors that data types raise inside.

    Args:
        path: the file.
    """
    try:
        yield
    except UnitError as error:
        raise UnitError(f"{path}: {error}") from error
    except (InvalidInputError, CalibrationError) as error:
        raise FileFormatError(path, str(error)) from error


def read_arrays(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Read the arrays of an .npz file.

    Args:
        path: the file. wanted: names that it may have; others raise `UnknownNameError`.
    """
    arrays = read_npz(path)
    unknown = sorted(set(arrays) - set(wanted))
    if unknown:
        raise UnknownNameError(f"array in {path}", unknown, wanted)
    return arrays


def needed(path: Path, arrays: dict[str, Array], name: str, shape: str) -> Array:
    """Return a required array, or raise `FileFormatError`.

    Args:
        path: the file. arrays: its content. name: of the array. shape: its axes, e.g. ``"(T, S, 4)"``.
    """
    if name not in arrays:
        have = ", ".join(arrays) or "nothing"
        raise FileFormatError(path, f"no array {name!r} of shape {shape}; there is {have}")
    if arrays[name].ndim != shape.count(",") + 1:
        raise FileFormatError(path, f"{name}: expected shape {shape}, got {arrays[name].shape}")
    return arrays[name]


def data_path(section: Section, or_folder: bool = False) -> Path:
    """Return the file (or folder) inside the recording's folder that a section's field ``file`` names."""
    name = section.text("file")
    path = path_inside(section.path.parent, name)
    if path is None:
        raise section.error("file", f"{name!r} leads out of the folder; name a file inside it")
    if not path.is_file() and not (or_folder and path.is_dir()):
        raise section.error("file", f"there is no file {path}; put it there or correct the name")
    return path


def _times(section: Section, path: Path, arrays: dict[str, Array], T: int) -> Array:
    """Return times (T,) in s: those of the file, or evenly spaced at ``rate_hz`` from ``start_s``."""
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
    """Read a camera given by its matrices, by position, target and focal length, or by a calibration file.

    Args:
        section: table ``[camera]``; its ``motion`` is read by `camera_motion_files`.
    """
    section.has("motion")
    if section.has("file"):
        path, name, up = data_path(section), section.optional_text("name"), section.text("up", "z")
        with naming(section.path):
            camera = read_camera_file(
                path, name, up=up, metres_per_unit=section.number("metres_per_unit", 1.0)
            )
        section.close()
        return camera
    width, height = section.integer("width_px"), section.integer("height_px")
    with naming(section.path):
        if section.has("position_m") or section.has("target_m"):
            position, target = section.array("position_m", (3,)), section.array("target_m", (3,))
            if np.linalg.norm(np.cross(target - position, [0, 0, 1])) < 1e-6:
                raise section.error(
                    "target_m", "straight above, below or at position_m, so upright is undefined; "
                    "give R_camera_world and t_camera_world_m"
                )  # fmt: skip
            aimed = Camera.looking_at(position, target, 1.0, max(width, 1), max(height, 1))
            R, t = aimed.R_camera_world, aimed.t_camera_world
        else:
            R, t = section.array("R_camera_world", (3, 3)), section.array("t_camera_world_m", (3,))
        K = _intrinsics(section, width, height)
        distortion = section.array("distortion", (5,)) if section.has("distortion") else np.zeros(5)
        assumed = section.optional_names("assumed") or ()
        camera = Camera(K, R, t, width, height, distortion, assumed, section.flag("stabilised"))
    if K[0, 0] < _SHORTEST_FOCAL * width:
        raise section.error(
            "K" if section.has("K") else "focal_px", f"a focal length of {K[0, 0]:g} px in images {width} "
            "px wide sees nearly everything before the camera; is it in mm? Give px: mm / width of the "
            "sensor in mm * width_px"
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
    """Return the table that `read_camera` reads back exactly.

    Args:
        camera: to write.
    """
    assumed = {"assumed": list(camera.assumed)} if camera.assumed else {}
    stabilised = {"stabilised": True} if camera.stabilised else {}
    return {**assumed, **stabilised} | {
        "width_px": int(camera.width_px),
        "height_px": int(camera.height_px),
        "K": camera.K.tolist(),
        "R_camera_world": camera.R_camera_world.tolist(),
        "t_camera_world_m": camera.t_camera_world.tolist(),
        "distortion": camera.distortion.tolist(),
    }


# --- keypoints -----------------------------------------------------------------------------------


def read_keypoints(section: Section, camera: Camera, skeleton: SkeletonModel) -> KeypointSequence:
    """Read keypoints whose names are landmarks of the skeleton.

    Args:
        section: table ``[keypoints]``. camera: that saw them. skeleton: that has the landmarks.
    """
    if section.text("layout", _OWN_LAYOUT) != _OWN_LAYOUT:
        return _read_detected(section, camera, skeleton)
    path = data_path(section)
    is_csv = path.suffix.lower() == ".csv"
    if is_csv and section.has("layout"):
        raise section.error("layout", "a .csv names its points itself; leave the layout out")
    names, arrays = read_keypoint_csv(path) if is_csv else _keypoint_npz(section, path, skeleton)
    unknown = [n for n in names if n and n not in skeleton.landmarks and not is_detector_point(n)]
    if unknown:
        where = str(path) if is_csv else f"{section.path}, {section.where('landmarks')}"
        raise UnknownNameError(f"landmark in {where}", unknown, list(skeleton.landmarks))
    kept = [i for i, name in enumerate(names) if name]
    with naming(path):
        uv, confidence = keypoint_arrays(arrays)
        times, named = _times(section, path, arrays, len(uv)), tuple(names[i] for i in kept)
        section.close()
        return KeypointSequence(camera, times, uv[:, kept], confidence[:, kept], named)


def keypoint_arrays(arrays: dict[str, Array]) -> tuple[Array, Array]:
    """Return pixels and confidences, 1 for every point seen where the file has none.

    Args:
        arrays: uv_px (T, L, 2) and maybe confidence (T, L).
    """
    uv = arrays["uv_px"]
    confidence: Array = arrays.get("confidence", np.isfinite(uv).all(axis=-1).astype(float))
    if confidence.shape != uv.shape[:2]:
        raise InvalidInputError(
            f"confidence: expected shape {uv.shape[:2]} as uv_px has, got {confidence.shape}"
        )
    return uv, confidence


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
    """Read keypoints from a detector's own file or folder, in its own layout; see `rtof_kin.vision`."""
    layout = section.text("layout")
    known = ", ".join((RECOGNISE, *detector_table().layouts))
    if layout not in known.split(", "):
        raise section.error("layout", f"{layout!r} is not known; write one of {known}, or list landmarks")
    if section.has("landmarks"):
        raise section.error("layout", "stands beside landmarks; give only one of the two")
    if skeleton.name != "total_capture":
        raise section.error(
            "layout", f"{layout!r} is for the skeleton total_capture, not {skeleton.name}; list the "
            f"names of the points in landmarks, or write {_OWN_LAYOUT!r} for its joints in their order"
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
    """Return landmark names and the arrays uv_px (T, L, 2), confidence (T, L) and, if present, times (T,).

    Args:
        path: a .csv file with the columns of a recording's keypoints.
    """
    columns = read_csv(path)
    arrays = {"times": columns.pop("time")} if "time" in columns else {}
    names = _csv_names(path, list(columns), _KEYPOINT_COLUMNS, optional=1)
    uv = np.stack([[columns[n + end] for end in _KEYPOINT_COLUMNS[:2]] for n in names]).transpose(2, 0, 1)
    seen = np.isfinite(uv).all(axis=-1).astype(float)
    given = [columns.get(f"{n}_confidence", seen[:, i]) for i, n in enumerate(names)]
    return names, arrays | {"uv_px": uv, "confidence": np.stack(given, axis=1)}


def _csv_names(path: Path, columns: list[str], endings: Sequence[str], optional: int = 0) -> tuple[str, ...]:
    """Return names in the order of their first column; all but the last `optional` endings are required."""
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


# --- IMUs ----------------------------------------------------------------------------------------


def read_imus(section: Section, skeleton: SkeletonModel) -> tuple[ImuSequence | None, ImuCalibration | None]:
    """Read sensor data, where the section names a file, and their calibration, where it has one.

    Args:
        section: table ``[imus]``. skeleton: with the usual places of sensors.
    """
    calibration = calibration_of(section.table("sensors"), skeleton)
    imus = _imu_sequence(section, calibration) if section.has("file") else None
    if imus is not None and calibration is not None:
        missing = [name for name in imus.names if name not in calibration.sensors]
        if missing:
            where = f"sensor (it has no table [imus.sensors.*] in {section.path})"
            raise UnknownNameError(where, missing, calibration.sensors)
    section.close()
    return imus, calibration


def _imu_sequence(section: Section, calibration: ImuCalibration | None) -> ImuSequence:
    path = data_path(section)
    if path.suffix.lower() == ".csv":
        names, arrays = _imu_csv(path)
    else:
        arrays = read_arrays(path, ("quat_wxyz", "R_inertial_sensor", "f_sensor", "times"))
        listed = section.optional_names("names")
        if listed is None and calibration is not None:
            listed = calibration.sensors
        if listed is None:
            raise section.error("names", "missing; list the sensors in the file's order")
        names = listed
    f = needed(path, arrays, "f_sensor", "(T, S, 3)")
    if f.shape[1] != len(names):
        raise section.error(
            "names", f"{len(names)} sensors are named, but {path} has {f.shape[1]}; list them in the "
            "file's order"
        )  # fmt: skip
    with naming(path):
        R = _imu_rotations(path, arrays, names)
        return ImuSequence(_times(section, path, arrays, len(f)), R, f, names)


def _imu_rotations(path: Path, arrays: dict[str, Array], names: Sequence[str]) -> Array:
    if ("quat_wxyz" in arrays) == ("R_inertial_sensor" in arrays):
        raise FileFormatError(path, "give one of quat_wxyz (T, S, 4) and R_inertial_sensor")
    if "R_inertial_sensor" in arrays:
        return needed(path, arrays, "R_inertial_sensor", "(T, S, 3, 3)")
    quat = needed(path, arrays, "quat_wxyz", "(T, S, 4)")
    shape = (len(arrays["f_sensor"]), len(names), 4)
    if quat.shape != shape:
        raise FileFormatError(path, f"quat_wxyz: expected shape {shape}, got {quat.shape}")
    norm = np.linalg.norm(quat, axis=-1)
    known = ~np.isnan(norm)
    wrong = known & ~(np.abs(norm - 1) <= _QUATERNION_TOLERANCE)
    if np.any(wrong):
        t, s = (int(i) for i in np.argwhere(wrong)[0])
        raise FileFormatError(
            path, f"quat_wxyz: sample {t} of {names[s]} has norm {norm[t, s]:.6g}, not 1; normalise "
            "it, or write NaN where a sample is missing"
        )  # fmt: skip
    R = np.full((*quat.shape[:2], 3, 3), np.nan)
    R[known] = so3.from_quat_wxyz(quat[known])
    return R


def _imu_csv(path: Path) -> tuple[tuple[str, ...], dict[str, Array]]:
    columns = read_csv(path)
    arrays = {"times": columns.pop("time")} if "time" in columns else {}
    names = _csv_names(path, list(columns), _IMU_COLUMNS)
    values = np.stack([[columns[n + end] for end in _IMU_COLUMNS] for n in names]).transpose(2, 0, 1)
    return names, arrays | {"quat_wxyz": values[..., :4], "f_sensor": values[..., 4:]}


# --- truth ---------------------------------------------------------------------------------------


def read_truth(section: Section, skeleton: SkeletonModel) -> PoseSequence:
    """Read known poses, joints in the skeleton's order.

    Args:
        section: table ``[truth]``. skeleton: that names the joints.
    """
    path = data_path(section)
    arrays = read_arrays(path, TRUTH)
    for name, shape in zip(TRUTH[:3], ("(T)", "(T, J, 3)", "(T, J, 3, 3)"), strict=True):
        needed(path, arrays, name, shape)
    section.close()
    with naming(path):
        return PoseSequence(names=skeleton.names, **arrays)  # type: ignore[arg-type]
