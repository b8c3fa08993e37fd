"""Motion of a handheld camera as an .npz file.

==================  ============  ==============================================================
times               (T,)          s, on the clock of the keypoints
R_first_camera      (T, 3, 3)     camera axes (x right, y down, z forward) to a fixed orientation
sigma_rad           ()            standard deviation per axis of each rotation; optional
drift_rad_s         ()            standard deviation of a steady drift of the heading; optional
up_first            (3,)          up in the axes of the fixed orientation; optional
focal_px            ()            focal length that images were turned with; optional
==================  ============  ==============================================================
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import read_npz, write_npz
from rtof_kin.data.camera_motion import CameraMotion

_SHAPES = {
    "times": "(T,)",
    "R_first_camera": "(T, 3, 3)",
    "sigma_rad": "()",
    "drift_rad_s": "()",
    "up_first": "(3,)",
    "focal_px": "()",
}


def read_camera_motion(path: Path) -> CameraMotion:
    """Read the motion of a camera.

    Raises:
        FileFormatError: damaged, or an array is missing, unknown or of another shape.
    """
    arrays = read_npz(path)
    wrong = [name for name in arrays if name not in _SHAPES] or [n for n in list(_SHAPES)[:2] if n not in arrays]
    if wrong:
        form = ", ".join(f"{name} {shape}" for name, shape in _SHAPES.items())
        problem = "unknown" if wrong[0] in arrays else "missing"
        raise FileFormatError(path, f"array {wrong[0]!r} is {problem}; the motion of a camera has {form}")
    fields: dict[str, Any] = {name: arrays[name] for name in ("times", "R_first_camera")}
    for name, field in (("sigma_rad", "sigma"), ("drift_rad_s", "drift"), ("focal_px", "focal_px")):
        if name in arrays:
            if arrays[name].size != 1:
                raise FileFormatError(path, f"{name}: expected one number, got shape {arrays[name].shape}")
            fields[field] = arrays[name].item()
    try:
        return CameraMotion(**fields, up_first=arrays.get("up_first"))
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def write_camera_motion(path: Path, motion: CameraMotion, overwrite: bool = False) -> None:
    """Write a motion; `read_camera_motion` restores it exactly.

    Args:
        overwrite: whether to replace an existing file.

    Raises:
        OutputExistsError: the file exists and may not be replaced. RtofError: it cannot be written.
    """
    arrays = {
        "times": motion.times,
        "R_first_camera": motion.R_first_camera,
        "sigma_rad": motion.sigma,
        "drift_rad_s": motion.drift,
        "up_first": motion.up_first,
        "focal_px": motion.focal_px,
    }
    known = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    write_npz(path, known, overwrite)
