"""Cameras of OpenCap: ``cameraIntrinsicsExtrinsics.pickle``, one file a camera, by the name of its folder.

A pickled dictionary of arrays; nothing in it is executed (`rtof_kin.core.files.pickles`):

=====================  =====================================================================
intrinsicMat           (3, 3) px
distortion             (1, 5) OpenCV's k1, k2, p1, p2, k3
imageSize              (2, 1) height, width, px
rotation, translation  (3, 3) and (3, 1) mm: p_camera = R p_board + t, in axes of the checkerboard
=====================  =====================================================================

The origin is a corner of the checkerboard, and which of its axes points up depends on how it was put up.
OpenCap's board stands upright in an upright image: unless the caller says otherwise, up is the axis of the
board that is nearest to the image's upward direction. The height of the floor is not in the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.pickles import read_pickle
from rtof_kin.core.files.text import measurable
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import checked_distance
from rtof_kin.formats.world_axes import UP, world_of_file

MILLIMETRE: Final = 0.001
USUAL_NAME: Final = "cameraIntrinsicsExtrinsics"
LARGEST_BYTES: Final = 2**20
"""Largest file that is read, bytes; OpenCap's have about one thousand."""
_LARGEST_TILT: Final = np.radians(35.0)
"""Largest angle between the image's upward direction and the axis of the board that is taken as up."""
_SIZES: Final = {"intrinsicMat": 9, "distortion": 5, "imageSize": 2, "rotation": 9, "translation": 3}


def read_opencap(path: str | Path, *, up: str | None = None, metres_per_unit: float = MILLIMETRE) -> dict[str, Camera]:
    """Read the camera of a file, by the folder's name, into a world with z up.

    Args:
        metres_per_unit: length of the file's unit, m.
        up: axis of the checkerboard that points up, see `rtof_kin.formats.world_axes.UP`; by default the nearest to
            the image's upward direction.

    Raises:
        FileFormatError: unreadable, no such pickle, or no axis of the board is near upright.
        UnitError: the camera is too far away. InvalidInputError: invalid `up` or `metres_per_unit`.
    """
    path = Path(path)
    content = read_pickle(path, LARGEST_BYTES)
    lacking = [name for name in _SIZES if not isinstance(content, dict) or name not in content]
    if lacking:
        raise FileFormatError(path, f"no camera of OpenCap: it has no {', '.join(lacking)}")
    K, distortion, size, R, t = (_numbers(path, content, name) for name in _SIZES)
    R = R.reshape(3, 3)
    R_world_file = world_of_file(up or _upward(path, R), metres_per_unit)
    t = checked_distance(f"{path}: translation", t, metres_per_unit)
    height, width = (round(float(n)) for n in size)
    try:
        camera = Camera(K.reshape(3, 3), R @ R_world_file.T, t, width, height, distortion)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
    named = path.stem if path.stem != USUAL_NAME else path.absolute().parent.name
    return {named: camera}


def _numbers(path: Path, content: dict[str, Any], name: str) -> Array:
    """Return the numbers of an entry, flat."""
    value = content[name]
    fits = isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.size == _SIZES[name]
    if not fits or not np.isfinite(value).all() or not measurable(value):
        raise FileFormatError(path, f"{name}: expected {_SIZES[name]} finite numbers")
    return np.asarray(value, dtype=np.float64).ravel()


def _upward(path: Path, R_camera_file: Array) -> str:
    """Return the axis of the board that is nearest to the image's upward direction, -y of the camera."""
    along = {name: float(-R_camera_file[1] @ R_world[2]) for name, R_world in UP.items()}
    best = max(along, key=along.__getitem__)
    if along[best] < np.cos(_LARGEST_TILT):
        angle = np.degrees(np.arccos(np.clip(along[best], -1, 1)))
        raise FileFormatError(
            path,
            f"no axis of the checkerboard is upright in the image; the nearest, {best}, is "
            f"{angle:.0f} degrees away; tell which one points up, e.g. up = '-y' for a board that hangs on "
            "a wall, '-z' or 'z' for one on the floor",
        )
    return best
