"""``measurements.npz``: what a motion was computed from, beside ``motion.npz``; see `data.measurements`.

A header in JSON, the array ``header``, has the names, the cameras and the faults; the arrays of version 2 are

============================  ================  ==========================================================
times                         (T,)              s
view_I_uv_px                  (T, L, 2)         of each camera, px, multiples of 1/64
view_I_confidence             (T, L)            0 to 255
view_I_video_times            (T,)              s, if not `times`
view_I_rotvec_still_camera    (T, 3)            rad, of a handheld camera, which has three more arrays, those
                                                of `video_arrays`
rotvec_world_sensor           (T, S, 3)         measured orientations, rad, multiples of 2^-15; NaN where
                                                missing
quat_wxyz_bone_sensor         (S, 4)            mounting
p_bone_sensor                 (S, 3)            m
truth_p_world_joint           (T, J, 3)         m, multiples of 2^-16
truth_rotvec                  (T, J, 3)         orientations of the segments in world, rad, multiples of 2^-13
truth_valid                   (T, J)            bool
============================  ================  ==========================================================

In version 1 confidences are 0 to 1, orientations are quaternions, ``quat_wxyz_world_sensor`` and
``truth_quat_wxyz``, and the handheld camera has ``R_still_camera`` (T, 3, 3).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import npz_names, read_npz_as_saved
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.frame_reader import FrameReader
from rtof_kin.formats.video_arrays import VIDEO_ARRAYS, with_video

MEASUREMENTS: Final = "measurements.npz"
SCHEMA_VERSION: Final = 2
CAMERA: Final = ("K", "R_camera_world", "t_camera_world", "distortion")
FULL: Final = 255
"""Number in the file of a confidence of 1."""
_CONSTANT: Final = ("quat_wxyz_bone_sensor", "p_bone_sensor", "K_still", "video_K", "video_distortion")
"""Arrays, or ends of their names, that do not have one row per frame."""
_HEADER_BYTES: Final = 16 * 2**20


class MeasurementsReader(FrameReader[Measurements]):
    """Frames of a ``measurements.npz``, however long it is; a context that closes the file.

    Attributes:
        path: the file. times: (T,) s.
    """

    def __init__(self, path: str | Path):
        """Read what does not change over time.

        Raises:
            FileFormatError: missing, damaged, of a newer schema, or an array is missing.
        """
        self.path = Path(path)
        names = [name for name in npz_names(self.path) if name != "header"]
        constant = [name for name in names if name.endswith(_CONSTANT)]
        saved = read_npz_as_saved(self.path, _HEADER_BYTES, kinds="fiubU", names=("header", *constant))
        with ExitStack() as failed:
            try:
                self._header: dict[str, Any] = json.loads(str(saved["header"]))
                if self._header["schema_version"] > SCHEMA_VERSION:
                    raise FileFormatError(self.path, "its schema version is newer; update rtof_kin")
                self._constant: dict[str, Array] = {name: saved[name].astype(float) for name in constant}
                self._rows = NpzBlocks(self.path, [name for name in names if name not in constant])
                failed.callback(self._rows.close)
                self._names = [name for name in names if name in self._rows]
                self.times: Array = checked_times("measurements times", self._rows.whole("times"))
            except FileFormatError:
                raise
            except KeyError as error:
                raise FileFormatError(self.path, f"{error} is missing") from error
            except (RtofError, ValueError, TypeError) as error:
                raise FileFormatError(self.path, f"its header is not readable ({error})") from error
            failed.pop_all()

    def close(self) -> None:
        """Close the file."""
        self._rows.close()

    @property
    def available(self) -> int:
        """Number of frames, from the first, that `scan` has passed."""
        return self._rows.available

    def scan(self, stop: Event | None = None, until: int | None = None) -> None:
        """Pass over the file; see `FrameReader.scan`."""
        self._rows.scan(stop, until)

    def block(self, start: int, stop: int) -> Measurements:
        """Return frames, with the faults of all; see `FrameReader.block`."""
        self._find(start, stop)
        arrays = dict(self._constant)
        try:
            for name in self._names:
                arrays[name] = np.asarray(self._rows.rows(name, start, stop), dtype=float)
            return _measurements(self._header, arrays)
        except KeyError as error:
            raise FileFormatError(self.path, f"{error} is missing") from error
        except (RtofError, ValueError, TypeError, AttributeError, IndexError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(self.path, f"frames {start} to {stop}: {error}") from error


def read_measurements_npz(path: str | Path) -> Measurements:
    """Read measurements; nothing in the file is executed.

    Raises:
        FileFormatError: missing, damaged, of a newer schema, or an array is missing or has a wrong shape.
    """
    with MeasurementsReader(path) as reader:
        return reader.block(0, len(reader))


def _measurements(header: dict[str, Any], arrays: Mapping[str, Array]) -> Measurements:
    """Return frames of a file.

    Args:
        arrays: float64, by name.
    """
    times = arrays["times"]
    floor = header["floor_height"]
    full = 1 if header["schema_version"] == 1 else FULL
    return Measurements(
        times=times,
        views=tuple(_view(i, own, times, arrays, full) for i, own in enumerate(header["views"])),
        sensors=tuple(header["sensors"]),
        segments=tuple(header["segments"]),
        R_world_sensor=_rotations(arrays, "rotvec_world_sensor", "quat_wxyz_world_sensor"),
        R_bone_sensor=so3.known_from_quat_wxyz(arrays["quat_wxyz_bone_sensor"]),
        p_bone_sensor=arrays["p_bone_sensor"],
        truth=_truth(header["joints"], times, arrays) if header["joints"] else None,
        faults=tuple(
            StreamFault(FaultKind[str(kind)], str(what), float(start), float(stop))
            for kind, what, start, stop in header["faults"]
        ),
        floor_height=None if floor is None else float(floor),
    )


def _view(i: int, header: dict[str, Any], times: Array, arrays: Mapping[str, Array], full: int) -> KeypointSequence:
    own = header["camera"]
    K, R, t, distortion = (np.array(own[name], dtype=float) for name in CAMERA)
    size = int(own["width_px"]), int(own["height_px"])
    camera = Camera(K, R, t, *size, distortion, tuple(own["assumed"]), stabilised=bool(own["stabilised"]))
    uv, confidence = arrays[f"view_{i}_uv_px"], arrays[f"view_{i}_confidence"] / full
    keypoints = KeypointSequence(camera, times, uv, np.clip(confidence, 0, 1), tuple(header["names"]))
    video = {name: arrays[f"view_{i}_{name}"] for name in VIDEO_ARRAYS if f"view_{i}_{name}" in arrays}
    if (still := f"view_{i}_rotvec_still_camera") in arrays:
        video["R_still_camera"] = so3.known_exp(readonly(still, arrays[still], ("T", 3)))
    return with_video(keypoints, video)


def _truth(names: list[str], times: Array, arrays: Mapping[str, Array]) -> PoseSequence:
    p, R = arrays["truth_p_world_joint"], _rotations(arrays, "truth_rotvec", "truth_quat_wxyz")
    return PoseSequence(times, p, R, tuple(names), valid=arrays["truth_valid"] > 0)


def _rotations(arrays: Mapping[str, Array], vectors: str, quaternions: str) -> Array:
    """Return rotation matrices of the array of version 2 or else of version 1."""
    if quaternions in arrays:
        return so3.known_from_quat_wxyz(arrays[quaternions])
    return so3.known_exp(readonly(vectors, arrays[vectors], ("T", "S", 3)))
