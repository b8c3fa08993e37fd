"""Checks of a sensor stream's rotation: the gyroscope measures the derivative of the orientation.

The law needs neither the mounting of the sensor nor a heading. Where it does not hold, `fixed_axes` and
`likely_rate` find the constant rotation or the sampling rate under which it does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_stream import SensorStream

Array = NDArray[np.float64]
GYROSCOPE: Final = "gyroscope against orientation"
_TURNING_DEG, _TURNING_SHARE = 5.0, 0.15  # [deg/s], [-] RMS difference; recordings: 1-7 deg/s at 50-170
_JUMP_DEG = 5.0  # [deg] in one step beyond the gyroscope's rotation; recordings have up to 0.5
_LARGEST_DELAY = 1.5  # [samples]; a mean rate since the last sample has 0.5
_FLAT = 0.01  # [-] power about a further axis, relative to the first, that determines a rotation
_NORM = 0.01  # [-] deviation of a quaternion's norm from 1; files round to 4-7 digits


def rates_of_orientation(stream: SensorStream) -> tuple[Array, Array]:
    """Differentiate the orientation at the middle of every step.

    Args:
        stream: the sensor.

    Returns:
        Times (T - 1,), s; w_sensor (T - 1, 3), rad/s, NaN across gaps and where orientation is missing.

    Raises:
        InvalidInputError: the sensor has no orientation.
    """
    times, R = stream.times, stream.R_inertial_sensor
    if R is None:
        raise InvalidInputError(f"sensor {stream.name} has no orientation to differentiate")
    steps = np.diff(times)
    step_R = np.swapaxes(R[:-1], -1, -2) @ R[1:]
    known = np.isfinite(step_R).all(axis=(-2, -1)) & (steps < 1.5 / stream.rate_hz)
    w = np.full((len(steps), 3), np.nan)
    w[known] = so3.log(step_R[known]) / steps[known, None]
    return times[:-1] + steps / 2, w


def delay(stream: SensorStream) -> float:
    """Return the delay of the gyroscope after the orientation, samples; NaN if unobservable.

    It maximises the correlation of the two angular speeds, independent of axes and units.

    Args:
        stream: the sensor.
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
    """Check the RMS difference of gyroscope and derivative of the orientation.

    Args:
        stream: the sensor. shift: delay of the gyroscope, samples; estimated if None.
    """
    pair = _both_rates(stream, shift)
    if pair is None:
        missing = "gyroscope" if stream.w_sensor is None else "orientation"
        why = "too few samples are known" if missing in stream.holds else f"there is no {missing}"
        return Check.unknown(GYROSCOPE, stream.name, "deg/s", why)
    measured, expected = pair
    speeds = [np.degrees(trimmed_rms(w)) for w in (measured - expected, measured, expected)]
    residual, of_gyroscope, of_orientation = map(float, speeds)
    limit = float(np.degrees(_limit(expected)))
    if of_orientation < _TURNING_DEG and residual <= limit:
        why = f"the sensor hardly turns ({of_orientation:.1f} deg/s)"
        return Check.unknown(GYROSCOPE, stream.name, "deg/s", why)
    text = f"The gyroscope has {of_gyroscope:.3g} deg/s where orientation has {of_orientation:.3g}"
    return Check(GYROSCOPE, stream.name, residual, limit, "deg/s", text)


def _limit(expected: Array) -> float:
    """Return the largest RMS difference, rad/s, of a gyroscope from expected rates (N, 3), rad/s."""
    return float(np.radians(_TURNING_DEG) + _TURNING_SHARE * trimmed_rms(expected))


def trimmed_rms(vectors: Array) -> float:
    """Return the root mean square length without the largest hundredth (settling filters, bad packets).

    Args:
        vectors: (N, 3), any unit.
    """
    squares = np.sort(np.sum(vectors**2, axis=-1))
    return float(np.sqrt(np.mean(squares[: max(1, int(0.99 * len(squares)))])))


def _both_rates(stream: SensorStream, shift: float | None = None) -> tuple[Array, Array] | None:
    """Return gyroscope and derivative of the orientation (N, 3), rad/s, if ten samples of both are known."""
    if stream.w_sensor is None or stream.R_inertial_sensor is None or len(stream) < 3:
        return None
    shift = delay(stream) if shift is None else shift
    times, expected = rates_of_orientation(stream)
    at = times + (0.0 if np.isnan(shift) else shift) / stream.rate_hz
    measured = np.stack([np.interp(at, stream.times, w, np.nan, np.nan) for w in stream.w_sensor.T], axis=-1)
    known = np.isfinite(measured + expected).all(axis=-1)
    return (measured[known], expected[known]) if known.sum() >= 10 else None


def turning_checks(stream: SensorStream) -> tuple[Check, ...]:
    """Check `gyroscope`, jumps of the orientation, delay of the gyroscope and norm of quaternions.

    Args:
        stream: the sensor.
    """
    shift = delay(stream)
    first = gyroscope(stream, shift)
    return (first, _jumps(stream, shift, first.passed), _delay(stream, shift), _quaternion_norm(stream))


def _jumps(stream: SensorStream, shift: float, agreeing: bool) -> Check:
    """Check the largest rotation between two samples that an agreeing gyroscope does not measure."""
    name, pair = "jump of the orientation", _both_rates(stream, shift) if agreeing else None
    if pair is None:
        why = "gyroscope and orientation do not agree, or one is missing"
        return Check.unknown(name, stream.name, "deg", why)
    turns = np.degrees(np.linalg.norm(pair[0] - pair[1], axis=-1)) / stream.rate_hz
    text = f"{np.sum(turns > _JUMP_DEG)} of {len(turns)} steps are jumps: was the filter reset, or settling?"
    return Check(name, stream.name, float(turns.max()), _JUMP_DEG, "deg", text)


def _delay(stream: SensorStream, shift: float) -> Check:
    name = "delay of the gyroscope"
    if np.isnan(shift):
        why = "gyroscope and orientation do not turn together, or one is missing"
        return Check.unknown(name, stream.name, "samples", why)
    order = "after" if shift > 0 else "before"
    text = f"It comes {abs(shift / stream.rate_hz) * 1000:.0f} ms {order} the orientation"
    return Check(name, stream.name, abs(shift), _LARGEST_DELAY, "samples", text)


def _quaternion_norm(stream: SensorStream) -> Check:
    name, norm = "norm of quaternions, less 1", stream.quaternion_norm
    if norm is None or not np.isfinite(norm).any():
        return Check.unknown(name, stream.name, "", "there are no quaternions")
    off = np.abs(norm - 1)
    text = f"The worst is sample {np.nanargmax(off)}: these are no orientations, or damaged ones"
    return Check(name, stream.name, float(np.nanmax(off)), _NORM, "", text)


@dataclass(frozen=True)
class FixedAxes:
    """A constant change of axes under which the orientation turns as the gyroscope."""

    R_sensor_oriented: Array
    """(3, 3) orthogonal: from the axes of the file's orientation to those of the gyroscope."""

    @property
    def mirrored(self) -> bool:
        """Whether the two differ in handedness."""
        return bool(np.linalg.det(self.R_sensor_oriented) < 0)

    def applied(self, stream: SensorStream) -> SensorStream:
        """Return the stream with the orientation of the gyroscope's axes; not for mirrored axes.

        Args:
            stream: the sensor.
        """
        R = stream.R_inertial_sensor
        return replace(stream, R_inertial_sensor=None if R is None else R @ self.R_sensor_oriented.T)

    def __str__(self) -> str:
        nearest = np.round(self.R_sensor_oriented)
        if np.abs(self.R_sensor_oriented - nearest).max() < 0.1:
            rows = [(int(np.argmax(np.abs(row))), row) for row in nearest]
            axes = ", ".join(("-" if row[i] < 0 else "") + "xyz"[i] for i, row in rows)
            return f"the gyroscope's x, y, z are {axes} of the orientation's axes"
        if self.mirrored:
            return "the gyroscope's axes are the orientation's, mirrored and turned"
        turn = so3.log(self.R_sensor_oriented)
        x, y, z = so3.unit(turn)
        return (
            "the orientation is of axes turned against the sensor's by a constant "
            f"{np.degrees(np.linalg.norm(turn)):.1f} deg about ({x:.2f}, {y:.2f}, {z:.2f})"
        )


def fixed_axes(stream: SensorStream) -> FixedAxes | None:
    """Fit the constant orthogonal matrix from the orientation's rates to the gyroscope's (Wahba 1965).

    Args:
        stream: the sensor.

    Returns:
        None for too little data, turning about fewer than two axes, or rates that still disagree.
    """
    pair = _both_rates(stream)
    if pair is None:
        return None
    measured, expected = pair
    known = np.ones(len(measured), dtype=np.bool_)
    for _ in range(2):  # the second time without the largest residuals
        H = measured[known].T @ expected[known]
        U, size, Vt = np.linalg.svd(H)
        if not size[1] > _FLAT * size[0]:
            return None
        R = U @ Vt if size[2] > _FLAT * size[0] else so3.nearest_rotation(H)
        off = np.linalg.norm(measured - expected @ R.T, axis=-1)
        known = off <= np.quantile(off, 0.95)
    residual = trimmed_rms(measured - expected @ R.T)
    return FixedAxes(R) if residual <= _limit(expected) else None


def likely_rate(stream: SensorStream) -> float | None:
    """Return the sampling rate, Hz, under which orientation and gyroscope agree, if there is one.

    Args:
        stream: the sensor.
    """
    pair = _both_rates(stream)
    if pair is None:
        return None
    measured, expected = pair
    scale = float(np.sum(measured * expected) / max(np.sum(expected**2), 1e-12))
    agree = trimmed_rms(measured - scale * expected) <= _limit(scale * expected)
    return scale * stream.rate_hz if agree and scale > 0 else None


def _fluctuation(values: Array) -> Array:
    """Return values less their mean, 0 where unknown."""
    return np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else 0 * values


def _vertex(three: Array) -> float:
    """Return the vertex of a parabola through three values, from the middle one, in steps."""
    if len(three) < 3 or not (curvature := three[0] - 2 * three[1] + three[2]) < 0:
        return 0.0
    return float((three[0] - three[2]) / (2 * curvature))
