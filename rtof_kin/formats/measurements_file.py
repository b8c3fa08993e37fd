"""``measurements.h5``: what a motion was computed from, beside ``motion.h5``; see `data.keypoints.Measurements`.

The bytes of the array `header` are JSON: names, cameras and faults. The others have the attributes unit, frame, shape:

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

Earlier versions wrote ``measurements.npz``, which is read: version 2 has the same arrays; in version 1 confidences are
0 to 1, orientations are quaternions, ``quat_wxyz_world_sensor`` and ``truth_quat_wxyz``, and the handheld camera has
``R_still_camera`` (T, 3, 3).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, reading
from rtof_kin.core.files.hdf5 import ArrayFile, BlockWriter, Hdf5Writer, multiples, rotation_vectors
from rtof_kin.core.over_time import Sampled
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_motion import VIDEO_ARRAYS, video_arrays, with_video

MEASUREMENTS: Final = "measurements.h5"
_EARLIER: Final = "measurements.npz"
SCHEMA_VERSION: Final = 2
CAMERA: Final = ("K", "R_camera_world", "t_camera_world", "distortion")
FULL: Final = 255  #: Number in the file of a confidence of 1
_CONSTANT: Final = ("quat_wxyz_bone_sensor", "p_bone_sensor", "K_still", "video_K", "video_distortion")
"""Arrays, or ends of their names, that do not have one row per frame."""
_ABOUT: Final = {
    "times": {"unit": "s", "shape": "(T,) frames"},
    "uv_px": {"unit": "px", "frame": "image of the camera", "shape": "(T, L, 2)"},
    "confidence": {"unit": "1/255", "shape": "(T, L)"},
    "video_times": {"unit": "s", "shape": "(T,), on the clock of the video"},
    "rotvec_still_camera": {"unit": "rad", "frame": "camera to its mean orientation", "shape": "(T, 3)"},
    "rotvec_world_sensor": {"unit": "rad", "frame": "sensor to world", "shape": "(T, S, 3)"},
    "quat_wxyz_bone_sensor": {"unit": "1", "frame": "sensor to segment", "shape": "(S, 4)"},
    "p_bone_sensor": {"unit": "m", "frame": "segment", "shape": "(S, 3)"},
    "truth_p_world_joint": {"unit": "m", "frame": "world", "shape": "(T, J, 3)"},
    "truth_rotvec": {"unit": "rad", "frame": "segment to world", "shape": "(T, J, 3)"},
    "truth_valid": {"unit": "1", "shape": "(T, J)"},
}
"""Attributes of the arrays by the end of their names."""
_PIXEL_BITS: Final = 6  #: [bits] after the point: 1/128 px of error, far below that of a detector
_SENSOR_BITS: Final = 15  #: 0.0015 deg of error
_TRUTH_BITS: Final = 13  #: 0.006 deg of error
_POSITION_BITS: Final = 16  #: 0.008 mm of error
_CAMERA_BITS: Final = 22  #: A thousandth of a pixel


def measurements_path(folder: Path) -> Path:
    """Return the file in an output folder, which need not exist."""
    earlier = folder / _EARLIER
    return earlier if earlier.is_file() and not (folder / MEASUREMENTS).exists() else folder / MEASUREMENTS


class MeasurementsReader(Sampled, AbstractContextManager["MeasurementsReader"]):
    """Measurements in a file, however long it is, of which any frames are read; a context that closes the file.

    Attributes:
        path: the file. times: (T,) s.
    """

    def __init__(self, path: str | Path):
        """Read what does not change over time; errors as `read_measurements`."""
        self.path = Path(path)
        with ExitStack() as failed:
            self._file = file = failed.enter_context(ArrayFile(self.path))
            with (
                reading(self.path, "its header is not readable ({})", RtofError, ValueError, TypeError),
                reading(self.path, "{} is missing", KeyError),
            ):
                self._header: dict[str, Any] = json.loads(file.text("header"))
                if self._header["schema_version"] > SCHEMA_VERSION:
                    raise FileFormatError(self.path, "its schema version is newer; update rtof_kin")
                self.times: Array = checked_times("measurements times", file.whole("times"))
                constant = [name for name in file.shapes if name.endswith(_CONSTANT)]
                self._constant: dict[str, Array] = {name: file.whole(name).astype(float) for name in constant}
            self._names = [name for name in file.shapes if name not in (*constant, "header")]
            if lengths := {file.shapes[name][0] for name in self._names} - {len(self.times)}:
                raise FileFormatError(self.path, f"arrays of different lengths, {len(self.times)} and {lengths.pop()}")
            failed.pop_all()

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def __reduce__(self) -> tuple[type[Self], tuple[Path]]:
        """Another process opens the file itself."""
        return type(self), (self.path,)

    def read(self, start: int | None = None, stop: int | None = None) -> Measurements:
        """Return frames [start, stop), by default from the first to the last, with the faults of all.
        `FileFormatError`: the file is damaged, or something in these frames is missing or invalid; `InvalidInputError`:
        no such frames.
        """
        start, stop = start or 0, len(self) if stop is None else stop
        if not 0 <= start < stop <= len(self):
            raise InvalidInputError(f"{self.path}: no frames {start} to {stop}; it has {len(self)}")
        arrays = dict(self._constant)
        wrong = RtofError, ValueError, TypeError, AttributeError, IndexError
        with (
            reading(self.path, f"frames {start} to {stop}: {{}}", *wrong),
            reading(self.path, "{} is missing", KeyError),
        ):
            for name in self._names:
                arrays[name] = np.asarray(self._file.rows(name, start, stop), dtype=float)
            return _measurements(self._header, arrays)

    def video_times(self, view: int) -> Array:
        """Return the times (T,) s of all frames on the clock of a camera's video; `view`: of the camera, from 0."""
        name = f"view_{view}_video_times"
        return self._file.whole(name).astype(float) if name in self._names else self.times


def read_measurements(path: str | Path) -> Measurements:
    """Read a whole file; nothing in it is executed. `FileFormatError`: missing, damaged, of a newer schema, or an array
    is missing or has a wrong shape.
    """
    with MeasurementsReader(path) as reader:
        return reader.read()


def _measurements(header: dict[str, Any], arrays: Mapping[str, Array]) -> Measurements:
    """Return frames of a file from its arrays, float64, by name."""
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


class MeasurementsWriter(BlockWriter):
    """Writes measurements by blocks; the file appears complete at the end of the context, or not at all."""

    def __init__(self, path: str | Path) -> None:
        """Write nothing yet; the file is replaced."""
        self._path = Path(path)
        self._arrays = Hdf5Writer(self._path, _ABOUT)
        self._header: dict[str, Any] | None = None
        self._constant: dict[str, Array] = {}
        self._rows: frozenset[str] = frozenset()
        self._faults: dict[StreamFault, None] = {}
        self._last = -np.inf

    def append(self, measurements: Measurements) -> None:
        """Append the next frames, of the same cameras, sensors and joints and with later times, else
        `InvalidInputError`. Faults are those of all blocks.
        """
        m = measurements
        header, (constant, rows) = _header(m), _arrays(m)
        if self._header is None:
            self._header, self._constant, self._rows = header, constant, frozenset(rows)
        elif not (
            json.dumps(header) == json.dumps(self._header)
            and rows.keys() == self._rows
            and all(np.array_equal(constant[name], array) for name, array in self._constant.items())
        ):
            raise InvalidInputError(f"{self._path}: the frames to be appended have other cameras or sensors")
        if m.times[0] <= self._last:
            raise InvalidInputError(
                f"{self._path}: frames from {m.times[0]:g} s do not follow those until {self._last:g} s"
            )
        self._last = float(m.times[-1])
        self._faults |= dict.fromkeys(m.faults)
        self._arrays.append(rows)

    def _finish(self) -> None:
        """Write what is known at the end."""
        if self._header is None:
            raise InvalidInputError(f"{self._path}: measurements need at least one frame")
        faults = [[fault.kind.name, fault.what, fault.start, fault.stop] for fault in self._faults]
        self._arrays.add_text("header", json.dumps(self._header | {"faults": faults}))
        for name, array in self._constant.items():
            self._arrays.add(name, array)


def _header(m: Measurements) -> dict[str, Any]:
    """Return names, cameras and the floor."""
    return {
        "schema_version": SCHEMA_VERSION,
        "sensors": m.sensors,
        "segments": m.segments,
        "floor_height": m.floor_height,
        "views": [{"names": view.names, "camera": _camera_numbers(view.camera)} for view in m.views],
        "joints": () if m.truth is None else m.truth.names,
    }


def _camera_numbers(camera: Camera) -> dict[str, Any]:
    numbers = {name: getattr(camera, name).tolist() for name in CAMERA}
    return numbers | {
        "width_px": int(camera.width_px),
        "height_px": int(camera.height_px),
        "assumed": camera.assumed,
        "stabilised": camera.stabilised,
    }


def _arrays(m: Measurements) -> tuple[dict[str, Array], dict[str, NDArray[Any]]]:
    """Return the arrays that do not change over time, and those with one row per frame."""
    constant: dict[str, Array] = {
        "quat_wxyz_bone_sensor": so3.known_to_quat_wxyz(m.R_bone_sensor),
        "p_bone_sensor": m.p_bone_sensor,
    }
    rows: dict[str, NDArray[Any]] = {"times": m.times}
    for i, view in enumerate(m.views):
        seen = np.maximum(np.round(view.confidence * FULL), view.confidence > 0)  # a seen point stays above 0
        own: dict[str, NDArray[Any]] = {
            "uv_px": multiples(view.uv_px, _PIXEL_BITS).astype(np.float32),
            "confidence": seen.astype(np.uint8),
        }
        video = video_arrays(view)
        if "R_still_camera" in video:
            own["rotvec_still_camera"] = rotation_vectors(video.pop("R_still_camera"), _CAMERA_BITS)
        if "video_times" in video:
            own["video_times"] = video.pop("video_times")
        rows |= {f"view_{i}_{name}": array for name, array in own.items()}
        constant |= {f"view_{i}_{name}": array for name, array in video.items()}
    rows["rotvec_world_sensor"] = rotation_vectors(m.R_world_sensor, _SENSOR_BITS)
    if m.truth is not None:
        p = multiples(m.truth.p_world_joint, _POSITION_BITS)
        rows["truth_p_world_joint"] = p.astype(np.float32)
        rows["truth_rotvec"] = rotation_vectors(m.truth.R_world_bone, _TRUTH_BITS)
        rows["truth_valid"] = m.truth.valid
    return constant, rows
