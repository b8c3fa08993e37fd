"""Physical laws that every stream of an inertial sensor obeys, each as a `Check`.

- The gyroscope measures the derivative of the orientation. Where it does not, `fixed_axes` and `likely_rate`
  find the constant rotation or the sampling rate under which it does.
- At rest an accelerometer reads 9.81 m/s^2 upwards. In motion the mean of its specific force in inertial
  axes still does, but for the change of velocity over the time.
- A rotating sensor accelerates as on a lever arm of a body's size.

The laws need neither the mounting nor a heading. Limits are from the recordings of docs/real_recordings.md,
with a margin for sprints, jumps and dances.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.signals import runs, vertex
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream

GYROSCOPE: Final = "gyroscope against orientation"
JUMP: Final = "jump of the orientation"
DELAY: Final = "delay of the gyroscope"
UNIT_NORM: Final = "norm of quaternions, less 1"
_TURNING_DEG, _TURNING_SHARE = 5.0, 0.15  # [deg/s], [-] RMS difference; recordings: 1-7 deg/s at 50-170
_JUMP_DEG = 5.0  # [deg] in one step beyond the gyroscope's rotation; recordings have up to 0.5
_LARGEST_DELAY = 1.5  # [samples]; a mean rate since the last sample has 0.5
_FLAT = 0.01  # [-] power about a further axis, relative to the first, that determines a rotation
_NORM = 0.01  # [-] deviation of a quaternion's norm from 1; files round to 4-7 digits
FORCE: Final = "specific force"
DIRECTION: Final = "direction of gravity"
MEAN_ACCELERATION: Final = "mean acceleration"
LEVER: Final = "acceleration against turning"
_STILL = np.radians(10.0)  # [rad/s] at rest; sensors on a standing person have 1-5 deg/s
_STEADY = 0.03  # [-] relative variation of the specific force at rest, without orientation
_SHORTEST_REST = 0.25  # [s]
_ENOUGH_REST = 1.0  # [s] of rest that determines the size of gravity
_ENOUGH_MOTION = 4.0  # [s] over which motion averages out
_AT_REST = 0.5  # [m/s^2] largest deviation at rest; recordings have up to 0.34
_IN_MOTION = 3.5  # [-] largest factor of the median in motion; a sprinter's foot has 2.9
_VELOCITY = 3.0  # [m/s] difference between the ends of a recording
_DIRECTION_DEG = 5.0  # [deg] of the mean specific force from up; recordings have up to 0.8
_MEAN = 0.5  # [m/s^2] mean acceleration; recordings have up to 0.15
_LEVER_ARM, _LEVER_FACTOR = 0.155, 8.0  # [m], [-]; recordings have 0.03-0.4 m, motion capture 0.1-0.8 m
_TURNS_DEG = 20.0  # [deg/s] RMS angular speed that determines a lever arm


def rates_of_orientation(stream: SensorStream) -> tuple[Array, Array]:
    """Differentiate the orientation at the middle of every step: times (T - 1,), s, and w_sensor (T - 1, 3), rad/s, NaN
    across gaps and where orientation is missing; `InvalidInputError` for a sensor without.
    """
    times, R = stream.times, stream.R_inertial_sensor
    if R is None:
        raise InvalidInputError(f"sensor {stream.name} has no orientation to differentiate")
    steps = np.diff(times)
    step_R = np.swapaxes(R[:-1], -1, -2) @ R[1:]
    step_R[steps >= 1.5 / stream.rate_hz] = np.nan
    return times[:-1] + steps / 2, so3.known_log(step_R) / steps[:, None]


def delay(stream: SensorStream) -> float:
    """Return the delay of the gyroscope after the orientation, samples, that maximises the correlation of the two
    angular speeds, independent of axes and units; NaN if unobservable.
    """
    if stream.w_sensor is None or stream.R_inertial_sensor is None or len(stream) < 20:
        return float("nan")
    of_R = _fluctuation(np.linalg.norm(rates_of_orientation(stream)[1], axis=-1))
    speed = np.linalg.norm(stream.w_sensor, axis=-1)
    of_gyroscope = _fluctuation((speed[:-1] + speed[1:]) / 2)
    power = np.linalg.norm(of_R) * np.linalg.norm(of_gyroscope)
    if not power > 0:
        return float("nan")
    correlation = scipy.signal.correlate(of_gyroscope, of_R) / power
    lags = scipy.signal.correlation_lags(len(of_R), len(of_R))
    near = np.abs(lags) <= min(len(stream) // 4, max(stream.rate_hz, 5.0))
    correlation, lags = correlation[near], lags[near]
    best = int(np.argmax(correlation))
    if correlation[best] < 0.5:
        return float("nan")
    three = correlation[max(best - 1, 0) : best + 2]
    return float(lags[best]) + (vertex(*three) if len(three) == 3 else 0.0)


def gyroscope(stream: SensorStream, shift: float | None = None) -> Check:
    """Check the RMS difference of gyroscope and derivative of the orientation; its delay, samples, is estimated if
    None.
    """
    pair = _both_rates(stream, shift)
    if pair is None:
        missing = "gyroscope" if stream.w_sensor is None else "orientation"
        why = "too few samples are known" if missing in stream.holds else f"there is no {missing}"
        return Check.unknown(GYROSCOPE, stream.name, "deg/s", why)
    measured, expected = pair
    speeds = [np.degrees(_trimmed_rms(w)) for w in (measured - expected, measured, expected)]
    residual, of_gyroscope, of_orientation = map(float, speeds)
    limit = float(np.degrees(_limit(expected)))
    if of_orientation < _TURNING_DEG and residual <= limit:
        why = f"the sensor hardly turns ({of_orientation:.1f} deg/s)"
        return Check.unknown(GYROSCOPE, stream.name, "deg/s", why)
    text = f"The gyroscope has {of_gyroscope:.3g} deg/s where orientation has {of_orientation:.3g}"
    return Check(GYROSCOPE, stream.name, residual, limit, "deg/s", text)


def _limit(expected: Array) -> float:
    """Return the largest RMS difference, rad/s, of a gyroscope from expected rates (N, 3), rad/s."""
    return float(np.radians(_TURNING_DEG) + _TURNING_SHARE * _trimmed_rms(expected))


def _trimmed_rms(vectors: Array) -> float:
    """Return the RMS length of vectors (N, 3) without the largest hundredth (settling filters)."""
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
    """Check `gyroscope`, jumps of the orientation, delay of the gyroscope and norm of quaternions."""
    name, shift, norm = stream.name, delay(stream), stream.quaternion_norm
    first, pair = gyroscope(stream, shift), _both_rates(stream, shift)
    jump = Check.unknown(JUMP, name, "deg", "gyroscope and orientation do not agree, or one is missing")
    if first.passed and pair is not None:
        turns = np.degrees(np.linalg.norm(pair[0] - pair[1], axis=-1)) / stream.rate_hz
        text = f"{np.sum(turns > _JUMP_DEG)} of {len(turns)} steps are jumps: was the filter reset, or settling?"
        jump = Check(JUMP, name, float(turns.max()), _JUMP_DEG, "deg", text)
    late = Check.unknown(DELAY, name, "samples", "gyroscope and orientation do not turn together, or one is missing")
    if not np.isnan(shift):
        order = "after" if shift > 0 else "before"
        text = f"It comes {abs(shift / stream.rate_hz) * 1000:.0f} ms {order} the orientation"
        late = Check(DELAY, name, abs(shift), _LARGEST_DELAY, "samples", text)
    unit = Check.unknown(UNIT_NORM, name, "", "there are no quaternions")
    if norm is not None and np.isfinite(norm).any():
        off = np.abs(norm - 1)
        text = f"The worst is sample {np.nanargmax(off)}: these are no orientations, or damaged ones"
        unit = Check(UNIT_NORM, name, float(np.nanmax(off)), _NORM, "", text)
    return first, jump, late, unit


def _described(R_sensor_oriented: Array) -> str:
    nearest = np.round(R_sensor_oriented)
    if np.abs(R_sensor_oriented - nearest).max() < 0.1:
        rows = [(int(np.argmax(np.abs(row))), row) for row in nearest]
        axes = ", ".join(("-" if row[i] < 0 else "") + "xyz"[i] for i, row in rows)
        return f"the gyroscope's x, y, z are {axes} of the orientation's axes"
    if np.linalg.det(R_sensor_oriented) < 0:
        return "the gyroscope's axes are the orientation's, mirrored and turned"
    turn = so3.log(R_sensor_oriented)
    angle, (x, y, z) = np.degrees(np.linalg.norm(turn)), so3.unit(turn)
    constant = f"a constant {angle:.1f} deg about ({x:.2f}, {y:.2f}, {z:.2f})"
    return f"the orientation is of axes turned against the sensor's by {constant}"


def fixed_axes(stream: SensorStream) -> tuple[Array, str] | None:
    """Fit the constant orthogonal matrix (3, 3) from the orientation's rates, in the axes of the file, to the
    gyroscope's (Wahba 1965), and describe it. None for too little data, turning about one axis only, or rates that
    still disagree.
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
    residual = _trimmed_rms(measured - expected @ R.T)
    return (R, _described(R)) if residual <= _limit(expected) else None


def likely_rate(stream: SensorStream) -> float | None:
    """Return the sampling rate, Hz, under which orientation and gyroscope agree, if there is one."""
    pair = _both_rates(stream)
    if pair is None:
        return None
    measured, expected = pair
    scale = float(np.sum(measured * expected) / max(np.sum(expected**2), 1e-12))
    agree = _trimmed_rms(measured - scale * expected) <= _limit(scale * expected)
    return scale * stream.rate_hz if agree and scale > 0 else None


def _fluctuation(values: Array) -> Array:
    """Return values less their mean, 0 where unknown."""
    return np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else 0 * values


def at_rest(stream: SensorStream) -> Mask:
    """Return the mask (T,) of rest, by orientation or else by specific force, independent of units, and of inverted or
    reordered quaternions.
    """
    if stream.R_inertial_sensor is not None:
        slow = np.linalg.norm(rates_of_orientation(stream)[1], axis=-1) < _STILL
        still = np.append(slow, True) & np.append(True, slow)
    elif stream.f_sensor is not None:
        size = np.linalg.norm(stream.f_sensor, axis=-1)
        median = np.median(size[np.isfinite(size)]) if np.isfinite(size).any() else np.nan
        still = np.abs(size - median) < _STEADY * median
    else:
        still = np.zeros(len(stream), dtype=bool)
    rest = np.zeros(len(stream), dtype=bool)
    for start, stop in runs(still):
        rest[start:stop] = stream.times[stop - 1] - stream.times[start] >= _SHORTEST_REST
    return rest


def gravity_checks(stream: SensorStream, rest: Mask, per_metre: float) -> tuple[Check, ...]:
    """Check specific force, direction of gravity, mean acceleration and lever arm by `at_rest` and
    `turning_acceleration`.
    """
    return (_specific_force(stream, rest), *_mean_force(stream, rest), _lever_arm(stream, per_metre))


def turning_acceleration(stream: SensorStream) -> float:
    """Return the 90th percentile of ``|w|^2 + |dw/dt|``, the acceleration per metre of lever arm, 1/s^2; NaN where the
    sensor hardly turns or is too short.
    """
    if stream.R_inertial_sensor is None or len(stream) < 20:
        return float("nan")
    w = rates_of_orientation(stream)[1]
    known = np.isfinite(w).all(axis=-1)
    if known.sum() < 20 or np.degrees(_trimmed_rms(w[known])) < _TURNS_DEG:
        return float("nan")
    change = np.linalg.norm(np.gradient(w, axis=0), axis=-1) * stream.rate_hz
    return float(np.nanpercentile(np.sum(w**2, axis=-1) + change, 90))


def _specific_force(stream: SensorStream, rest: Mask) -> Check:
    if stream.f_sensor is None:
        return Check.unknown(FORCE, stream.name, "m/s2", "there are no accelerations")
    size = np.linalg.norm(stream.f_sensor, axis=-1)
    known = np.isfinite(size)
    seconds = float(np.sum(rest & known)) / stream.rate_hz
    if seconds >= _ENOUGH_REST:
        median = float(np.median(size[rest & known]))
        text = f"Its median is {median:.3g} m/s2 in {seconds:.1f} s at rest"
        return Check(FORCE, stream.name, abs(median - STANDARD_GRAVITY), _AT_REST, "m/s2", text)
    if known.sum() < 10:
        return Check.unknown(FORCE, stream.name, "m/s2", f"there are {known.sum()} accelerations")
    median = float(np.median(size[known]))
    text = f"Its median is {median:.3g} m/s2 in motion, and it is hardly ever at rest"
    return Check(FORCE, stream.name, _factor(median / STANDARD_GRAVITY), _IN_MOTION, "times", text)


def _mean_force(stream: SensorStream, rest: Mask) -> tuple[Check, ...]:
    """Check the mean specific force in inertial axes: its direction, and its size less gravity; over all samples, or of
    a short recording over those at rest.
    """
    f, R, rate, seconds = stream.f_sensor, stream.R_inertial_sensor, stream.rate_hz, 0.0
    if f is not None and R is not None:
        known = np.isfinite(f).all(axis=-1) & np.isfinite(R).all(axis=(-2, -1))
        seconds = float(known.sum()) / rate
        if not seconds >= _ENOUGH_MOTION:
            known &= rest
            seconds = seconds if known.sum() / rate >= _ENOUGH_REST else 0.0
    if f is None or R is None or not seconds:
        why = _missing(stream) or f"there is neither {_ENOUGH_REST:g} s at rest nor {_ENOUGH_MOTION:g} s in all"
        unknown = ((DIRECTION, "deg"), (MEAN_ACCELERATION, "m/s2"))
        return tuple(Check.unknown(name, stream.name, unit, why) for name, unit in unknown)
    force = np.einsum("tij,tj->i", R[known], f[known]) / known.sum()
    slack = np.degrees(_VELOCITY / seconds / STANDARD_GRAVITY)
    x, y, z = force / max(float(np.linalg.norm(force)), 1e-12)
    angle = float(np.degrees(np.arctan2(np.hypot(x, y), z)))
    text = f"The mean specific force points along ({x:.2f}, {y:.2f}, {z:.2f}) of axes with z up"
    excess = float(np.linalg.norm(force + GRAVITY_WORLD))
    reached = f"Over {seconds:.0f} s the sensor would have reached {excess * seconds:.0f} m/s"
    limit = _MEAN + _VELOCITY / seconds
    return (
        Check(DIRECTION, stream.name, angle, _DIRECTION_DEG + slack, "deg", text),
        Check(MEAN_ACCELERATION, stream.name, excess, limit, "m/s2", reached),
    )


def _lever_arm(stream: SensorStream, per_metre: float) -> Check:
    f, R = stream.f_sensor, stream.R_inertial_sensor
    if f is None or R is None or np.isnan(per_metre):
        why = _missing(stream) or "the sensor hardly turns, or is too short"
        return Check.unknown(LEVER, stream.name, "times", why)
    a = np.linalg.norm(np.einsum("tij,tj->ti", R, f) + GRAVITY_WORLD, axis=-1)
    if not np.isfinite(a).any():
        return Check.unknown(LEVER, stream.name, "times", "nothing is known")
    arm = float(np.nanpercentile(a, 90)) / per_metre
    text = f"The two belong to a lever arm of {arm:.2g} m"
    return Check(LEVER, stream.name, _factor(arm / _LEVER_ARM), _LEVER_FACTOR, "times", text)


def _factor(ratio: float) -> float:
    return max(ratio, 1 / ratio) if ratio > 0 else float("inf")


def _missing(stream: SensorStream) -> str:
    channels = {"orientation": stream.R_inertial_sensor, "acceleration": stream.f_sensor}
    return next((f"there is no {name}" for name, values in channels.items() if values is None), "")
