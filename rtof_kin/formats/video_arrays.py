"""Arrays that relate keypoints to their video, beside ``uv_px`` in an .npz file.

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
from typing import Final

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import CameraTurning
from rtof_kin.data.keypoints import KeypointSequence

_TURNING: Final = ("R_still_camera", "K_still", "video_K", "video_distortion")
VIDEO_AXES: Final = {"video_times": 1, "R_still_camera": 3}
"""Number of axes of arrays with a row for each frame."""
VIDEO_CONSTANTS: Final = ("K_still", "video_K", "video_distortion")
"""Arrays of the whole video."""
VIDEO_ARRAYS: Final = (*VIDEO_AXES, *VIDEO_CONSTANTS)


def video_arrays(keypoints: KeypointSequence) -> dict[str, Array]:
    """Return the arrays of the module's table that keypoints need."""
    out = {} if keypoints.own_times is None else {"video_times": keypoints.own_times}
    if (turning := keypoints.turning) is not None:
        values = (turning.R_still_camera, turning.K_still, turning.camera.K, turning.camera.distortion)
        out |= dict(zip(_TURNING, values, strict=True))
    return out


def with_video(keypoints: KeypointSequence, arrays: Mapping[str, Array]) -> KeypointSequence:
    """Return keypoints with what `video_arrays` wrote of them.

    Args:
        arrays: of their file; others than those of the table are ignored.

    Raises:
        InvalidInputError: an array is missing or has a wrong shape.
    """
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
