"""When somebody stands still: turning rates of sensors, and the first moment at which none turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import CalibrationError, ShapeError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog, SensorStream

Array = NDArray[np.float64]
STILL_RATE = 0.2
"""A sensor that turns more slowly than this, rad/s, sits on somebody who stands as still as people do."""
STILL_SECONDS = 1.0
"""How long all sensors must be still, s."""
_GRID_HZ, _LONGEST_STEP = 50.0, 0.2
_UNKNOWN_RATE = 100.0


def streams_of(imus: ImuSequence | SensorLog) -> tuple[SensorStream, ...]:
    """One stream per sensor, whichever way the sensors were given."""
    if isinstance(imus, SensorLog):
        return imus.streams
    return tuple(
        SensorStream(name, imus.times, imus.f_sensor[:, s], imus.R_inertial_sensor[:, s])
        for s, name in enumerate(imus.names)
    )


def angular_velocity(stream: SensorStream) -> Array:
    """w_sensor (T, 3), rad/s: the gyroscope's, or where there is none the orientation's rate of change.

    Raises:
        ShapeError: the stream has neither, or fewer than two samples.
    """
    if stream.w_sensor is not None:
        return stream.w_sensor
    if stream.R_inertial_sensor is None or len(stream) < 2:
        raise ShapeError(
            f"sensor {stream.name}: no angular velocity and no orientation over time to have it from; "
            "log one of the two"
        )
    return orientation_rate(stream.times, stream.R_inertial_sensor)


def orientation_rate(times: Array, R: Array) -> Array:
    """Angular velocity (T, 3), rad/s, in the turning frame's own axes, of orientations (T, 3, 3).

    Central differences, ``log(R(t-1)^T R(t+1)) / (t(t+1) - t(t-1))``, one-sided at the two ends; NaN
    where one of the two orientations is.
    """
    last = len(times) - 1
    before, after = np.maximum(np.arange(last + 1) - 1, 0), np.minimum(np.arange(last + 1) + 1, last)
    step = np.swapaxes(R[before], -1, -2) @ R[after]
    known = np.isfinite(step).all(axis=(-2, -1))
    out = np.full((last + 1, 3), np.nan)
    out[known] = so3.log(step[known]) / (times[after] - times[before])[known, None]
    return out


def find_still(streams: Sequence[SensorStream], seconds: float = STILL_SECONDS) -> tuple[float, float]:
    """The first period, at least so many seconds long, in which no sensor turns.

    At every instant the fastest sensor counts; its rate is averaged over so many seconds and compared
    with `STILL_RATE`.

    Returns:
        (start, stop) in s on the streams' clock.

    Raises:
        CalibrationError: there is none; the message says when it was stillest.
    """
    start, stop = max(s.times[0] for s in streams), min(s.times[-1] for s in streams)
    if stop - start < seconds:
        raise CalibrationError(
            f"the sensors have {max(stop - start, 0):.2g} s in common, too short for a pose held for "
            f"{seconds:g} s; record the pose, with all sensors on one clock"
        )
    times = np.arange(start, stop + 1e-9, 1 / _GRID_HZ)
    rates = np.stack([_rate(stream, times) for stream in streams])
    width = min(round(seconds * _GRID_HZ) + 1, len(times))
    inside = slice(width // 2, len(times) - (width - 1) // 2)
    centres, mean = times[inside], uniform_filter1d(rates.max(axis=0), width)[inside]
    still = signals.runs(mean < STILL_RATE)
    if not still:
        best = int(np.argmin(mean))
        restless = streams[int(np.argmax(rates[:, inside][:, best]))].name
        raise CalibrationError(
            f"nobody stands still for {seconds:g} s: even around {centres[best]:.2f} s sensors turn at "
            f"{np.degrees(mean[best]):.0f} deg/s, {restless} most; hold the pose longer, or say when it "
            "is held with still=(start, stop)"
        )
    first, end = still[0]
    if centres[end - 1] - centres[first] >= seconds:
        return float(centres[first]), float(centres[end - 1])
    stillest = float(centres[first + int(np.argmin(mean[first:end]))])
    return stillest - seconds / 2, stillest + seconds / 2


def _rate(stream: SensorStream, times: Array) -> Array:
    """Speed of turning (T,), rad/s, at some times; very fast where it is not known."""
    speed = np.linalg.norm(angular_velocity(stream), axis=-1)
    on_grid = signals.interpolate(stream.times, speed, times, max_gap=_LONGEST_STEP)
    return np.minimum(np.nan_to_num(on_grid, nan=_UNKNOWN_RATE), _UNKNOWN_RATE)
