"""VideoPose3D's archives of Human3.6M, entry by entry, each checked when requested."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.pickles import read_object_npz
from rtof_kin.core.files.text import LARGEST_NUMBER
from rtof_kin.data.camera import Camera
from rtof_kin.datasets.human36m_cameras import CAMERA_IDS, read_cameras

JOINTS_OF_32 = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
"""Indices of the skeleton table's 17 joints among the archive's 32."""
_CAMERA_FILES: Final = ("camera-parameters.json", "h36m_dataset.py")
"""Default names of the file of cameras."""
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
        """Return (T', 17, 2) px; NaN where not finite. T' may differ from T by some frames.

        Args:
            camera: 0 to 3.
        """
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
        """Return a subject's camera.

        Args:
            number: 0 to 3.
        """
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
