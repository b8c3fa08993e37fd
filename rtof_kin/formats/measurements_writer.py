"""Writing ``measurements.npz``, whole or by blocks; `measurements_npz` has the arrays and reads them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.compact import multiples, rotation_vectors
from rtof_kin.core.files.npz_writer import NpzWriter
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.formats.measurements_npz import CAMERA, FULL, SCHEMA_VERSION
from rtof_kin.formats.video_arrays import video_arrays

_PIXEL_BITS: Final = 6
"""[bits] after the point: 1/128 px of error, far below that of a detector."""
_SENSOR_BITS: Final = 15
"""0.0015 deg of error."""
_TRUTH_BITS: Final = 13
"""0.006 deg of error."""
_POSITION_BITS: Final = 16
"""0.008 mm of error."""
_CAMERA_BITS: Final = 22
"""A thousandth of a pixel."""


class MeasurementsWriter:
    """Writes measurements by blocks; the file appears complete at the end of the context, or not at all."""

    def __init__(self, path: str | Path) -> None:
        """Write nothing yet.

        Args:
            path: the file, which is replaced.
        """
        self._path = Path(path)
        self._arrays = NpzWriter(self._path)
        self._open = ExitStack()
        self._header: dict[str, Any] | None = None
        self._constant: dict[str, Array] = {}
        self._rows: frozenset[str] = frozenset()
        self._faults: dict[StreamFault, None] = {}
        self._last = -np.inf

    def __enter__(self) -> Self:
        """Open the file.

        Raises:
            WritingError: it cannot be written.
        """
        self._open.enter_context(self._arrays)
        self._open.push(self._finish)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return self._open.__exit__(kind, error, trace)

    def append(self, measurements: Measurements) -> None:
        """Append the next frames.

        Args:
            measurements: of the same cameras, sensors and joints, with times after those before. Faults are
                those of all blocks.

        Raises:
            InvalidInputError: others, or earlier times.
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

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write what is known at the end."""
        if kind is not None:
            return
        if self._header is None:
            raise InvalidInputError(f"{self._path}: measurements need at least one frame")
        faults = [[fault.kind.name, fault.what, fault.start, fault.stop] for fault in self._faults]
        self._arrays.add("header", np.array(json.dumps(self._header | {"faults": faults})))
        for name, array in self._constant.items():
            self._arrays.add(name, array)


def write_measurements_npz(path: str | Path, measurements: Measurements) -> None:
    """Write measurements over an existing file.

    Raises:
        RtofError: it cannot be written.
    """
    with MeasurementsWriter(path) as writer:
        writer.append(measurements)


def _header(m: Measurements) -> dict[str, Any]:
    """Return names, cameras and the floor."""
    return {
        "schema_version": SCHEMA_VERSION,
        "sensors": m.sensors,
        "segments": m.segments,
        "floor_height": m.floor_height,
        "views": [{"names": view.names, "camera": _camera(view.camera)} for view in m.views],
        "joints": () if m.truth is None else m.truth.names,
    }


def _camera(camera: Camera) -> dict[str, Any]:
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
        own, video = _view(view), video_arrays(view)
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


def _view(view: KeypointSequence) -> dict[str, NDArray[Any]]:
    """Return the points of a camera; a point that was seen keeps a confidence above 0."""
    confidence = np.maximum(np.round(view.confidence * FULL), view.confidence > 0)
    return {"uv_px": multiples(view.uv_px, _PIXEL_BITS).astype(np.float32), "confidence": confidence.astype(np.uint8)}
