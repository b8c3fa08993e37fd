"""Numbers of sensors as they are in a file, and their conversion by a declaration to a log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import LARGEST_NUMBER
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream

_NO_ROTATION: Final = 0.02
"""Largest difference of M M^T from the identity; files with few digits reach 0.001."""


@dataclass(frozen=True)
class Readings:
    """One sensor's numbers in the units and axes of its file; None where absent."""

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
    """Remarks of the reader, in sentences."""

    def stream(self, declaration: Declaration) -> SensorStream:
        """Convert to SI units and this package's frames.

        Raises:
            InvalidInputError: invalid times or matrices, a number beyond all measure, or gravity was
                removed and there is no orientation.
        """
        for kind in ("times", "acceleration", "gyroscope", "magnetometer", "quaternions"):
            values = getattr(self, kind)
            huge = np.argwhere(np.abs([] if values is None else values) > LARGEST_NUMBER)
            if len(huge):
                raise InvalidInputError(
                    f"sensor {self.name}, sample {huge[0][0]}: {values[tuple(huge[0])]:g} in {kind} is no measurement"
                )
        R = norm = None
        if self.quaternions is not None:
            R, norm = declaration.rotations(self.quaternions), np.linalg.norm(self.quaternions, axis=1)
        elif self.matrices is not None:
            R = declaration.upright(_rotations(self.name, self.matrices))
        f = None if self.acceleration is None else declaration.specific_force(self.acceleration, R)
        w = None if self.gyroscope is None else declaration.angular_velocity(self.gyroscope)
        return SensorStream(self.name, self.times, f, R, w, self.magnetometer, norm, self.notes)


def _rotations(name: str, matrices: Array) -> Array:
    """Return the rotations nearest to a file's matrices, which have few digits."""
    known = np.isfinite(matrices).all(axis=(1, 2)) & matrices.any(axis=(1, 2))
    M = matrices[known]
    error = np.abs(M @ np.swapaxes(M, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    wrong = (error > _NO_ROTATION) | (np.linalg.det(M) < 0)
    if wrong.any():
        i = int(np.flatnonzero(known)[np.flatnonzero(wrong)[0]])
        raise InvalidInputError(f"sensor {name}: the matrix of sample {i} is no rotation")
    R = np.full(matrices.shape, np.nan)
    R[known] = so3.nearest_rotation(M)
    return R


def sensor_log(
    paths: Sequence[Path],
    title: str,
    readings: Iterable[Readings],
    declaration: Declaration,
    file_notes: Iterable[str] = (),
    start_utc: datetime | None = None,
) -> SensorLog:
    """Make the log of one trial.

    Args:
        start_utc: of the earliest sample, if the files state it.

    Raises:
        FileFormatError: no sensor, a name twice, or invalid numbers.
    """
    path = paths[0] if len(paths) == 1 else paths[0].parent
    try:
        streams = tuple(one.stream(declaration) for one in readings)
        if not streams:
            raise InvalidInputError("there is no sensor in it")
        return SensorLog(path, title, streams, declaration, tuple(file_notes), start_utc)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
