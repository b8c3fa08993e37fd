"""From a file's numbers to a log: what a reader found, and how a declaration gives it meaning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.text import LARGEST_NUMBER
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream

Array = NDArray[np.float64]
_NO_ROTATION = 0.02
"""Largest difference of M M^T from the identity; files with few digits reach 0.001."""


@dataclass(frozen=True)
class Readings:
    """One sensor's numbers as they stand in a file, in its units and axes; None where it has none."""

    name: str
    times: Array
    """(T,) s on the file's clock."""
    acceleration: Array | None = None
    """(T, 3)"""
    gyroscope: Array | None = None
    """(T, 3)"""
    magnetometer: Array | None = None
    """(T, 3)"""
    quaternions: Array | None = None
    """(T, 4)"""
    matrices: Array | None = None
    """(T, 3, 3) instead of quaternions; zero or NaN where missing."""
    notes: tuple[str, ...] = ()
    """What its reader met, in sentences."""

    def stream(self, declaration: Declaration) -> SensorStream:
        """The same in SI units and this package's frames.

        Raises:
            ShapeError: times or matrices are none, a number is no measurement, or gravity was removed and
                there is no orientation.
        """
        for kind in ("times", "acceleration", "gyroscope", "magnetometer", "quaternions"):
            self._check_size(kind)
        R = norm = None
        if self.quaternions is not None:
            R, norm = declaration.rotations(self.quaternions), np.linalg.norm(self.quaternions, axis=1)
        elif self.matrices is not None:
            R = declaration.upright(_rotations(self.name, self.matrices))
        f = w = None
        if self.acceleration is not None:
            f = declaration.specific_force(self.acceleration, R)
        if self.gyroscope is not None:
            w = declaration.angular_velocity(self.gyroscope)
        return SensorStream(self.name, self.times, f, R, w, self.magnetometer, norm, self.notes)

    def _check_size(self, kind: str) -> None:
        values = getattr(self, kind)
        huge = np.argwhere(np.abs([] if values is None else values) > LARGEST_NUMBER)
        if len(huge):
            number = values[tuple(huge[0])]
            raise ShapeError(
                f"sensor {self.name}, sample {huge[0][0]}: {number:g} in {kind} is no measurement"
            )


def _rotations(name: str, matrices: Array) -> Array:
    """The rotations nearest to a file's matrices, whose digits were cut off."""
    known = np.isfinite(matrices).all(axis=(1, 2)) & matrices.any(axis=(1, 2))
    M = matrices[known]
    error = np.abs(M @ np.swapaxes(M, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    wrong = (error > _NO_ROTATION) | (np.linalg.det(M) < 0)
    if wrong.any():
        i = int(np.flatnonzero(known)[np.flatnonzero(wrong)[0]])
        raise ShapeError(f"sensor {name}: the matrix of sample {i} is no rotation")
    R = np.full(matrices.shape, np.nan)
    R[known] = so3.nearest_rotation(M)
    return R


def sensor_log(
    paths: Sequence[Path],
    title: str,
    readings: Iterable[Readings],
    declaration: Declaration,
    file_notes: Iterable[str] = (),
) -> SensorLog:
    """The log of one file, or of the files of one trial.

    Raises:
        FileFormatError: there is no sensor, one stands there twice, or its numbers make no stream.
    """
    path = paths[0] if len(paths) == 1 else paths[0].parent
    try:
        streams = tuple(one.stream(declaration) for one in readings)
        if not streams:
            raise ShapeError("there is no sensor in it")
        return SensorLog(path, title, streams, declaration, tuple(file_notes))
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
