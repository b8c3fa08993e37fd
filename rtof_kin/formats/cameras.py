"""One camera from a calibration file of any supported format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.opencap import read_opencap
from rtof_kin.formats.opencv_yaml import read_opencv_yaml

READERS: Final[dict[str, Callable[..., dict[str, Camera]]]] = {
    ".toml": read_camera_toml,
    ".yml": read_opencv_yaml,
    ".yaml": read_opencv_yaml,
    ".json": read_opencv_yaml,
    ".pickle": read_opencap,
    ".pkl": read_opencap,
}
"""Reader of all cameras of a file, by the file's suffix; `up` and `metres_per_unit` have own defaults."""


def read_camera(
    path: str | Path, name: str | None = None, *, up: str | None = None, metres_per_unit: float | None = None
) -> Camera:
    """Read one camera, in a world with z up, from a TOML, OpenCV's YAML or JSON, or OpenCap's pickle.

    Args:
        name: the camera's name; needed where the file holds several.
        up: the file's axis that points up, see `world_axes.UP`; by default z, and what `rtof_kin.formats.opencap`
            finds.
        metres_per_unit: length of the file's unit, m; by default 1, and 0.001 for OpenCap.

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
