"""Samples of inertial sensors in SI units: `SensorStream` of one sensor, `SensorLog` of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Self

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, freeze, indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_declaration import Declaration


@dataclass(frozen=True)
class SensorStream:
    """Samples of one sensor at its own times.

    Quantities that it does not measure are None; missing samples are NaN; lost packets are gaps of its times.
    """

    name: str
    times: Array
    """(T,) s on the file's clock, strictly increasing."""
    f_sensor: Array | None = None
    """(T, 3) specific force in sensor axes, m/s^2: 9.81 upwards at rest."""
    R_inertial_sensor: Array | None = None
    """(T, 3, 3) orientation in a reference with z up; NaN as a whole where missing."""
    w_sensor: Array | None = None
    """(T, 3) angular velocity in sensor axes, rad/s."""
    m_sensor: Array | None = None
    """(T, 3) magnetic field in sensor axes, in the manufacturer's unit."""
    quaternion_norm: Array | None = None
    """(T,) norm of the quaternions in the file; None without quaternions."""
    notes: tuple[str, ...] = ()
    """Remarks for the user, e.g. lost packets, estimated orientation."""

    def __post_init__(self) -> None:
        set_, where = object.__setattr__, f"sensor {self.name}"
        set_(self, "times", checked_times(f"{where} times", self.times))
        set_(self, "notes", tuple(self.notes))
        T = len(self.times)
        shapes: dict[str, tuple[int, ...]] = {
            "f_sensor": (T, 3),
            "R_inertial_sensor": (T, 3, 3),
            "w_sensor": (T, 3),
            "m_sensor": (T, 3),
            "quaternion_norm": (T,),
        }
        freeze(self, where, **{n: shape for n, shape in shapes.items() if getattr(self, n) is not None})

    def __len__(self) -> int:
        return len(self.times)

    @property
    def holds(self) -> tuple[str, ...]:
        """Names of the measured arrays."""
        names = ("f_sensor", "w_sensor", "m_sensor", "R_inertial_sensor")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def rate_hz(self) -> float:
        """Sampling rate, Hz, from the median step; NaN for fewer than two samples."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else float("nan")

    def between(self, start: float, stop: float) -> SensorStream | None:
        """Return the samples from start to before stop; None where there are fewer than two.

        Args:
            start, stop: s.
        """
        a, b = np.searchsorted(self.times, [start, stop])
        if b - a < 2:
            return None
        arrays = {name: getattr(self, name)[a:b] for name in ("times", *self.holds)}
        return replace(self, **arrays, quaternion_norm=None)

    def imu(self) -> ImuSequence:
        """Return orientation and specific force for a recording.

        Raises:
            InvalidInputError: one of them is missing.
        """
        if self.R_inertial_sensor is None or self.f_sensor is None:
            missing = "orientation" if self.R_inertial_sensor is None else "acceleration"
            raise InvalidInputError(
                f"sensor {self.name} has no {missing}; orientation comes from raw gyroscope and "
                "accelerometer by rtof_kin.inertial.orientation"
            )
        R, f = self.R_inertial_sensor[:, None], self.f_sensor[:, None]
        return ImuSequence(self.times, R, f, (self.name,))


@dataclass(frozen=True)
class SensorLog:
    """Sensors of a file or folder."""

    path: Path
    format: str
    """Format in words."""
    streams: tuple[SensorStream, ...]
    declaration: Declaration
    """Units and conventions of the file."""
    file_notes: tuple[str, ...] = ()
    """Remarks on the file as a whole."""
    start_utc: datetime | None = None
    """Date and time of the earliest sample, with its zone UTC; None where the file does not state it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "streams", tuple(self.streams))
        if self.start_utc is not None and self.start_utc.utcoffset() != timedelta(0):
            raise InvalidInputError(f"start_utc of {self.path}: {self.start_utc} is not in UTC")
        checked_names(f"sensors of {self.path}", self.names)

    @classmethod
    def of_imus(cls, imus: ImuSequence, path: str | Path) -> Self:
        """Return the sensors of a recording."""
        streams = tuple(
            SensorStream(name, imus.times, imus.f_sensor[:, s], imus.R_inertial_sensor[:, s])
            for s, name in enumerate(imus.names)
        )
        return cls(Path(path), "IMUs of a recording", streams, Declaration())

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the file, then on each sensor by name."""
        own = (f"{stream.name}: {note}" for stream in self.streams for note in stream.notes)
        return (*self.file_notes, *own)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(stream.name for stream in self.streams)

    def select(self, names: Sequence[str]) -> Self:
        """Return sensors in the order of `names`.

        Raises:
            UnknownNameError: a sensor does not exist.
        """
        index = indices_of("sensor", names, self.names)
        return replace(self, streams=tuple(self.streams[i] for i in index))

    def renamed(self, names: Mapping[str, str]) -> Self:
        """Rename sensors, e.g. from serial numbers to segments.

        Raises:
            UnknownNameError: a sensor does not exist. InvalidInputError: two would have the same name.
        """
        indices_of("sensor", list(names), self.names)
        streams = [replace(s, name=names.get(s.name, s.name)) for s in self.streams]
        return replace(self, streams=tuple(streams))

    def imus(self) -> tuple[ImuSequence, ...]:
        """Return orientation and specific force for a recording, sensors with equal times joined.

        Raises:
            InvalidInputError: a sensor has no orientation or no acceleration.
        """
        groups: dict[bytes, list[ImuSequence]] = {}
        for stream in self.streams:
            groups.setdefault(stream.times.tobytes(), []).append(stream.imu())
        return tuple(ImuSequence.joined(group) for group in groups.values())
