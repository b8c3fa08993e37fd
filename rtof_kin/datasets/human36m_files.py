"""VideoPose3D's archives of Human3.6M, entry by entry, each checked when requested."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnitError, UnknownNameError
from rtof_kin.core.files.pickles import read_object_npz
from rtof_kin.core.files.text import LARGEST_NUMBER, load_json, measurable, read_text
from rtof_kin.data.camera import Camera

CAMERA_IDS = ("54138969", "55011271", "58860488", "60457274")  #: Serial numbers of cameras 0 to 3
_SIZES_PX = ((1000, 1002), (1000, 1000), (1000, 1000), (1000, 1002))  #: Width and height of their images, px
_TABLES = ("h36m_cameras_intrinsic_params", "h36m_cameras_extrinsic_params")
_LARGEST_FILE = 2**22
_PLAUSIBLE_DISTANCE = (1.0, 30.0)  #: Range of the distance of a camera from the world's origin, m


def read_cameras(path: str | Path) -> dict[str, dict[int, Camera]]:
    """Read the cameras in the file by subject ('S9') and number (0 to 3), world z up, m.

    The archives of poses have no cameras. They are in one of two public files:

    * JSON with ``intrinsics`` (camera: ``calibration_matrix``, ``distortion`` in OpenCV's order) and ``extrinsics``
      (subject, camera: ``R``, ``t`` in mm; p_camera = R p_world + t);
    * VideoPose3D's source ``h36m_dataset.py``, parsed as literals and never run. ``orientation`` is a quaternion
      w x y z from camera to world, ``translation`` the camera's centre, mm.

    Human3.6M orders the two tangential coefficients the other way round than OpenCV and halves some terms: projections
    differ by 0.1 px where people stand, by up to 1.4 px in corners.

    Raises:
        FileFormatError: another kind of file, or a missing or invalid entry.
        UnitError: an implausible position, not in millimetres.
    """
    path = Path(path)
    readers = {".json": _read_json, ".py": _read_source}
    if path.suffix.lower() not in readers:
        raise FileFormatError(
            path, "not a file of cameras; name the JSON file of camera parameters or VideoPose3D's h36m_dataset.py"
        )
    cameras = readers[path.suffix.lower()](path)
    if not cameras:
        raise FileFormatError(path, "there is no camera of any subject in it")
    return cameras


# --- the JSON file -------------------------------------------------------------------------------


def _read_json(path: Path) -> dict[str, dict[int, Camera]]:
    top = _table(path, "the file", load_json(path, _LARGEST_FILE))
    intrinsics = _table(path, "intrinsics", top.get("intrinsics"))
    cameras: dict[str, dict[int, Camera]] = {}
    for subject, entries in _table(path, "extrinsics", top.get("extrinsics")).items():
        placed = _table(path, f"extrinsics of {subject}", entries)
        found = {
            i: _json_camera(path, i, f"{subject}, camera {name}", intrinsics.get(name), placed[name])
            for i, name in enumerate(CAMERA_IDS)
            if placed.get(name)
        }
        if found:
            cameras[subject] = found
    return cameras


def _json_camera(path: Path, number: int, where: str, intrinsic: Any, extrinsic: Any) -> Camera:
    intrinsic = _table(path, f"{where}: intrinsics", intrinsic)
    extrinsic = _table(path, f"{where}: extrinsics", extrinsic)
    t_mm = _array(path, where, extrinsic, "t")
    K = _array(path, where, intrinsic, "calibration_matrix", (3, 3))
    R = _array(path, where, extrinsic, "R", (3, 3))
    t_mm = t_mm[:, 0] if t_mm.shape == (3, 1) else t_mm
    distortion = _array(path, where, intrinsic, "distortion", (5,))
    return _camera(path, where, K, R, t_mm, distortion, _SIZES_PX[number])


# --- VideoPose3D's source ------------------------------------------------------------------------


def _read_source(path: Path) -> dict[str, dict[int, Camera]]:
    text = read_text(path, "a list of cameras", _LARGEST_FILE)
    intrinsics, extrinsics = (_literal(path, text, name) for name in _TABLES)
    if not isinstance(intrinsics, list) or len(intrinsics) != len(CAMERA_IDS):
        raise FileFormatError(path, f"{_TABLES[0]} is not a list of four cameras")
    inner = [_table(path, f"{_TABLES[0]}, camera {i}", entry) for i, entry in enumerate(intrinsics)]
    ids = tuple(str(entry.get("id", CAMERA_IDS[i])) for i, entry in enumerate(inner))
    if ids != CAMERA_IDS:
        raise FileFormatError(path, f"cameras {', '.join(ids)}; expected {', '.join(CAMERA_IDS)}")
    cameras: dict[str, dict[int, Camera]] = {}
    for subject, entries in _table(path, _TABLES[1], extrinsics).items():
        if not isinstance(entries, list) or len(entries) != len(CAMERA_IDS):
            raise FileFormatError(path, f"{_TABLES[1]}: {subject} does not have four cameras")
        found = {
            i: _source_camera(path, f"{subject}, camera {i}", inner[i], entry)
            for i, entry in enumerate(entries)
            if entry
        }
        if found:
            cameras[subject] = found
    return cameras


def _literal(path: Path, text: str, name: str) -> Any:
    """Return the literal value of a name at a module's top level."""
    try:
        for statement in ast.parse(text).body:
            if isinstance(statement, ast.Assign) and any(
                isinstance(target, ast.Name) and target.id == name for target in statement.targets
            ):
                return ast.literal_eval(statement.value)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError) as error:
        raise FileFormatError(path, f"{name} is not written out in numbers ({error}); it is read, never run") from error
    raise FileFormatError(path, f"there is no {name} in it; name VideoPose3D's common/h36m_dataset.py")


def _source_camera(path: Path, where: str, intrinsic: Mapping[str, Any], extrinsic: Any) -> Camera:
    extrinsic = _table(path, where, extrinsic)
    (fx, fy), (cx, cy) = (_array(path, where, intrinsic, field, (2,)) for field in ("focal_length", "center"))
    quat_wxyz = _array(path, where, extrinsic, "orientation", (4,))
    if abs(np.linalg.norm(quat_wxyz) - 1) > 1e-3:
        raise FileFormatError(path, f"{where}: orientation is not a unit quaternion")
    R = so3.from_quat_wxyz(quat_wxyz).T
    k1, k2, k3 = _array(path, where, intrinsic, "radial_distortion", (3,))
    p_x, p_y = _array(path, where, intrinsic, "tangential_distortion", (2,))
    width, height = (_array(path, where, intrinsic, field, ()) for field in ("res_w", "res_h"))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    t_mm = -R @ _array(path, where, extrinsic, "translation", (3,))
    distortion = np.array([k1, k2, p_y, p_x, k3])
    return _camera(path, where, K, R, t_mm, distortion, (int(width), int(height)))


# --- both ----------------------------------------------------------------------------------------


def _table(path: Path, where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise FileFormatError(path, f"{where}: missing, or not a table of names and values")
    return value


def _array(path: Path, where: str, table: Mapping[str, Any], field: str, shape: tuple[int, ...] | None = None) -> Array:
    """Return a field's finite numbers, of that shape if one is given."""
    try:
        array = np.array(table[field], dtype=np.float64)
    except KeyError as error:
        raise FileFormatError(path, f"{where}: {field} is missing") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(path, f"{where}: {field} is not made of numbers ({error})") from error
    finite = np.all(np.isfinite(array)) and measurable(array)
    if (shape is not None and array.shape != shape) or not finite:
        raise FileFormatError(path, f"{where}: {field} is not finite, or not of shape {shape}: {array.shape}")
    return array


def _camera(
    path: Path, where: str, K: Array, R: Array, t_mm: Array, distortion: Array, size_px: tuple[int, int]
) -> Camera:
    try:
        camera = Camera(K, R, readonly("t", t_mm, (3,)) / 1000, *size_px, distortion)
    except InvalidInputError as error:
        raise FileFormatError(path, f"{where}: {error}") from error
    distance = float(np.linalg.norm(camera.center_world))
    low, high = _PLAUSIBLE_DISTANCE
    if not low < distance < high:
        raise UnitError(
            f"{path}: {where} would stand {distance:.3g} m from the middle of the room; its position "
            "must be in millimetres"
        )
    return camera


JOINTS_OF_32 = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
"""Indices of the skeleton table's 17 joints among the archive's 32."""
_CAMERA_FILES: Final = ("camera-parameters.json", "h36m_dataset.py")  #: Default names of the file of cameras
_SYMMETRY = [[4, 5, 6, 11, 12, 13], [1, 2, 3, 14, 15, 16]]


class Archives:
    """Archives of one folder, read when first needed.

    Attributes:
        path_3d, path_2d: of the archives of positions and keypoints.
    """

    def __init__(self, root: Path, cameras: Path | None, keypoints: str) -> None:
        """Name the files; see `rtof_kin.datasets.human36m.Human36M`."""
        self.root, self.kind = root, keypoints
        self.path_3d = root / "data_3d_h36m.npz"
        self.path_2d = root / f"data_2d_h36m_{keypoints}.npz"
        self._named_cameras = cameras

    @property
    def path_cameras(self) -> Path:
        """File of cameras; raises `FileFormatError` where there is none."""
        if self._named_cameras is not None:
            return self._named_cameras
        for name in _CAMERA_FILES:
            if (self.root / name).is_file():
                return self.root / name
        raise FileFormatError(
            self.root,
            f"neither {' nor '.join(_CAMERA_FILES)} is in this folder; name the file of "
            "cameras, which the archives of poses do not hold",
        )

    @cached_property
    def all_positions(self) -> Mapping[str, Mapping[str, Any]]:
        """Entries by subject and action; `positions` checks them."""
        (positions,) = read_object_npz(self.path_3d, ("positions_3d",))
        return _by_subject(self.path_3d, "positions_3d", positions)

    @cached_property
    def all_keypoints(self) -> Mapping[str, Mapping[str, Any]]:
        """Entries by subject and action; `keypoints` checks them."""
        if not self.path_2d.is_file():
            start = "data_2d_h36m_"
            known = [p.stem.removeprefix(start) for p in sorted(self.root.glob(f"{start}*.npz"))]
            raise UnknownNameError(f"keypoints in {self.root}", [self.kind], known or ["none"])
        positions, metadata = read_object_npz(self.path_2d, ("positions_2d", "metadata"))
        _check_metadata(self.path_2d, metadata)
        return _by_subject(self.path_2d, "positions_2d", positions)

    @cached_property
    def all_cameras(self) -> Mapping[str, Mapping[int, Camera]]:
        """Cameras by subject and number, 0 to 3."""
        return read_cameras(self.path_cameras)

    def positions(self, subject: str, action: str) -> Array:
        """Return (T, 17, 3) m, world z up; NaN where not finite."""
        actions = _entry(f"subject in {self.path_3d.name}", self.all_positions, subject)
        value = _entry(f"action of {subject} in {self.path_3d.name}", actions, action)
        p = _numbers(self.path_3d, f"{subject} {action!r}", value, (32, 3))[:, JOINTS_OF_32]
        if not np.isfinite(p).all(axis=(1, 2)).any():
            problem = f"{subject} {action!r}: in no frame are all joints finite"
            raise FileFormatError(self.path_3d, problem)
        return p

    def keypoints(self, subject: str, action: str, camera: int) -> Array:
        """Return (T', 17, 2) px of camera 0 to 3; NaN where not finite. T' may differ from T by some frames."""
        actions = _entry(f"subject in {self.path_2d.name}", self.all_keypoints, subject)
        cameras = _entry(f"action of {subject} in {self.path_2d.name}", actions, action)
        if not isinstance(cameras, list | tuple) or len(cameras) != len(CAMERA_IDS):
            problem = f"{subject} {action!r}: not a list of four cameras"
            raise FileFormatError(self.path_2d, problem)
        where = f"{subject} {action!r}, camera {camera}"
        uv = _numbers(self.path_2d, where, cameras[camera], (17, 2))
        if not np.isfinite(uv).any():
            raise FileFormatError(self.path_2d, f"{where}: there is no finite number")
        return uv

    def camera(self, subject: str, number: int) -> Camera:
        """Return a subject's camera, 0 to 3."""
        name = self.path_cameras.name
        cameras: Mapping[int, Camera] = _entry(f"subject in {name}", self.all_cameras, subject)
        if number not in cameras:
            known = [str(i) for i in sorted(cameras)]
            raise UnknownNameError(f"camera of {subject} in {name}", [str(number)], known)
        return cameras[number]


def by_number(subjects: Iterable[str]) -> list[str]:
    """Return subjects in the order of their numbers: S9 before S11."""
    return sorted(subjects, key=lambda name: (len(name), name))


def _by_subject(path: Path, name: str, value: Any) -> Mapping[str, Mapping[str, Any]]:
    if not isinstance(value, dict) or not all(isinstance(v, dict) for v in value.values()):
        raise FileFormatError(path, f"{name}: not a dictionary of subjects, each one of actions")
    return value


def _check_metadata(path: Path, metadata: Any) -> None:
    """Check that the 17 points are Human3.6M's joints and not, for example, COCO's."""
    given = metadata if isinstance(metadata, dict) else {}
    layout = given.get("layout_name", "h36m")
    try:
        sides = [[int(i) for i in side] for side in given.get("keypoints_symmetry", ())]
    except (TypeError, ValueError):
        sides = []
    if given.get("num_joints") != 17 or layout != "h36m" or sides != _SYMMETRY:
        raise FileFormatError(
            path,
            f"metadata: {given.get('num_joints')} points, layout {layout!r}, left and right "
            f"{sides}; only Human3.6M's own 17 joints can be compared with its positions",
        )


def _entry(kind: str, table: Mapping[str, Any], name: str) -> Any:
    if name not in table:
        raise UnknownNameError(kind, [name], by_number(table))
    return table[name]


def _numbers(path: Path, where: str, value: Any, shape: tuple[int, int]) -> Array:
    """Return an array (T, *shape) of float64, NaN where not finite."""
    if not isinstance(value, np.ndarray) or value.ndim != 3 or value.shape[1:] != shape:
        have = getattr(value, "shape", type(value).__name__)
        raise FileFormatError(path, f"{where}: expected shape (T, {shape[0]}, {shape[1]}), got {have}")
    with np.errstate(invalid="ignore"):  # some NaNs are said to be invalid when they are cast
        numbers = value.astype(np.float64)
    return np.where(np.abs(numbers) <= LARGEST_NUMBER, numbers, np.nan)
