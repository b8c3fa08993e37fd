"""Cameras from calibration files: this package's TOML, OpenCV's YAML and JSON.

YAML or JSON, as OpenCV's FileStorage, ROS and people write them::

    image_width: 1920
    image_height: 1080
    camera_matrix: !!opencv-matrix        # rows, cols, dt and data: [1250., 0., 960., ...]
    distortion_coefficients: !!opencv-matrix
    R: !!opencv-matrix                    # world to camera: a matrix or a rotation vector, rad
    T: !!opencv-matrix                    # p_camera = R p_world + T

`_NAMES` lists the other names of these entries; plain lists are accepted for matrices. A file holds one
camera, a table for each of several, or a stereo pair (M1, D1, M2, D2, R, T), whose world is the first
camera. The file states neither its up axis nor its unit of length: the caller does. Unknown tags are
refused, and aliases, by which a small file can grow without end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.text import LARGEST_NUMBER, read_text
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import camera_in_world, read_camera_toml

LARGEST_BYTES: Final = 4 * 2**20  #: Largest file that is read, bytes
_DEEPEST: Final = 12
_NAMES: Final = {
    "matrix": ("camera_matrix", "cameraMatrix", "K", "M", "mtx", "intrinsic_matrix", "intrinsics"),
    "distortion": ("distortion_coefficients", "distCoeffs", "dist_coeffs", "dist_coeff", "dist", "D", "distortion"),
    "rotation": ("R", "rvec", "rotation", "rotation_matrix", "rotation_vector"),
    "translation": ("T", "t", "tvec", "translation", "translation_vector"),
    "pose": ("extrinsics", "extrinsic", "extrinsic_matrix", "T_camera_world"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "size": ("image_size", "imageSize", "size", "resolution"),
    "name": ("camera_name", "name"),
}
"""Accepted names of the entries. 'pose' is 3 x 4 or 4 x 4, [R T]; 'size' is width, height."""
MATRIX_NAMES: Final = _NAMES["matrix"]  #: Names of the entry that every camera has


def read_opencv_yaml(
    path: str | Path,
    *,
    up: str = "z",
    metres_per_unit: float = 1.0,
    extrinsics: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
) -> dict[str, Camera]:
    """Read the cameras of a file by name, in its order, into a world with z up. `FileFormatError`: no such file, no
    camera in it, or an incomplete camera; names the entry. `UnitError`: a camera is too far away for metres.
    `InvalidInputError`: invalid `up` or `metres_per_unit`.

    Args:
        path: the file; .yml, .yaml or .json.
        up: the file's axis that points up, see `rtof_kin.formats.world_axes.UP`. Without a pose, and in
            a stereo pair, the file's world is the camera's own axes: '-y' for a level camera.
        metres_per_unit: length of the file's unit, m; 0.001 for mm.
        extrinsics: a second file whose entries are added; OpenCV's stereo sample writes two.
        size_px: width and height of the images, for a file without them.
    """
    content = _load_yaml(Path(path))
    if extrinsics is not None:
        content |= _load_yaml(Path(extrinsics))
    cameras: dict[str, Camera] = {}
    for name, table in _tables(Path(path), content).items():
        entries = _Entries(Path(path), name, table)
        R, t = entries.pose()
        if R is None and cameras:
            raise entries.error("R", "missing, as is T; each camera but a first one needs a pose")
        if R is None and up == "z":
            raise entries.error(
                "R",
                "missing, so the world is this camera's own axes, and z is its viewing direction; "
                "add R and T, or declare up='-y' for a level camera",
            )
        K, distortion, size = entries.array("matrix", 9).reshape(3, 3), entries.distortion(), size_px or entries.size()
        pose, assumed = (np.eye(3) if R is None else R, t), ("pose",) if R is None else ()
        cameras[name] = camera_in_world(path, name, up, metres_per_unit, K, pose, size, distortion, assumed)
    return cameras


# --- YAML ----------------------------------------------------------------------------------------


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain values, and OpenCV's matrices as mappings."""


for _tag in ("opencv-matrix", "opencv-nd-matrix"):  # the latter is OpenCV 5's for vectors
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", lambda loader, node: loader.construct_mapping(node, deep=True))


def _load_yaml(path: Path) -> dict[str, Any]:
    """Return the entries of a YAML or JSON file; nothing in it is executed."""
    text = read_text(path, "a YAML file", LARGEST_BYTES)
    if text.startswith("%YAML"):  # OpenCV's version line is not valid YAML
        text = "#" + text
    try:
        _check_structure(path, text)
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError) as error:
        if isinstance(error, FileFormatError):
            raise
        where = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error)
        line = where.line + 1 if where is not None else None
        raise FileFormatError(path, f"not readable as YAML: {problem}"[:300], line) from error
    if not isinstance(content, dict):
        raise FileFormatError(path, "not a table of entries such as camera_matrix")
    return {str(key): value for key, value in content.items()}


def _check_structure(path: Path, text: str) -> None:
    """Refuse aliases and deep nesting, which can take unbounded time, before anything is built."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        line = event.start_mark.line + 1 if event.start_mark else None
        if isinstance(event, yaml.AliasEvent):
            raise FileFormatError(path, "an alias; write the value out", line)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise FileFormatError(path, f"nested more than {_DEEPEST} deep", line)


# --- meaning of the entries ----------------------------------------------------------------------


def _tables(path: Path, content: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the entries of each camera, by its name."""
    if _named(content, "matrix") is not None:
        name = _named(content, "name")
        return {name if isinstance(name, str) and name else path.stem: content}
    listed = content.get("cameras")
    inside = dict(enumerate(listed)) if isinstance(listed, list) else listed
    tables: dict[str, Mapping[str, Any]] = {}
    for key, table in (inside if isinstance(inside, dict) else content).items():
        if isinstance(table, dict) and _named(table, "matrix") is not None:
            name = str(_named(table, "name") or key)
            if name in tables:
                raise FileFormatError(path, f"a second camera is called {name!r}; rename one")
            tables[name] = table
    numbered = {f"camera_{i}": _numbered(content, i) for i in range(10)}
    tables |= {n: t for n, t in numbered.items() if _named(t, "matrix") is not None}
    if not tables:
        known = ", ".join(_NAMES["matrix"])
        raise FileFormatError(path, f"no camera in it: no entry is called one of {known}")
    return tables


def _numbered(content: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Return one camera's entries of several in one table, e.g. M1, D1, R1, T1, without the number. In a stereo pair R
    and T lead from the first camera to the second; R1 and R2 beside them rectify images and are no poses.
    """
    shared = {key: value for key, value in content.items() if not key[-1:].isdigit()}
    own = {k[:-1].rstrip("_"): v for k, v in content.items() if k.endswith(str(number)) and k[:-1]}
    pose = {key for field in ("rotation", "translation", "pose") for key in _NAMES[field]}
    if pose & set(shared):
        own = {key: value for key, value in own.items() if key not in pose}
        if number != 2:
            shared = {key: value for key, value in shared.items() if key not in pose}
    return {**shared, **own}


def _named(table: Mapping[str, Any], field: str) -> Any:
    """Return a field's value under the first of its names that the table has; None where absent."""
    return next((table[key] for key in _NAMES[field] if table.get(key) is not None), None)


@dataclass(frozen=True)
class _Entries:
    """The entries of one camera."""

    path: Path
    name: str
    table: Mapping[str, Any]

    def error(self, entry: str, problem: str) -> FileFormatError:
        return FileFormatError(self.path, f"{self.name}, {entry}: {problem}")

    def array(self, field: str, *sizes: int) -> Array:
        """Return finite numbers, flat; as many as one of the sizes."""
        value, entry = _named(self.table, field), _NAMES[field][0]
        if value is None:
            raise self.error(entry, "missing; it may be called " + ", ".join(_NAMES[field]))
        if isinstance(value, dict) and "data" in value:
            value = value["data"]
        try:
            array = np.array(value, dtype=np.float64).ravel()
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error(entry, f"not a matrix of numbers ({error})") from error
        if len(array) not in sizes or not np.all(np.abs(array) <= LARGEST_NUMBER):
            wanted = " or ".join(map(str, sizes))
            raise self.error(entry, f"expected {wanted} finite numbers, found {array.size}")
        return array

    def pose(self) -> tuple[Array | None, Array]:
        """Return R_camera_file and t in the file's unit; None and zeros where absent."""
        if _named(self.table, "pose") is not None:
            pose = self.array("pose", 12, 16)[:12].reshape(3, 4)
            return pose[:, :3], pose[:, 3]
        if _named(self.table, "rotation") is None and _named(self.table, "translation") is None:
            return None, np.zeros(3)
        rotation = self.array("rotation", 3, 9)
        R = so3.exp(rotation) if len(rotation) == 3 else rotation.reshape(3, 3)
        return R, self.array("translation", 3)

    def size(self) -> tuple[int, int]:
        """Return width and height, px."""
        if _named(self.table, "size") is not None:
            width, height = self.array("size", 2)
        else:
            (width,), (height,) = self.array("width", 1), self.array("height", 1)
        return round(width), round(height)

    def distortion(self) -> Array:
        """Return OpenCV's first five coefficients, (5,); zeros where absent."""
        model = self.table.get("distortion_model")
        if model not in (None, "plumb_bob", "rational_polynomial"):
            raise self.error("distortion_model", f"{str(model)[:40]!r}; undistort the images first")
        if _named(self.table, "distortion") is None:
            return np.zeros(5)
        given = self.array("distortion", 0, 1, 2, 4, 5, 8, 12, 14)
        if np.any(given[5:]):
            raise self.error(
                _NAMES["distortion"][0],
                f"{len(given)} coefficients, of which only the first five are "
                "modelled; calibrate with five, or undistort the images first",
            )
        return given[:5]


READERS: Final[dict[str, Callable[..., dict[str, Camera]]]] = {
    ".toml": read_camera_toml,
    ".yml": read_opencv_yaml,
    ".yaml": read_opencv_yaml,
    ".json": read_opencv_yaml,
}
"""Reader of all cameras of a file, by the file's suffix; `up` and `metres_per_unit` have own defaults."""


def read_camera(
    path: str | Path, name: str | None = None, *, up: str | None = None, metres_per_unit: float | None = None
) -> Camera:
    """Read one camera, in a world with z up, from a TOML, or OpenCV's YAML or JSON.

    Args:
        name: the camera's name; needed where the file holds several.
        up: the file's axis that points up, see `world_axes.UP`; by default z.
        metres_per_unit: length of the file's unit, m; by default 1.

    Raises:
        FileFormatError: unknown suffix, unreadable, or several cameras and no `name`. UnknownNameError: no camera of
        that name. UnitError: it is too far away for metres. InvalidInputError: invalid `up` or `metres_per_unit`.
    """
    path = Path(path)
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(path, f"not a camera calibration; known suffixes: {', '.join(READERS)}")
    told = {"up": up, "metres_per_unit": metres_per_unit}
    cameras = read(path, **{key: value for key, value in told.items() if value is not None})
    if name is None and len(cameras) > 1:
        raise FileFormatError(path, f"holds {len(cameras)} cameras; name one of {', '.join(cameras)}")
    if name is not None and name not in cameras:
        raise UnknownNameError(f"camera in {path}", [name], list(cameras))
    return cameras[name or next(iter(cameras))]
