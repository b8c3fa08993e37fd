"""What turning says of a stream, whatever its file says: the gyroscope reads the derivative of the
orientation. Neither has to be where it was meant to be, nor to know a heading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import ShapeError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_stream import SensorStream

Array = NDArray[np.float64]
GYROSCOPE = "gyroscope against orientation"
TURNING_DEG, TURNING_SHARE = 5.0, 0.15
"""Largest difference of gyroscope and derivative: so many deg/s and such a share of the rate (root mean
squares); recordings at hand have 1-7 deg/s at 50-170."""
JUMP_DEG = 5.0
"""Largest turn from one sample to the next that the gyroscope does not have; recordings at hand have up
to 0.5."""
DELAY = 1.5
"""Largest delay between the two, samples; half a sample is the mean rate since the last one."""
NORM = 0.01
"""Largest distance of a quaternion's norm from 1; files round to 4-7 digits."""


def rates_of_orientation(stream: SensorStream) -> tuple[Array, Array]:
    """Angular velocity in sensor axes from the orientation, at the middle of every step.

    Returns:
        Times (T - 1,), s; rates (T - 1, 3), rad/s, NaN across gaps and where orientation is missing.

    Raises:
        ShapeError: the sensor has no orientation.
    """
    times, R = stream.times, stream.R_inertial_sensor
    if R is None:
        raise ShapeError(f"sensor {stream.name} has no orientation to differentiate")
    steps = np.diff(times)
    step_R = np.swapaxes(R[:-1], -1, -2) @ R[1:]
    known = np.isfinite(step_R).all(axis=(-2, -1)) & (steps < 1.5 / stream.rate_hz)
    w = np.full((len(steps), 3), np.nan)
    w[known] = so3.log(step_R[known]) / steps[known, None]
    return times[:-1] + steps / 2, w


def delay(stream: SensorStream) -> float:
    """By how many samples the gyroscope comes after the orientation; NaN where it cannot be told.

    By the correlation of the two speeds, which knows neither axes nor units. A rate that is the mean
    since the last sample comes half a sample late.
    """
    if stream.w_sensor is None or stream.R_inertial_sensor is None or len(stream) < 20:
        return float("nan")
    of_R = _fluctuation(np.linalg.norm(rates_of_orientation(stream)[1], axis=-1))
    speed = np.linalg.norm(stream.w_sensor, axis=-1)
    of_gyroscope = _fluctuation((speed[:-1] + speed[1:]) / 2)
    power = np.linalg.norm(of_R) * np.linalg.norm(of_gyroscope)
    if not power > 0:
        return float("nan")
    correlation = signal.correlate(of_gyroscope, of_R) / power
    lags = signal.correlation_lags(len(of_R), len(of_R))
    near = np.abs(lags) <= min(len(stream) // 4, max(stream.rate_hz, 5.0))
    correlation, lags = correlation[near], lags[near]
    best = int(np.argmax(correlation))
    if correlation[best] < 0.5:
        return float("nan")
    return float(lags[best]) + _vertex(correlation[max(best - 1, 0) : best + 2])


def gyroscope(stream: SensorStream, shift: float | None = None) -> Check:
    """Difference of gyroscope and the orientation's derivative, root mean square.

    Args:
        stream: the sensor.
        shift: samples that the gyroscope comes late; `delay` where not given.
    """
    name = GYROSCOPE
    pair = both_rates(stream, shift)
    if pair is None:
        missing = "gyroscope" if stream.w_sensor is None else "orientation"
        why = "too few samples are known" if missing in stream.holds else f"there is no {missing}"
        return Check.unknown(name, stream.name, "deg/s", why)
    measured, expected = pair
    speeds = [np.degrees(trimmed_rms(w)) for w in (measured - expected, measured, expected)]
    residual, of_gyroscope, of_orientation = map(float, speeds)
    limit = float(np.degrees(turning_limit(expected)))
    if of_orientation < TURNING_DEG and residual <= limit:
        why = f"the sensor hardly turns ({of_orientation:.1f} deg/s)"
        return Check.unknown(name, stream.name, "deg/s", why)
    text = f"The gyroscope has {of_gyroscope:.3g} deg/s where orientation has {of_orientation:.3g}"
    return Check(name, stream.name, residual, limit, "deg/s", text)


def turning_limit(expected: Array) -> float:
    """Largest difference of the gyroscope from these rates (N, 3), trimmed root mean square, rad/s."""
    return float(np.radians(TURNING_DEG) + TURNING_SHARE * trimmed_rms(expected))


def trimmed_rms(vectors: Array) -> float:
    """Root mean square of the size of vectors (N, 3), the largest hundredth left out: a filter that is
    still settling, a packet that came damaged.
    """
    squares = np.sort(np.sum(vectors**2, axis=-1))
    return float(np.sqrt(np.mean(squares[: max(1, int(0.99 * len(squares)))])))


def both_rates(stream: SensorStream, shift: float | None = None) -> tuple[Array, Array] | None:
    """Gyroscope and the orientation's derivative (N, 3), rad/s, where both are known; None of too few."""
    if stream.w_sensor is None or stream.R_inertial_sensor is None or len(stream) < 3:
        return None
    shift = delay(stream) if shift is None else shift
    times, expected = rates_of_orientation(stream)
    at = times + (0.0 if np.isnan(shift) else shift) / stream.rate_hz
    measured = np.stack([np.interp(at, stream.times, w, np.nan, np.nan) for w in stream.w_sensor.T], axis=-1)
    known = np.isfinite(measured + expected).all(axis=-1)
    return (measured[known], expected[known]) if known.sum() >= 10 else None


def jumps(stream: SensorStream, agreeing: bool) -> Check:
    """The largest turn between two samples that the gyroscope does not have.

    Args:
        stream: the sensor.
        agreeing: whether gyroscope and orientation agree as a whole; else it tells nothing.
    """
    name, pair = "jump of the orientation", both_rates(stream) if agreeing else None
    if pair is None:
        why = "gyroscope and orientation do not agree, or one is missing"
        return Check.unknown(name, stream.name, "deg", why)
    turns = np.degrees(np.linalg.norm(pair[0] - pair[1], axis=-1)) / stream.rate_hz
    count = int(np.sum(turns > JUMP_DEG))
    text = f"{count} of {len(turns)} steps are jumps: was the filter reset, or settling?"
    return Check(name, stream.name, float(turns.max()), JUMP_DEG, "deg", text)


def gyroscope_delay(stream: SensorStream) -> Check:
    """Size of `delay`."""
    shift, name = delay(stream), "delay of the gyroscope"
    if np.isnan(shift):
        why = "gyroscope and orientation do not turn together, or one is missing"
        return Check.unknown(name, stream.name, "samples", why)
    order = "after" if shift > 0 else "before"
    text = f"It comes {abs(shift / stream.rate_hz) * 1000:.0f} ms {order} the orientation"
    return Check(name, stream.name, abs(shift), DELAY, "samples", text)


def quaternion_norm(stream: SensorStream) -> Check:
    """Largest distance of a quaternion's norm from 1."""
    name, norm = "norm of quaternions, less 1", stream.quaternion_norm
    if norm is None or not np.isfinite(norm).any():
        return Check.unknown(name, stream.name, "", "there are no quaternions")
    off = np.abs(norm - 1)
    text = f"The worst is sample {np.nanargmax(off)}: these are no orientations, or damaged ones"
    return Check(name, stream.name, float(np.nanmax(off)), NORM, "", text)


def _fluctuation(values: Array) -> Array:
    """Values less their mean, 0 where unknown."""
    return np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else 0 * values


def _vertex(three: Array) -> float:
    """Where a parabola through three values has its vertex, from the middle one, in steps."""
    if len(three) < 3 or not (curvature := three[0] - 2 * three[1] + three[2]) < 0:
        return 0.0
    return float((three[0] - three[2]) / (2 * curvature))
