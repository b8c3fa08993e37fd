"""Checks of a sensor stream against gravity and inertia; each law gives one `Check`.

At rest an accelerometer reads 9.81 m/s^2 upwards. In motion the mean of its specific force in inertial axes
still does, but for the change of velocity over the time. A rotating sensor accelerates as on a lever arm of
a body's size. The laws need neither the mounting nor a heading. Limits are from the recordings of
docs/real_recordings.md, with a margin for sprints, jumps and dances.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.plausibility import Check
from rtof_kin.core.signals import runs
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.turning import rates_of_orientation, trimmed_rms

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
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


def at_rest(stream: SensorStream) -> Mask:
    """Return the mask (T,) of rest, by orientation or else by specific force.

    Both are independent of units, and of inverted or reordered quaternions.

    Args:
        stream: the sensor.
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
    """Check specific force, direction of gravity, mean acceleration and lever arm.

    Args:
        stream: the sensor. rest: (T,) from `at_rest`. per_metre: its `turning_acceleration`, 1/s^2.
    """
    return (_specific_force(stream, rest), *_mean_force(stream, rest), _lever_arm(stream, per_metre))


def turning_acceleration(stream: SensorStream) -> float:
    """Return the 90th percentile of ``|w|^2 + |dw/dt|``, the acceleration per metre of lever arm, 1/s^2.

    Args:
        stream: the sensor; NaN if it hardly turns or is too short.
    """
    if stream.R_inertial_sensor is None or len(stream) < 20:
        return float("nan")
    w = rates_of_orientation(stream)[1]
    known = np.isfinite(w).all(axis=-1)
    if known.sum() < 20 or np.degrees(trimmed_rms(w[known])) < _TURNS_DEG:
        return float("nan")
    change = np.linalg.norm(np.gradient(w, axis=0), axis=-1) * stream.rate_hz
    return float(np.nanpercentile(np.sum(w**2, axis=-1) + change, 90))


def _specific_force(stream: SensorStream, rest: Mask) -> Check:
    """Check the deviation of the specific force at rest, or else the factor of its median in motion."""
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
    """Check the mean specific force in inertial axes: its direction, and its size less gravity."""
    mean = _mean_in_inertial(stream, rest)
    if mean is None:
        why = (
            _missing(stream) or f"there is neither {_ENOUGH_REST:g} s at rest nor {_ENOUGH_MOTION:g} s in all"
        )
        unknown = ((DIRECTION, "deg"), (MEAN_ACCELERATION, "m/s2"))
        return tuple(Check.unknown(name, stream.name, unit, why) for name, unit in unknown)
    force, seconds = mean
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
    """Check the factor between the lever arm of acceleration and rotation and a body's."""
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


def _mean_in_inertial(stream: SensorStream, rest: Mask) -> tuple[Array, float] | None:
    """Return the mean specific force in inertial axes (3,) and its duration, s, if long enough."""
    f, R = stream.f_sensor, stream.R_inertial_sensor
    if f is None or R is None:
        return None
    known = np.isfinite(f).all(axis=-1) & np.isfinite(R).all(axis=(-2, -1))
    seconds = float(known.sum()) / stream.rate_hz
    if not seconds >= _ENOUGH_MOTION:
        known &= rest
        if not known.sum() / stream.rate_hz >= _ENOUGH_REST:
            return None
    return np.einsum("tij,tj->i", R[known], f[known]) / known.sum(), seconds


def _factor(ratio: float) -> float:
    return max(ratio, 1 / ratio) if ratio > 0 else float("inf")


def _missing(stream: SensorStream) -> str:
    if stream.R_inertial_sensor is None:
        return "there is no orientation"
    return "there is no acceleration" if stream.f_sensor is None else ""
