"""Up axis of a file's world and its unit of length, which files of cameras and markers do not state."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError

UP: Final[dict[str, Array]] = {
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "y": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "z": np.eye(3),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
}
"""The file's axis that points up -> R_world_file. z, -z and -y keep the x axis; y takes (x, y, z) to
(z, x, y), as Pose2Sim does between its cameras (z up) and its markers (y up)."""
R_WORLD_GROUND: Final = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""OpenSim's ground (y up) to world, in every file that goes with an .osim: a person who faces world x
faces ground x and has ground z on the right. With `UP`'s y that person faces z."""
METRES: Final = {"m": 1.0, "mm": 0.001, "cm": 0.01}  #: Length of the units of marker files, m


def world_of_file(up: str, metres_per_unit: float = 1.0) -> Array:
    """Return R_world_file (3, 3) of a file whose axis `up`, a key of `UP`, points up, and whose unit is positive, m;
    else `InvalidInputError`.
    """
    if up not in UP:
        raise InvalidInputError(f"up: {up!r} is no axis; give one of {', '.join(UP)}")
    if not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise InvalidInputError(f"metres_per_unit: {metres_per_unit} is not a positive length")
    return UP[up]
