"""One camera from a calibration file of any supported format."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.opencv_yaml import read_opencv_yaml

READERS = {
    ".toml": read_camera_toml, ".yml": read_opencv_yaml, ".yaml": read_opencv_yaml,
    ".json": read_opencv_yaml,
}  # fmt: skip
"""Reader of all cameras of a file, by the file's suffix."""


def read_camera(
    path: str | Path, name: str | None = None, *, up: str = "z", metres_per_unit: float = 1.0
) -> Camera:
    """Read one camera, in a world with z up, from Pose2Sim's TOML or OpenCV's YAML or JSON.

    Args:
        path: the file. name: the camera's name; needed where the file holds several.
        up: the file's axis that points up, see `world_axes.UP`.
        metres_per_unit: length of the file's unit, m.

    Raises:
        FileFormatError: unknown suffix, unreadable, or several cameras and no `name`.
        UnknownNameError: no camera of that name. UnitError: it is too far away for metres.
        InvalidInputError: invalid `up` or `metres_per_unit`.
    """
    path = Path(path)
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(path, f"not a camera calibration; known suffixes: {', '.join(READERS)}")
    cameras = read(path, up=up, metres_per_unit=metres_per_unit)
    if name is None and len(cameras) > 1:
        raise FileFormatError(path, f"holds {len(cameras)} cameras; name one of {', '.join(cameras)}")
    if name is not None and name not in cameras:
        raise UnknownNameError(f"camera in {path}", [name], list(cameras))
    return cameras[name or next(iter(cameras))]
