"""Angular velocity of sensors, and the first interval in which none of them rotates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog, SensorStream

Array = NDArray[np.float64]
_STILL_RATE = 0.2  # [rad/s] of a sensor on a person who stands still
_STILL_SECONDS = 1.0  # [s]
_GRID_HZ, _LONGEST_STEP = 50.0, 0.2  # [Hz], [s]
_UNKNOWN_RATE = 100.0  # [rad/s] assumed in gaps


def streams_of(imus: ImuSequence | SensorLog) -> tuple[SensorStream, ...]:
    """Return one stream per sensor.

    Args:
        imus: the sensors.
    """
    if isinstance(imus, SensorLog):
        return imus.streams
    return tuple(
        SensorStream(name, imus.times, imus.f_sensor[:, s], imus.R_inertial_sensor[:, s])
        for s, name in enumerate(imus.names)
    )


def angular_velocity(stream: SensorStream) -> Array:
    """Return w_sensor (T, 3), rad/s, of the gyroscope or else of the orientation.

    Args:
        stream: the sensor.

    Raises:
        InvalidInputError: it has neither, or fewer than two samples.
    """
    if stream.w_sensor is not None:
        return stream.w_sensor
    if stream.R_inertial_sensor is None or len(stream) < 2:
        problem = "no angular velocity and no orientation over time; log one of the two"
        raise InvalidInputError(f"sensor {stream.name}: {problem}")
    return orientation_rate(stream.times, stream.R_inertial_sensor)


def orientation_rate(times: Array, R: Array) -> Array:
    """Differentiate orientations to angular velocity (T, 3), rad/s, in the rotating frame.

    Central differences, ``log(R(t-1)^T R(t+1)) / (t(t+1) - t(t-1))``, one-sided at the ends.

    Args:
        times: (T,) s. R: (T, 3, 3); a rate is NaN where one of its two orientations is.
    """
    last = len(times) - 1
    before, after = np.maximum(np.arange(last + 1) - 1, 0), np.minimum(np.arange(last + 1) + 1, last)
    step = np.swapaxes(R[before], -1, -2) @ R[after]
    known = np.isfinite(step).all(axis=(-2, -1))
    out = np.full((last + 1, 3), np.nan)
    out[known] = so3.log(step[known]) / (times[after] - times[before])[known, None]
    return out


def find_still(streams: Sequence[SensorStream]) -> tuple[float, float]:
    """Find the first interval of at least a second in which the mean rate of the fastest sensor is small.

    Args:
        streams: the sensors, on one clock.

    Returns:
        (start, stop) s.

    Raises:
        CalibrationError: there is none; the message names the stillest moment.
    """
    seconds = _STILL_SECONDS
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
    still = signals.runs(mean < _STILL_RATE)
    if not still:
        best = int(np.argmin(mean))
        restless = streams[int(np.argmax(rates[:, inside][:, best]))].name
        raise CalibrationError(
            f"nobody stands still for {seconds:g} s: even around {centres[best]:.2f} s sensors turn at "
            f"{np.degrees(mean[best]):.0f} deg/s, {restless} most; hold the pose longer, or give its time "
            "with still=(start, stop)"
        )
    first, end = still[0]
    if centres[end - 1] - centres[first] >= seconds:
        return float(centres[first]), float(centres[end - 1])
    stillest = float(centres[first + int(np.argmin(mean[first:end]))])
    return stillest - seconds / 2, stillest + seconds / 2


def _rate(stream: SensorStream, times: Array) -> Array:
    speed = np.linalg.norm(angular_velocity(stream), axis=-1)
    on_grid = signals.interpolate(stream.times, speed, times, max_gap=_LONGEST_STEP)
    return np.minimum(np.nan_to_num(on_grid, nan=_UNKNOWN_RATE), _UNKNOWN_RATE)
