"""Motion of a camera as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import OutputExistsError
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.formats.camera_motion import read_camera_motion, write_camera_motion

TIMES = np.arange(5) / 30
R = so3.exp(np.linspace(0, 0.3, 15).reshape(5, 3))
FULL = CameraMotion(TIMES, R, 0.002, so3.unit(np.array([0.1, -1.0, 0.2])), 1e-3, 1234.5)


@pytest.mark.parametrize("motion", [FULL, CameraMotion(TIMES, R)])
def test_round_trip_is_exact(motion: CameraMotion, tmp_path: Path) -> None:
    path = tmp_path / "camera_motion.npz"
    write_camera_motion(path, motion)
    found = read_camera_motion(path)
    for name in ("times", "R_first_camera", "sigma", "up_first", "drift", "focal_px"):
        np.testing.assert_array_equal(getattr(found, name), getattr(motion, name))
    with pytest.raises(OutputExistsError):
        write_camera_motion(path, motion)
