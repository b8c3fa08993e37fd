"""What inertial sensors measured, in SI units: `SensorStream` of one, `SensorLog` of all in a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import checked_names, checked_times, indices_of, readonly
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_declaration import Declaration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorStream:
    """What one sensor measured, at times of its own. What it does not measure is None; a sample or a
    component that is missing is NaN; a packet that was lost is not there, which its times show.
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
    """(T, 3) magnetic field in sensor axes, in the maker's unit."""
    quaternion_norm: Array | None = None
    """(T,) of the file's quaternions before they were normalised; None where it has none."""
    notes: tuple[str, ...] = ()
    """What a user should know of it, in sentences: packets lost, orientation estimated."""

    def __post_init__(self) -> None:
        set_, where = object.__setattr__, f"sensor {self.name}"
        set_(self, "times", checked_times(f"{where} times", self.times))
        set_(self, "notes", tuple(self.notes))
        T = len(self.times)
        shapes = {
            "f_sensor": (T, 3), "R_inertial_sensor": (T, 3, 3), "w_sensor": (T, 3), "m_sensor": (T, 3),
            "quaternion_norm": (T,),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None:
                set_(self, name, readonly(f"{where} {name}", value, shape))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def holds(self) -> tuple[str, ...]:
        """Names of the arrays that are there, of those a sensor measures."""
        names = ("f_sensor", "w_sensor", "m_sensor", "R_inertial_sensor")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def rate_hz(self) -> float:
        """Samples per second, by the median step; NaN of fewer than two samples."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else float("nan")

    def imu(self) -> ImuSequence:
        """The stream as a recording takes it.

        Raises:
            ShapeError: orientation or acceleration is not there.
        """
        if self.R_inertial_sensor is None or self.f_sensor is None:
            missing = "orientation" if self.R_inertial_sensor is None else "acceleration"
            raise ShapeError(
                f"sensor {self.name} has no {missing}; orientation comes from raw gyroscope and "
                "accelerometer by rtof_kin.inertial.orientation"
            )
        R, f = self.R_inertial_sensor[:, None], self.f_sensor[:, None]
        return ImuSequence(self.times, R, f, (self.name,))


@dataclass(frozen=True)
class SensorLog:
    """The sensors of one file or folder."""

    path: Path
    format: str
    """What the file is, in words."""
    streams: tuple[SensorStream, ...]
    declaration: Declaration
    """How its numbers were meant."""
    file_notes: tuple[str, ...] = ()
    """What a user should know of the file as a whole, in sentences."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "streams", tuple(self.streams))
        checked_names(f"sensors of {self.path}", self.names)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know: of the file, then of each sensor, by its name."""
        own = (f"{stream.name}: {note}" for stream in self.streams for note in stream.notes)
        return (*self.file_notes, *own)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the sensors, in order."""
        return tuple(stream.name for stream in self.streams)

    def select(self, names: Sequence[str]) -> Self:
        """The sensors named, in that order.

        Raises:
            UnknownNameError: one is not there.
        """
        index = indices_of("sensor", names, self.names)
        return replace(self, streams=tuple(self.streams[i] for i in index))

    def renamed(self, names: Mapping[str, str]) -> Self:
        """The same with other names for some sensors, e.g. segments for serial numbers.

        Raises:
            UnknownNameError: one is not there. ShapeError: two would have one name.
        """
        indices_of("sensor", list(names), self.names)
        streams = [replace(s, name=names.get(s.name, s.name)) for s in self.streams]
        return replace(self, streams=tuple(streams))

    def imus(self) -> tuple[ImuSequence, ...]:
        """The sensors as a recording takes them: those with the same times together.

        Raises:
            ShapeError: a sensor has no orientation or no acceleration.
        """
        groups: list[list[ImuSequence]] = []
        for stream in self.streams:
            imu = stream.imu()
            same = (g for g in groups if np.array_equal(g[0].times, imu.times))
            group = next(same, None)
            if group is None:
                groups.append([imu])
            else:
                group.append(imu)
        return tuple(
            ImuSequence(
                group[0].times,
                np.concatenate([imu.R_inertial_sensor for imu in group], axis=1),
                np.concatenate([imu.f_sensor for imu in group], axis=1),
                tuple(imu.names[0] for imu in group),
            )
            for group in groups
        )
