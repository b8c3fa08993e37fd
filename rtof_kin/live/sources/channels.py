"""Samples of inertial sensors and of detected points from the channels of a live stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.formats.channels import PointChannels, StreamChannels
from rtof_kin.live.samples import FrameSample, ImuSample


@dataclass(frozen=True)
class ImuChannels:
    """Inertial sensors of one stream; each has an orientation."""

    stream: str
    """Name, for messages."""
    channels: StreamChannels
    _quaternions: NDArray[np.intp]
    """(S, 4) columns."""
    _acceleration: NDArray[np.intp]
    """(S, 3) columns; -1 where a sensor has none."""

    @classmethod
    def of(
        cls,
        stream: str,
        labels: Sequence[str],
        units: Sequence[str] = (),
        types: Sequence[str] = (),
        declared: Mapping[str, Any] | None = None,
    ) -> ImuChannels:
        """Return what the channels of a stream hold, see `rtof_kin.formats.channels`.

        Args:
            stream: its name; of the sensor too, where labels name none.
            labels, units, types: of each channel; units and types may be empty.
            declared: fields of `rtof_kin.data.imu_stream.Declaration` that replace what it states.

        Raises:
            SourceError: no sensor, one without orientation, an incomplete quantity, a channel twice, an
                unknown unit; names stream, channel and remedy.
            UnknownNameError: an unknown field or value of the declaration.
        """
        try:
            channels = StreamChannels.of(stream, labels, units, types, declared)
        except InvalidInputError as error:
            raise SourceError(str(error)) from error
        for sensor in channels.sensors:
            if sensor.quaternions is None:
                raise SourceError(
                    f"stream {stream}: sensor {sensor.name} has no quaternion; send qw, qx, qy, qz of its "
                    "orientation filter too"
                )
        none = np.full(3, -1)
        forces = [none if s.acceleration is None else s.acceleration for s in channels.sensors]
        quaternions = [s.quaternions for s in channels.sensors if s.quaternions is not None]
        return cls(stream, channels, np.array(quaternions), np.array(forces))

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the S sensors."""
        return tuple(sensor.name for sensor in self.channels.sensors)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about channels that are left out, and about what sensors lack."""
        without = [s.name for s in self.channels.sensors if s.acceleration is None]
        lacks = (f"stream {self.stream}: no acceleration of {', '.join(without)}",) if without else ()
        return (*self.channels.notes, *lacks)

    def samples(self, times: ArrayLike, values: ArrayLike) -> list[ImuSample]:
        """Return one sample of each sensor at each time, in the order of times.

        Args:
            times: (T,) s. values: (T, C) of all channels.

        Raises:
            SourceError: another number of channels than labels.
        """
        stamps = np.asarray(times, dtype=float)
        numbers = checked_width(self.stream, values, len(stamps), self.channels.count)
        declaration, S = self.channels.declaration, len(self.sensors)
        R = declaration.rotations(numbers[:, self._quaternions].reshape(-1, 4))
        a = np.where(self._acceleration < 0, np.nan, numbers[:, self._acceleration]).reshape(-1, 3)
        f = declaration.specific_force(a, R)
        return [ImuSample(self.sensors[i % S], float(stamps[i // S]), R[i], f[i]) for i in range(len(stamps) * S)]


@dataclass(frozen=True)
class FrameChannels:
    """Detected points of one stream."""

    stream: str
    """Name, for messages."""
    channels: PointChannels

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the L points."""
        return self.channels.names

    @classmethod
    def of(cls, stream: str, labels: Sequence[str], units: Sequence[str] = ()) -> FrameChannels:
        """Return what the channels of a stream hold: ``<landmark>_x``, ``_y`` in px, ``_confidence``.

        Args:
            labels, units: of each channel; units may be empty.

        Raises:
            SourceError: no point, one without x or y, a channel twice, or coordinates that are not in px.
        """
        try:
            return cls(stream, PointChannels.of(stream, labels, units))
        except InvalidInputError as error:
            raise SourceError(str(error)) from error

    def samples(self, times: ArrayLike, values: ArrayLike) -> list[FrameSample]:
        """Return the frames, in the order of times.

        Args:
            times: (T,) s. values: (T, C) of all channels.

        Raises:
            SourceError: another number of channels than labels.
        """
        stamps = np.asarray(times, dtype=float)
        uv, confidence = self.channels.points(checked_width(self.stream, values, len(stamps), self.channels.count))
        return [FrameSample(float(stamps[i]), uv[i], confidence[i]) for i in range(len(stamps))]


def checked_width(stream: str, values: ArrayLike, rows: int, count: int) -> Array:
    """Return the numbers of some samples as an array (T, C).

    Args:
        values: (T, C).

    Raises:
        SourceError: the values have another shape.
    """
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise SourceError(f"stream {stream}: sends something else than {count} numbers ({error})") from error
    if numbers.shape != (rows, count):
        width = numbers.shape[-1] if numbers.ndim == 2 else numbers.size
        raise SourceError(
            f"stream {stream}: {width} numbers in a sample, and labels for {count}; label every channel once"
        )
    return numbers
