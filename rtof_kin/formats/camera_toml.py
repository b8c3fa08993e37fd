"""Camera calibrations in TOML, one table a camera: Pose2Sim's, and others' that are laid out alike.

    [cam_01]
    name = "cam_01"                        # the table's name where absent
    size = [1088.0, 1920.0]                # width, height, px
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2]         # of OpenCV, and k3 where there is a fifth
    rotation = [rx, ry, rz]                # world to camera: OpenCV's rotation vector, rad, or a matrix
    translation = [tx, ty, tz]             # p_camera = R p_world + t
    assumed = ["pose"]                     # where nobody measured it; this package's own

Caliscope's and Anipose's files have the same fields among others, which are passed over. A file does not
say which way is up nor in which unit lengths are: the caller does, and what cannot be is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError, UnitError
from rtof_kin.core.files.section import Section
from rtof_kin.core.files.text import write_text
from rtof_kin.data.camera import Camera
from rtof_kin.formats.world_axes import world_of_file

Array = NDArray[np.float64]
FURTHEST = 100.0
"""A camera further than this from the origin, m, is in another unit."""
_NOT_CAMERAS = ("metadata",)


def read_camera_toml(path: str | Path, *, up: str = "z", metres_per_unit: float = 1.0) -> dict[str, Camera]:
    """The cameras of a file by name, in its order, in a world with z up.

    Args:
        path: the file.
        up: the axis of the file's world that points up: x, y or z, with a minus in front where it points
            down, see `rtof_kin.formats.world_axes.UP`.
        metres_per_unit: length of the file's unit, m; 0.001 where it has mm.

    Raises:
        FileFormatError: no such file, no camera in it, or a camera that is not complete; the message
            names the field. UnitError: a camera is too far away for metres.
        ShapeError: `up` or `metres_per_unit` are none.
    """
    R_world_file = world_of_file(up)
    if not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise ShapeError(f"metres_per_unit: {metres_per_unit} is not a positive length")
    file = Section.of_file(Path(path))
    cameras: dict[str, Camera] = {}
    for key in file.keys():  # noqa: SIM118
        if key in _NOT_CAMERAS or not _is_camera(file, key):
            continue
        section = file.table(key)
        name = section.text("name", key)
        if name in cameras:
            raise section.error("name", f"{name!r} is another camera's already; give each its own")
        cameras[name] = _camera(section, R_world_file, metres_per_unit)
    if not cameras:
        raise FileFormatError(
            path, "no camera in it: no table has both size and matrix; give a file of camera calibrations"
        )
    return cameras


def _is_camera(file: Section, key: str) -> bool:
    try:
        section = file.table(key)
    except FileFormatError:  # a field, not a table
        return False
    return section.has("matrix") or section.has("size")


def _camera(section: Section, R_world_file: Array, metres_per_unit: float) -> Camera:
    if section.has("fisheye") and section.array("fisheye", ()) != 0:
        raise section.error(
            "fisheye", "a fisheye lens, which a pinhole camera cannot stand for; undistort the images "
            "first"
        )  # fmt: skip
    width, height = section.array("size", (2,))
    where = f"{section.path}: {section.where('translation')}"
    t = checked_distance(where, _vector(section, "translation"), metres_per_unit)
    R_camera_world = _rotation(section) @ R_world_file.T
    try:
        return Camera(
            section.array("matrix", (3, 3)), R_camera_world, t, round(width), round(height),
            _distortion(section), section.optional_names("assumed") or (),
        )  # fmt: skip
    except InvalidInputError as error:
        raise FileFormatError(section.path, f"[{section.name}]: {error}") from error


def checked_distance(where: str, t: Array, metres_per_unit: float) -> Array:
    """A camera's translation (3,) in m; `UnitError` where it is too far for that."""
    t = t * metres_per_unit
    far = float(np.linalg.norm(t))
    if far > FURTHEST:
        raise UnitError(
            f"{where}: the camera is {far:.0f} m away from the origin; give metres_per_unit, "
            f"{0.001 * metres_per_unit:g} if the file has mm"
        )
    return t


def _vector(section: Section, field: str) -> Array:
    """Three numbers, in a row or in a column."""
    try:
        return section.array(field, (3,))
    except FileFormatError as error:
        try:
            return section.array(field, (3, 1))[:, 0]
        except FileFormatError:
            raise error from None


def _rotation(section: Section) -> Array:
    try:
        return section.array("rotation", (3, 3))
    except FileFormatError:
        return so3.exp(_vector(section, "rotation"))


def _distortion(section: Section) -> Array:
    """OpenCV's first five coefficients, (5,)."""
    for count in (5, 4):
        try:
            given = section.array("distortions", (count,))
        except FileFormatError:
            continue
        return np.concatenate([given, np.zeros(5 - count)])
    raise section.error(
        "distortions", "expected k1, k2, p1, p2 and perhaps k3; undistort with the tool that made the "
        "file if its lens needs more"
    )  # fmt: skip


def write_camera_toml(path: str | Path, cameras: Mapping[str, Camera], overwrite: bool = False) -> None:
    """Write what `read_camera_toml` reads back to rounding, and Pose2Sim too: z up, metres.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for.
        RtofError: it cannot be written.
    """
    tables: dict[str, dict[str, Any]] = {
        name: {
            "name": name,
            "size": [float(camera.width_px), float(camera.height_px)],
            "matrix": camera.K.tolist(),
            "distortions": camera.distortion[: 5 if camera.distortion[4] else 4].tolist(),
            "rotation": so3.log(camera.R_camera_world).tolist(),
            "translation": camera.t_camera_world.tolist(),
            "fisheye": False,
            **({"assumed": list(camera.assumed)} if camera.assumed else {}),
        }
        for name, camera in cameras.items()
    }
    write_text(Path(path), tomli_w.dumps(tables), overwrite)
