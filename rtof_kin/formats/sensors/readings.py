"""Numbers of sensors as they are in a file, and their conversion by a declaration to a log.

Radios lose packets and send some late or twice, and counters of 16 or 32 bits restart at 0 when they are
full. Each of these is reported in a sentence. A counter that restarts for another reason is an error: two
recordings in one file have no clock in common.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, reading
from rtof_kin.core.files.text import LARGEST_NUMBER
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream

Count = NDArray[np.int64]
WRAP_16: Final = 2**16
WRAP_32: Final = 2**32
_LONGEST_ACROSS_WRAP: Final = 16
"""A counter that falls is taken to have wrapped where at most this fraction of its range was lost."""
_MOST_AGAIN: Final = 0.25  #: Largest plausible share of packets sent twice


@dataclass(frozen=True)
class Packets:
    """The packets of one sensor, in order."""

    rows: Count  #: (T,) rows of the file to take
    count: Count  #: (T,) their unwrapped counter, strictly increasing
    notes: tuple[str, ...] = ()  #: Corrections, in sentences without a subject


def in_order(path: Path, counters: Array, lines: Sequence[int], wrap: int, late: int, what: str) -> Packets:
    """Sort packets by a counter (N,) that wraps: `wrap` is the first number that it cannot show, e.g. 2**16.
    `FileFormatError`, which names line and counter: no whole number, out of range, not counting, or restarted.
    """
    wrong = ~((counters >= 0) & (counters < wrap) & (counters == np.round(counters)))
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise FileFormatError(path, f"{what} is {counters[i]:g}, not a whole number from 0 to {wrap - 1}", lines[i])
    raw = counters.astype(np.int64)
    forward = np.mod(np.diff(raw), wrap)
    steps = np.where(forward > wrap - late, forward - wrap, forward)
    falls = (np.diff(raw) < 0) & (steps > 0)
    anew = np.flatnonzero(falls & (steps > wrap // _LONGEST_ACROSS_WRAP))
    if len(anew):
        i = int(anew[0])
        raise FileFormatError(
            path,
            f"{what} goes from {raw[i]} back to {raw[i + 1]}: it started anew; make a file of each recording",
            lines[i + 1],
        )
    count = raw[0] + np.concatenate([[0], np.cumsum(steps)])
    rows = np.argsort(count, kind="stable")
    new = np.diff(count[rows], prepend=count[rows[0]] - 1) > 0
    if np.sum(~new) > _MOST_AGAIN * len(raw):
        raise FileFormatError(
            path,
            f"{np.sum(~new)} of {len(raw)} lines repeat a {what}: it started anew, or does not "
            "count; make a file of each recording",
            lines[int(np.argmax(steps <= 0)) + 1],
        )
    events = (
        (falls, "time", f"{what} passed {wrap - 1} and began again at 0"),
        (steps < 0, "packet", "late, put in their places"),
        (~new, "packet", "sent again, taken once"),
    )
    notes = [f"{_counted(int(e.sum()), noun)} {event}" for e, noun, event in events if e.any()]
    return Packets(rows[new], count[rows[new]], tuple(notes))


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("s" if number > 1 else "")


def lost(times: Array, rate_hz: float | None = None) -> tuple[str, ...]:
    """Return a sentence about missing samples, by steps of more than 1.5 sampling periods (by default the median step);
    none where times (T,), s, do not increase.
    """
    steps = np.diff(times)
    if len(steps) == 0 or not np.all((steps > 0) & (steps < np.inf)):
        return ()
    rate_hz = rate_hz or float(1 / np.median(steps))
    gaps = np.round(steps * rate_hz) - 1
    gaps = gaps[gaps > 0]
    missing = int(gaps.sum())
    if missing == 0:
        return ()
    share, longest = missing / (missing + len(times)), gaps.max() / rate_hz
    places = _counted(len(gaps), "gap")
    return (f"{_counted(missing, 'packet')} ({share:.1%}) lost in {places}, the longest of {longest:.2f} s",)


def aligned(packets: Sequence[Packets], wrap: int) -> list[int]:
    """Return what to add to each sensor's counts, which wrap at `wrap`, so that all begin within half a wrap of the
    first packet of the first one; in one trial one may have 65535 and another 0.
    """
    first = [int(one.count[0]) for one in packets]
    return [wrap * round((first[0] - one) / wrap) for one in first]


_NO_ROTATION: Final = 0.02  #: Largest difference of M M^T from the identity; files with few digits reach 0.001


@dataclass(frozen=True)
class Readings:
    """One sensor's numbers in the units and axes of its file; None where absent."""

    name: str
    times: Array  #: (T,) s on the file's clock
    acceleration: Array | None = None  #: (T, 3)
    gyroscope: Array | None = None  #: (T, 3)
    magnetometer: Array | None = None  #: (T, 3)
    quaternions: Array | None = None  #: (T, 4)
    matrices: Array | None = None  #: (T, 3, 3) instead of quaternions; zero or NaN where missing
    notes: tuple[str, ...] = ()  #: Remarks of the reader, in sentences

    def stream(self, declaration: Declaration) -> SensorStream:
        """Convert to SI units and this package's frames. `InvalidInputError`: invalid times or matrices, a number
        beyond all measure, or gravity was removed and there is no orientation.
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
    """Make the log of one trial. `FileFormatError`: no sensor, a name twice, or invalid numbers.

    Args:
        start_utc: of the earliest sample, if the files state it.
    """
    path = paths[0] if len(paths) == 1 else paths[0].parent
    with reading(path):
        streams = tuple(one.stream(declaration) for one in readings)
        if not streams:
            raise InvalidInputError("there is no sensor in it")
        return SensorLog(path, title, streams, declaration, tuple(file_notes), start_utc)
