"""`Stream`: samples of one kind in a recording, made row by row, so that they need not be in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

Part = TypeVar("Part", KeypointSequence, ImuSequence, PoseSequence)
ALL: Final = slice(None)
BLOCK: Final = 2048
"""Rows that are checked at once."""


def rows_between(times: Array, start_s: float, stop_s: float) -> slice:
    """Return the rows whose times lie in a closed interval.

    Args:
        times: (T,) s, increasing. start_s, stop_s: first and last instant, s; samples at them belong to it.
    """
    first, last = np.searchsorted(times, start_s, "left"), np.searchsorted(times, stop_s, "right")
    return slice(int(first), max(int(first), int(last)))


@dataclass(frozen=True)
class Stream(Generic[Part]):
    """Samples of one kind in a recording."""

    times: Array
    """(T,) s."""
    part: Callable[[slice], Part]
    """Samples of some rows, at least one; of `ALL` they are checked as a whole."""

    def __len__(self) -> int:
        return len(self.times)

    def between(self, start_s: float, stop_s: float) -> Part | None:
        """Return the samples in a closed interval; None where there are none.

        Args:
            start_s, stop_s: first and last instant, s.
        """
        rows = rows_between(self.times, start_s, stop_s)
        return self.part(rows) if rows.start < rows.stop else None

    def blocks(self) -> Iterator[Part]:
        """Yield all samples in order."""
        for start in range(0, len(self), BLOCK):
            yield self.part(slice(start, min(start + BLOCK, len(self))))


@dataclass(frozen=True)
class Streams:
    """All that changes over time in a recording; None or nothing where there is none."""

    keypoints: Stream[KeypointSequence] | None
    views: tuple[Stream[KeypointSequence], ...]
    imus: Stream[ImuSequence] | None
    truth: Stream[PoseSequence] | None

    def parts(self, rows: Callable[[Stream[Any]], Any]) -> dict[str, Any]:
        """Return the fields of a `Recording` that hold the samples.

        Args:
            rows: samples of a stream; None where there are none.
        """

        def of(stream: Stream[Any] | None) -> Any:
            return None if stream is None else rows(stream)

        parts = {"keypoints": of(self.keypoints), "imus": of(self.imus), "truth": of(self.truth)}
        views = () if parts["keypoints"] is None else map(of, self.views)
        return parts | {"views": tuple(view for view in views if view is not None)}

    def check_clocks(self) -> None:
        """Check that all streams overlap in time with the first one.

        Raises:
            InvalidInputError: one does not.
        """
        named = {"keypoints": self.keypoints, "IMU": self.imus, "truth": self.truth}
        named |= {f"view {i}": view for i, view in enumerate(self.views, start=1)}
        (first, times), *others = ((what, part.times) for what, part in named.items() if part is not None)
        for what, other in others:
            if not (other[0] <= times[-1] and times[0] <= other[-1]):
                raise InvalidInputError(
                    f"{what} times run from {other[0]:g} to {other[-1]:g} s, those of the "
                    f"{first} from {times[0]:g} to {times[-1]:g} s; shift them to one clock"
                )


class TimeAxis(ABC):
    """The common time axis of a recording: the frames of its first camera, or the samples of its sensors."""

    @property
    @abstractmethod
    def frame_times(self) -> Array | None:
        """(T,) s of the frames of the first camera; None without one."""

    @property
    @abstractmethod
    def times(self) -> Array:
        """(T,) s of the frames of the first camera, without one of the sensors' samples."""

    @property
    @abstractmethod
    def has_sensors(self) -> bool:
        """Whether there are IMUs."""

    @property
    def usual_mode(self) -> Mode:
        """Mode that uses all that was recorded: rtof, rto without IMUs, imu without a camera."""
        if self.frame_times is None:
            return "imu"
        return "rtof" if self.has_sensors else "rto"

    @property
    def start_s(self) -> float:
        """First instant, s."""
        return float(self.times[0])

    @property
    def stop_s(self) -> float:
        """Last instant, s."""
        return float(self.times[-1])

    @property
    def rate_hz(self) -> float:
        """Rate, Hz, from the median step; 60 for a single sample."""
        return float(1 / np.median(np.diff(self.times))) if len(self.times) > 1 else 60.0
