"""``measurements.npz``: what a motion was computed from, beside ``motion.npz``; see `data.measurements`.

A header in JSON, the array ``header``, has the names, the cameras and the faults; the arrays are

==========================  ================  ====================================================
times                       (T,)              s
view_I_uv_px, _confidence   (T, L, 2), (T, L) of each camera; its other arrays as in `video_arrays`
quat_wxyz_world_sensor      (T, S, 4)         measured orientations; NaN where missing
quat_wxyz_bone_sensor       (S, 4)            mounting
p_bone_sensor               (S, 3)            m
truth_p_world_joint         (T, J, 3)         m
truth_quat_wxyz             (T, J, 4)         orientations of the segments in world
truth_valid                 (T, J)            bool
==========================  ================  ====================================================
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import read_npz_as_saved, write_npz
from rtof_kin.core.files.text import LARGEST_NUMBER, measurable
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.measurements import Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.data.stream_faults import FaultKind, StreamFault
from rtof_kin.formats.video_arrays import VIDEO_ARRAYS, video_arrays, with_video

MEASUREMENTS: Final = "measurements.npz"
SCHEMA_VERSION: Final = 1
_CAMERA: Final = ("K", "R_camera_world", "t_camera_world", "distortion")


def write_measurements_npz(path: str | Path, measurements: Measurements) -> None:
    """Write measurements over an existing file; coordinates of points and orientations as 32-bit floats.

    Args:
        path: the file. measurements: to write.

    Raises:
        RtofError: it cannot be written.
    """
    m, arrays = measurements, dict[str, NDArray[Any]](times=measurements.times)
    header: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "sensors": m.sensors,
        "segments": m.segments,
        "floor_height": m.floor_height,
        "faults": [[fault.kind.name, fault.what, fault.start, fault.stop] for fault in m.faults],
        "views": [{"names": view.names, "camera": _camera_header(view.camera)} for view in m.views],
        "joints": () if m.truth is None else m.truth.names,
    }
    for i, view in enumerate(m.views):
        own = {"uv_px": _short(view.uv_px), "confidence": _short(view.confidence)} | video_arrays(view)
        arrays |= {f"view_{i}_{name}": array for name, array in own.items()}
    arrays |= {
        "quat_wxyz_world_sensor": _short(so3.known_to_quat_wxyz(m.R_world_sensor)),
        "quat_wxyz_bone_sensor": _short(so3.known_to_quat_wxyz(m.R_bone_sensor)),
        "p_bone_sensor": m.p_bone_sensor,
    }
    if m.truth is not None:
        arrays["truth_p_world_joint"] = _short(m.truth.p_world_joint)
        arrays["truth_quat_wxyz"] = _short(so3.known_to_quat_wxyz(m.truth.R_world_bone))
        arrays["truth_valid"] = m.truth.valid
    write_npz(Path(path), arrays | {"header": np.array(json.dumps(header))}, overwrite=True)


def read_measurements_npz(path: str | Path) -> Measurements:
    """Read measurements; nothing in the file is executed.

    Args:
        path: the file.

    Raises:
        FileFormatError: missing, damaged, of a newer schema, or an array is missing or has a wrong shape.
    """
    path = Path(path)
    saved = read_npz_as_saved(path, kinds="fiubU")
    for name, array in saved.items():
        if array.dtype.kind == "f" and not measurable(array):
            raise FileFormatError(path, f"{name}: holds a number beyond {LARGEST_NUMBER:g}")
    try:
        header = json.loads(str(saved["header"]))
        if header["schema_version"] > SCHEMA_VERSION:
            raise FileFormatError(path, "its schema version is newer; update rtof_kin")
        arrays = {n: a.astype(float) for n, a in saved.items() if a.dtype.kind in "fiub"}
        return measurements_of(header, arrays)
    except KeyError as error:
        raise FileFormatError(path, f"{error} is missing") from error
    except (RtofError, ValueError, TypeError, AttributeError, IndexError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, str(error)) from error


def measurements_of(header: dict[str, Any], arrays: Mapping[str, Array]) -> Measurements:
    """Return measurements of the contents of a file, or of some of its frames.

    Args:
        header: of the file. arrays: float64, by name.

    Raises:
        KeyError, TypeError, ValueError, RtofError: something is missing or invalid.
    """
    times = arrays["times"]
    floor = header["floor_height"]
    return Measurements(
        times=times,
        views=tuple(_view(i, own, times, arrays) for i, own in enumerate(header["views"])),
        sensors=tuple(header["sensors"]),
        segments=tuple(header["segments"]),
        R_world_sensor=so3.known_from_quat_wxyz(arrays["quat_wxyz_world_sensor"]),
        R_bone_sensor=so3.known_from_quat_wxyz(arrays["quat_wxyz_bone_sensor"]),
        p_bone_sensor=arrays["p_bone_sensor"],
        truth=_truth(header["joints"], times, arrays) if header["joints"] else None,
        faults=tuple(
            StreamFault(FaultKind[str(kind)], str(what), float(start), float(stop))
            for kind, what, start, stop in header["faults"]
        ),
        floor_height=None if floor is None else float(floor),
    )


def _view(i: int, header: dict[str, Any], times: Array, arrays: Mapping[str, Array]) -> KeypointSequence:
    own = header["camera"]
    K, R, t, distortion = (np.array(own[name], dtype=float) for name in _CAMERA)
    size = int(own["width_px"]), int(own["height_px"])
    camera = Camera(K, R, t, *size, distortion, tuple(own["assumed"]), stabilised=bool(own["stabilised"]))
    uv, confidence = arrays[f"view_{i}_uv_px"], arrays[f"view_{i}_confidence"]
    keypoints = KeypointSequence(camera, times, uv, np.clip(confidence, 0, 1), tuple(header["names"]))
    video = {name: arrays[f"view_{i}_{name}"] for name in VIDEO_ARRAYS if f"view_{i}_{name}" in arrays}
    return with_video(keypoints, video)


def _truth(names: list[str], times: Array, arrays: Mapping[str, Array]) -> PoseSequence:
    p, R = arrays["truth_p_world_joint"], so3.known_from_quat_wxyz(arrays["truth_quat_wxyz"])
    return PoseSequence(times, p, R, tuple(names), valid=arrays["truth_valid"] > 0)


def _camera_header(camera: Camera) -> dict[str, Any]:
    numbers = {name: getattr(camera, name).tolist() for name in _CAMERA}
    return numbers | {
        "width_px": int(camera.width_px), "height_px": int(camera.height_px), "assumed": camera.assumed,
        "stabilised": camera.stabilised,
    }  # fmt: skip


def _short(values: Array) -> NDArray[np.float32]:
    return values.astype(np.float32)
