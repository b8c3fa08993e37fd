"""Motion of a handheld camera as an .npz file, and the arrays that relate keypoints to their video.

A file of the motion has

==================  ============  ==============================================================
times               (T,)          s, on the clock of the keypoints
R_first_camera      (T, 3, 3)     camera axes (x right, y down, z forward) to a fixed orientation
sigma_rad           ()            standard deviation per axis of each rotation; optional
drift_rad_s         ()            standard deviation of a steady drift of the heading; optional
up_first            (3,)          up in the axes of the fixed orientation; optional
focal_px            ()            focal length that images were turned with; optional
==================  ============  ==============================================================

Beside ``uv_px`` in an .npz file of keypoints stand

====================  ============  ==============================================================
video_times           (T,)          s since the first frame of the video, if not `times`
R_still_camera        (T, 3, 3)     `CameraTurning.R_still_camera`, where the camera was handheld
K_still               (3, 3)        px, `CameraTurning.K_still`
video_K               (3, 3)        px, of the camera that turned
video_distortion      (5,)          of the camera that turned
====================  ============  ==============================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, reading
from rtof_kin.core.files.arrays import read_npz, write_npz
from rtof_kin.data.camera import CameraTurning
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.keypoints import KeypointSequence

_SHAPES = {
    "times": "(T,)",
    "R_first_camera": "(T, 3, 3)",
    "sigma_rad": "()",
    "drift_rad_s": "()",
    "up_first": "(3,)",
    "focal_px": "()",
}


def read_camera_motion(path: Path) -> CameraMotion:
    """Read the motion of a camera; `FileFormatError`: damaged, or an array is missing, unknown or of another shape."""
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
    with reading(path):
        return CameraMotion(**fields, up_first=arrays.get("up_first"))


def write_camera_motion(path: Path, motion: CameraMotion, overwrite: bool = False) -> None:
    """Write a motion, which `read_camera_motion` restores exactly; errors as `core.files.folder.new_file`."""
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


_TURNING: Final = ("R_still_camera", "K_still", "video_K", "video_distortion")
VIDEO_AXES: Final = {"video_times": 1, "R_still_camera": 3}  #: Number of axes of arrays with a row for each frame
VIDEO_CONSTANTS: Final = ("K_still", "video_K", "video_distortion")  #: Arrays of the whole video
VIDEO_ARRAYS: Final = (*VIDEO_AXES, *VIDEO_CONSTANTS)


def video_arrays(keypoints: KeypointSequence) -> dict[str, Array]:
    """Return the arrays of the module's table that keypoints need."""
    out = {} if keypoints.own_times is None else {"video_times": keypoints.own_times}
    if (turning := keypoints.turning) is not None:
        values = (turning.R_still_camera, turning.K_still, turning.camera.K, turning.camera.distortion)
        out |= dict(zip(_TURNING, values, strict=True))
    return out


def with_video(keypoints: KeypointSequence, arrays: Mapping[str, Array]) -> KeypointSequence:
    """Return keypoints with what `video_arrays` wrote of them, else `InvalidInputError`; other arrays are ignored."""
    if "video_times" in arrays:
        keypoints = replace(keypoints, own_times=arrays["video_times"])
    given = [name for name in _TURNING if name in arrays]
    if not given:
        return keypoints
    if missing := [name for name in _TURNING if name not in arrays]:
        raise InvalidInputError(f"array {missing[0]!r} is missing beside {given[0]!r}")
    R, K_still, K, distortion = (arrays[name] for name in _TURNING)
    camera = replace(keypoints.camera, K=K, distortion=distortion, stabilised=False)
    return replace(keypoints, turning=CameraTurning(camera, K_still, R))
