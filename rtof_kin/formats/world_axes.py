"""Which axis of a file's world points up, and its unit of length: what cameras and markers declare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import ShapeError

Array = NDArray[np.float64]
UP = {
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "y": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "z": np.eye(3),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
}
"""The file's axis that points up -> R_world_file. z, -z and -y keep the x axis where it is; y takes
(x, y, z) to (z, x, y), as Pose2Sim does between its cameras (z up) and its markers (y up)."""
R_WORLD_GROUND = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""OpenSim's ground (y up) to world, in every file that goes with an .osim: who faces world x faces ground
x, as OpenSim's own models do, and has z on the right. `UP`'s y is another: there they face z."""
METRES = {"m": 1.0, "mm": 0.001, "cm": 0.01}
"""Length of the units that files of markers are written in, m."""


def world_of_file(up: str) -> Array:
    """R_world_file (3, 3) of a file whose axis `up` points up.

    Raises:
        ShapeError: there is no such axis.
    """
    if up not in UP:
        raise ShapeError(f"up: {up!r} is no axis; give one of {', '.join(UP)}")
    return UP[up]
