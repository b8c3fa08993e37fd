"""VideoPose3D's archives of Human3.6M as plain arrays, each read and checked when requested."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BeforeValidator, ConfigDict

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnitError, UnknownNameError, reading
from rtof_kin.core.files.arrays import npz_names, read_npz_as_saved
from rtof_kin.core.files.input_table import ArrayOf, InputTable, Integer, Matrix3, Quaternion, Vector2, Vector3, Vector5
from rtof_kin.core.files.text import LARGEST_NUMBER, load_json, read_text
from rtof_kin.data.camera import Camera

CAMERA_IDS = ("54138969", "55011271", "58860488", "60457274")  #: Serial numbers of cameras 0 to 3
_SIZES_PX = ((1000, 1002), (1000, 1000), (1000, 1000), (1000, 1002))  #: Width and height of their images, px
_LARGEST_FILE = 2**22
_PLAUSIBLE_DISTANCE = (1.0, 30.0)  #: Range of the distance of a camera from the world's origin, m


class _Table(InputTable):
    """Further fields may stand in it."""

    model_config = ConfigDict(extra="ignore")


class _JsonIntrinsics(_Table):
    calibration_matrix: Matrix3
    distortion: Vector5


class _JsonExtrinsics(_Table):
    R: Matrix3
    t: Annotated[Array, ArrayOf(3, also=((3, 1),))]


class _SourceIntrinsics(_Table):
    id: str
    center: Vector2
    focal_length: Vector2
    radial_distortion: Vector3
    tangential_distortion: Vector2
    res_w: Integer
    res_h: Integer


class _SourceExtrinsics(_Table):
    orientation: Quaternion
    translation: Vector3


_OR_EMPTY: Final = BeforeValidator(lambda value: value or None)


class _Json(_Table):
    intrinsics: dict[str, _JsonIntrinsics]
    extrinsics: dict[str, dict[str, Annotated[_JsonExtrinsics | None, _OR_EMPTY]]]


class _Source(_Table):
    h36m_cameras_intrinsic_params: list[_SourceIntrinsics]
    h36m_cameras_extrinsic_params: dict[str, list[Annotated[_SourceExtrinsics | None, _OR_EMPTY]]]


def read_cameras(path: str | Path) -> dict[str, dict[int, Camera]]:
    """Read the cameras in the file by subject ('S9') and number (0 to 3), world z up, m.

    The archives of poses have no cameras. They are in one of two public files:

    * JSON with ``intrinsics`` (camera: ``calibration_matrix``, ``distortion`` in OpenCV's order) and ``extrinsics``
      (subject, camera: ``R``, ``t`` in mm; p_camera = R p_world + t);
    * VideoPose3D's source ``h36m_dataset.py``, parsed as literals and never run. ``orientation`` is a quaternion
      w x y z from camera to world, ``translation`` the camera's centre, mm.

    Human3.6M orders the two tangential coefficients the other way round than OpenCV and halves some terms: projections
    differ by 0.1 px where people stand, by up to 1.4 px in corners. `FileFormatError`: another kind of file, or a
    missing or invalid entry; `UnitError`: an implausible position, not in millimetres.
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


def _read_json(path: Path) -> dict[str, dict[int, Camera]]:
    table = _Json.of(load_json(path, _LARGEST_FILE), path)
    cameras: dict[str, dict[int, Camera]] = {}
    for subject, placed in table.extrinsics.items():
        for i, name in enumerate(CAMERA_IDS):
            if (extrinsic := placed.get(name)) is None:
                continue
            if (own := table.intrinsics.get(name)) is None:
                raise table.error("intrinsics", f"camera {name} of {subject} is missing")
            where, t_mm = f"{subject}, camera {name}", np.ravel(extrinsic.t)
            cameras.setdefault(subject, {})[i] = _camera(
                path, where, own.calibration_matrix, extrinsic.R, t_mm, own.distortion, _SIZES_PX[i]
            )
    return cameras


def _read_source(path: Path) -> dict[str, dict[int, Camera]]:
    text = read_text(path, "a list of cameras", _LARGEST_FILE)
    table = _Source.of({name: _literal(path, text, name) for name in _Source.model_fields}, path)
    inner = table.h36m_cameras_intrinsic_params
    if (ids := tuple(one.id for one in inner)) != CAMERA_IDS:
        raise FileFormatError(path, f"cameras {', '.join(ids)}; expected {', '.join(CAMERA_IDS)}")
    cameras: dict[str, dict[int, Camera]] = {}
    for subject, entries in table.h36m_cameras_extrinsic_params.items():
        if len(entries) != len(CAMERA_IDS):
            raise FileFormatError(path, f"{subject} does not have four cameras")
        for i, (own, extrinsic) in enumerate(zip(inner, entries, strict=True)):
            if extrinsic is None:
                continue
            where, ((fx, fy), (cx, cy)) = f"{subject}, camera {i}", (own.focal_length, own.center)
            if abs(np.linalg.norm(extrinsic.orientation) - 1) > 1e-3:
                raise FileFormatError(path, f"{where}: orientation is not a unit quaternion")
            R = so3.from_quat_wxyz(extrinsic.orientation).T
            K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            (k1, k2, k3), (p_x, p_y) = own.radial_distortion, own.tangential_distortion
            distortion, size = np.array([k1, k2, p_y, p_x, k3]), (own.res_w, own.res_h)
            t_mm = -R @ extrinsic.translation
            cameras.setdefault(subject, {})[i] = _camera(path, where, K, R, t_mm, distortion, size)
    return cameras


def _literal(path: Path, text: str, name: str) -> Any:
    """Return the literal value of a name at a module's top level."""
    problem = f"{name} is not written out in numbers ({{}}); it is read, never run"
    with reading(path, problem, SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        for statement in ast.parse(text).body:
            if isinstance(statement, ast.Assign) and any(
                isinstance(target, ast.Name) and target.id == name for target in statement.targets
            ):
                return ast.literal_eval(statement.value)
    raise FileFormatError(path, f"there is no {name} in it; name VideoPose3D's common/h36m_dataset.py")


def _camera(
    path: Path, where: str, K: Array, R: Array, t_mm: Array, distortion: Array, size_px: tuple[int, int]
) -> Camera:
    with reading(path, f"{where}: {{}}"):
        camera = Camera(K, R, t_mm / 1000, *size_px, distortion)
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

    def __init__(self, root: str | Path, cameras: str | Path | None = None, keypoints: str = "gt") -> None:
        """Name the files.

        Args:
            root: folder with ``data_3d_h36m.npz`` and ``data_2d_h36m_<keypoints>.npz``.
            cameras: file of cameras; by default ``camera-parameters.json`` or ``h36m_dataset.py`` in `root`.
            keypoints: 'gt' for projected joints, else the detector's part of the file name.
        """
        self.root, self.kind = Path(root), keypoints
        self.path_3d = self.root / "data_3d_h36m.npz"
        self.path_2d = self.root / f"data_2d_h36m_{keypoints}.npz"
        self._named_cameras = None if cameras is None else Path(cameras)

    @property
    def path_cameras(self) -> Path:
        """File of cameras; raises `FileFormatError` where there is none."""
        paths = [self._named_cameras] if self._named_cameras else [self.root / name for name in _CAMERA_FILES]
        if found := [path for path in paths if self._named_cameras or path.is_file()]:
            return found[0]
        raise FileFormatError(
            self.root,
            f"neither {' nor '.join(_CAMERA_FILES)} is in this folder; name the file of "
            "cameras, which the archives of poses do not hold",
        )

    @cached_property
    def all_positions(self) -> Mapping[str, Mapping[str, Sequence[str]]]:
        """Names of arrays by subject and action; `positions` reads and checks them."""
        return _by_subject(self.path_3d, "positions_3d")

    @cached_property
    def all_keypoints(self) -> Mapping[str, Mapping[str, Sequence[str]]]:
        """Names of the arrays of all cameras by subject and action; `keypoints` reads and checks them."""
        if not self.path_2d.is_file():
            start = "data_2d_h36m_"
            known = [p.stem.removeprefix(start) for p in sorted(self.root.glob(f"{start}*.npz"))]
            raise UnknownNameError(f"keypoints in {self.root}", [self.kind], known or ["none"])
        found = _by_subject(self.path_2d, "positions_2d")
        _check_metadata(self.path_2d)
        return found

    @cached_property
    def all_cameras(self) -> Mapping[str, Mapping[int, Camera]]:
        """Cameras by subject and number, 0 to 3."""
        return read_cameras(self.path_cameras)

    def positions(self, subject: str, action: str) -> Array:
        """Return (T, 17, 3) m, world z up; NaN where not finite."""
        (name, *_) = _entry(self.path_3d, self.all_positions, subject, action)
        p = _numbers(self.path_3d, f"{subject} {action!r}", name, (32, 3))[:, JOINTS_OF_32]
        if not np.isfinite(p).all(axis=(1, 2)).any():
            raise FileFormatError(self.path_3d, f"{subject} {action!r}: in no frame are all joints finite")
        return p

    def keypoints(self, subject: str, action: str, camera: int) -> Array:
        """Return (T', 17, 2) px of camera 0 to 3; NaN where not finite. T' may differ from T by some frames."""
        names = _entry(self.path_2d, self.all_keypoints, subject, action)
        where = f"{subject} {action!r}, camera {camera}"
        if [name.rpartition("/")[2] for name in names] != ["0", "1", "2", "3"]:
            raise FileFormatError(self.path_2d, f"{where}: not of four cameras")
        uv = _numbers(self.path_2d, where, names[camera], (17, 2))
        if not np.isfinite(uv).any():
            raise FileFormatError(self.path_2d, f"{where}: there is no finite number")
        return uv

    def camera(self, subject: str, number: int) -> Camera:
        """Return a subject's camera, 0 to 3."""
        name, cameras = self.path_cameras.name, self.all_cameras
        if subject not in cameras:
            raise UnknownNameError(f"subject in {name}", [subject], by_number(cameras))
        if number not in cameras[subject]:
            known = [str(i) for i in sorted(cameras[subject])]
            raise UnknownNameError(f"camera of {subject} in {name}", [str(number)], known)
        return cameras[subject][number]


def by_number(subjects: Iterable[str]) -> list[str]:
    """Return subjects in the order of their numbers: S9 before S11."""
    return sorted(subjects, key=lambda name: (len(name), name))


def _by_subject(path: Path, kind: str) -> dict[str, dict[str, list[str]]]:
    """Return the names of the arrays of a kind by subject and action."""
    found: dict[str, dict[str, list[str]]] = {}
    for name in npz_names(path):
        if name.startswith(f"{kind}/") and name.count("/") > 1:
            _, subject, action, *_ = name.split("/")
            found.setdefault(subject, {}).setdefault(action, []).append(name)
    if not found:
        problem = f"no array {kind}/SUBJECT/ACTION; convert VideoPose3D's archive by examples/convert_pickles.py"
        raise FileFormatError(path, problem)
    return found


def _check_metadata(path: Path) -> None:
    """Check that the 17 points are Human3.6M's joints and not, for example, COCO's."""
    names = ("num_joints", "layout_name", "keypoints_symmetry")
    arrays = read_npz_as_saved(path, kinds="fiuU", names=[f"metadata/{name}" for name in names])
    points, layout, sides = (arrays[key].tolist() if (key := f"metadata/{name}") in arrays else None for name in names)
    if points != 17 or layout not in (None, "h36m") or sides != _SYMMETRY:
        raise FileFormatError(
            path,
            f"metadata: {points} points, layout {layout!r}, left and right {sides}; only Human3.6M's own 17 joints "
            "can be compared with its positions",
        )


def _entry(path: Path, table: Mapping[str, Mapping[str, Sequence[str]]], subject: str, action: str) -> Sequence[str]:
    """Return what an archive has of an action."""
    if subject not in table:
        raise UnknownNameError(f"subject in {path.name}", [subject], by_number(table))
    if action not in table[subject]:
        raise UnknownNameError(f"action of {subject} in {path.name}", [action], by_number(table[subject]))
    return table[subject][action]


def _numbers(path: Path, where: str, name: str, shape: tuple[int, int]) -> Array:
    """Return an array (T, *shape) of float64, NaN where not finite."""
    value = read_npz_as_saved(path, names=[name])[name]
    if value.ndim != 3 or value.shape[1:] != shape:
        raise FileFormatError(path, f"{where}: expected shape (T, {shape[0]}, {shape[1]}), got {value.shape}")
    with np.errstate(invalid="ignore"):  # some NaNs are said to be invalid when they are cast
        numbers = value.astype(np.float64)
    return np.where(np.abs(numbers) <= LARGEST_NUMBER, numbers, np.nan)
