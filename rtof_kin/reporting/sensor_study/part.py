"""The part of a long recording that a sensor study takes: the one with the most movement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.core import rotations
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.recording.recording import Recording

LONGEST: Final = 120.0  # [s] of a recording that a study takes if nothing else is wanted
_BIN: Final = 1.0  # [s] over which movement is averaged
_MARGIN: Final = 1.0  # [s] of samples of the sensors on both sides of the video


@dataclass(frozen=True)
class Part:
    """An interval of a recording."""

    start: float
    """s, on the recording's clock."""
    stop: float
    whole: float
    """s, length of the recording."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return self.stop - self.start

    @property
    def is_whole(self) -> bool:
        """Whether it is the recording itself."""
        return self.seconds >= self.whole

    def of(self, recording: Recording) -> Recording:
        """Return this part of a recording; the reference is left as it is."""
        keypoints, imus = recording.keypoints, recording.imus
        if self.is_whole:
            return recording
        margin = 0.0
        if keypoints is not None:
            keypoints, margin = keypoints[self._frames(keypoints.times)], _MARGIN
        if imus is not None:
            some = self._frames(imus.times, margin)
            R, f = imus.R_inertial_sensor[some], imus.f_sensor[some]
            imus = replace(imus, times=imus.times[some], R_inertial_sensor=R, f_sensor=f)
        return replace(recording, keypoints=keypoints, imus=imus)

    def _frames(self, times: Array, margin: float = 0.0) -> slice:
        first, last = np.searchsorted(times, [self.start - margin, self.stop + margin], "right")
        return slice(max(0, int(first) - 1), int(last))


def liveliest_part(recording: Recording, longest: float) -> Part:
    """Return the part of a recording in which the sensors turn most while the camera sees the person.

    Args:
        recording: with IMUs, with or without keypoints. longest: s; a shorter recording is taken whole.

    Raises:
        InvalidInputError: `longest` is not positive.
    """
    if not longest > 0:
        raise InvalidInputError(f"seconds: {longest}; study more than 0 of a recording")
    imus, keypoints = recording.imus, recording.keypoints
    assert imus is not None
    times = imus.times if keypoints is None else keypoints.times
    start, stop = float(times[0]), float(times[-1])
    if stop - start <= longest:
        return Part(start, stop, stop - start)
    edges = np.arange(start, stop + _BIN, _BIN)
    movement = _mean(imus.times[:-1], _turn_rates(imus), edges)
    if keypoints is not None:
        movement = movement * _mean(keypoints.times, keypoints.seen.mean(axis=1), edges)
    so_far = np.concatenate([[0.0], np.cumsum(movement)])
    count = min(len(movement), max(1, int(longest / _BIN)))
    best = int(np.argmax(so_far[count:] - so_far[:-count]))
    first = min(float(edges[best]), stop - longest)
    return Part(first, first + longest, stop - start)


def _turn_rates(imus: ImuSequence) -> Array:
    """(T - 1,) rad/s, mean over the sensors; zero where none has samples."""
    R = imus.R_inertial_sensor
    rates = rotations.angle_between(R[:-1], R[1:]) / np.diff(imus.times)[:, None]
    known = np.isfinite(rates)
    total: Array = np.where(known, rates, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return total


def _mean(times: Array, values: Array, edges: Array) -> Array:
    """Mean of values in each interval; zero without any."""
    total = np.histogram(times, edges, weights=values)[0]
    number = np.histogram(times, edges)[0]
    return np.asarray(total / np.maximum(number, 1))
