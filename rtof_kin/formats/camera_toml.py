"""Camera calibrations in TOML, one table per camera, as Pose2Sim, Caliscope and Anipose write them.

FreeMoCap has Anipose's; newer versions of Caliscope put the tables under ``[cameras]``.

    [cam_01]
    name = "cam_01"                        # the table's name where absent
    size = [1088.0, 1920.0]                # width, height, px
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2]         # OpenCV's, and k3 where there is a fifth
    rotation = [rx, ry, rz]                # world to camera: OpenCV's rotation vector, rad, or a matrix
    translation = [tx, ty, tz]             # p_camera = R p_world + t
    assumed = ["pose"]                     # not measured; this package's own field

Other fields are ignored. The file states neither its up axis nor its unit of length: the caller does.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tomli_w
from pydantic import ConfigDict

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnitError, reading
from rtof_kin.core.files.input_table import ArrayOf, InputTable, Matrix3, Names, Vector2
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.data.camera import Camera
from rtof_kin.formats.world_axes import world_of_file

FURTHEST: Final = 100.0  #: A camera further than this from the origin, m, is in another unit


_LENS: Final = (
    "; these are k1, k2, p1, p2 and perhaps k3: undistort with the tool that made the file if its lens needs more"
)


class CameraOfTool(InputTable):
    """A camera as the tools write it; further fields are ignored."""

    model_config = ConfigDict(extra="ignore")
    name: str | None = None
    size: Vector2
    """Width and height, px."""
    matrix: Matrix3
    distortions: Annotated[Array, ArrayOf(4, also=((5,),), remedy=_LENS)]
    """OpenCV's, 4 or 5."""
    rotation: Annotated[Array, ArrayOf(3, also=((3, 3), (3, 1)))]
    translation: Annotated[Array, ArrayOf(3, also=((3, 1),))]
    assumed: Names = ()
    fisheye: bool | int = False


def read_camera_toml(path: str | Path, *, up: str = "z", metres_per_unit: float = 1.0) -> dict[str, Camera]:
    """Read the cameras of a file by name, in its order, into a world with z up. `FileFormatError`: no such file, no
    camera in it, or an incomplete camera; names the field. `UnitError`: a camera is too far away for metres.
    `InvalidInputError`: invalid `up` or `metres_per_unit`.

    Args:
        up: the file's axis that points up, see `rtof_kin.formats.world_axes.UP`.
        metres_per_unit: length of the file's unit, m; 0.001 for mm.
    """
    data, inside = load_toml(path), ""
    if isinstance(data.get("cameras"), dict) and not _is_camera(data["cameras"]):
        data, inside = data["cameras"], "cameras."
    cameras: dict[str, Camera] = {}
    for key, fields in data.items():
        if key == "metadata" or not _is_camera(fields):
            continue
        table = CameraOfTool.of(fields, Path(path), inside + key)
        name = key if table.name is None else table.name
        if name in cameras:
            raise table.error("name", f"{name!r} is another camera's already; give each its own")
        cameras[name] = _camera(table, up, metres_per_unit)
    if not cameras:
        raise FileFormatError(
            path, "no camera in it: no table has both size and matrix; give a file of camera calibrations"
        )
    return cameras


def _is_camera(fields: Any) -> bool:
    return isinstance(fields, dict) and ("matrix" in fields or "size" in fields)


def _camera(table: CameraOfTool, up: str, metres_per_unit: float) -> Camera:
    if table.fisheye:
        raise table.error("fisheye", "a fisheye lens is no pinhole camera; undistort the images first")
    rotation, where = table.rotation.ravel(), table.where("").strip()
    R = so3.exp(rotation) if len(rotation) == 3 else rotation.reshape(3, 3)
    pose, (width, height) = (R, table.translation.ravel()), table.size
    return camera_in_world(
        table.path, where, up, metres_per_unit, table.matrix, pose, (width, height), table.distortions, table.assumed
    )


def camera_in_world(
    path: str | Path,
    where: str,
    up: str,
    metres_per_unit: float,
    K: Array,
    pose: tuple[Array, Array],
    size_px: tuple[float, float],
    distortion: Array,
    assumed: tuple[str, ...] = (),
) -> Camera:
    """Return a camera of a file in a world with z up, m. `FileFormatError`: no camera has these numbers;
    `UnitError`: it is more than `FURTHEST` from the origin; `InvalidInputError`: invalid `up` or `metres_per_unit`.

    Args:
        path, where: file and place in it, for errors. up, metres_per_unit: see `world_of_file`.
        pose: R_camera_file (3, 3) and t (3,) in the file's unit. distortion: OpenCV's first coefficients, at most 5.
    """
    R_world_file, t = world_of_file(up, metres_per_unit), pose[1] * metres_per_unit
    far = float(np.linalg.norm(t))
    if far > FURTHEST:
        raise UnitError(
            f"{path}: {where}: the camera is {far:.0f} m away from the origin; give metres_per_unit, "
            f"{0.001 * metres_per_unit:g} if the file has mm"
        )
    width, height = map(round, size_px)
    distortion = np.pad(distortion, (0, 5 - len(distortion)))
    with reading(path, f"{where}: {{}}"):
        return Camera(K, pose[0] @ R_world_file.T, t, width, height, distortion, assumed)


def write_camera_toml(path: str | Path, cameras: Mapping[str, Camera], overwrite: bool = False) -> None:
    """Write cameras, z up and in metres, which `read_camera_toml` reads back to rounding; Pose2Sim too.
    `OutputExistsError`: the file exists and `overwrite` is False; `RtofError`: it cannot be written.
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
