"""What gravity and inertia say of a stream, whatever its file says; each law gives one `Check`.

At rest an accelerometer reads 9.81 m/s^2 upwards. In motion the mean of its specific force in inertial
axes still does, but for the change of velocity over the time: a person does not fly off. What turns
accelerates as if on a lever arm of a body's size. None of it needs to know where the sensor is, nor a
heading.

Limits are from all recordings at hand (docs/real_recordings.md), and wide enough for sprints, jumps and
dances of motion capture with simulated sensors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.plausibility import Check
from rtof_kin.core.signals import runs
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.turning import rates_of_orientation, trimmed_rms

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
FORCE, DIRECTION, MEAN_ACCELERATION = "specific force", "direction of gravity", "mean acceleration"
LEVER = "acceleration against turning"
STILL = np.radians(10.0)
"""A sensor that turns slower, rad/s, is at rest; on a standing person it turns by 1-5 deg/s."""
STEADY = 0.03
"""Share of its size by which the specific force may vary at rest, where orientation is not known."""
SHORTEST_REST = 0.25
"""A rest is at least so long, s."""
ENOUGH_REST = 1.0
"""So much of it, s, tells the size of gravity."""
SHORTEST_MOTION = 4.0
"""In so much time, s, motion averages out."""
AT_REST = 0.5
"""Largest distance of the specific force at rest from 9.81 m/s^2: the recordings at hand have up to 0.34,
4 % less is sold as well."""
IN_MOTION = 3.5
"""Its median in motion may be so many times larger or smaller; a sprinter's foot has 2.9."""
VELOCITY = 3.0
"""By so much, m/s, a limb's velocity may differ between the ends of a recording."""
DIRECTION_DEG, MEAN = 5.0, 0.5
"""Largest angle of the mean specific force from up; largest mean of the acceleration, m/s^2; both of a
recording that is long. Recordings at hand have up to 0.8 deg and 0.15 m/s^2."""
LEVER_ARM, LEVER_FACTOR = 0.155, 8.0
"""The lever arm of a sensor on a body, m, and how many times it may be longer or shorter: recordings at
hand have 0.03-0.4 m, motion capture 0.1-0.8 m."""
TURNS_DEG = 20.0
"""A sensor that turns by so many deg/s (root mean square) has accelerations to show for it."""


def at_rest(stream: SensorStream) -> Mask:
    """(T,) whether the sensor is at rest: by its orientation, else by its specific force.

    Both tell the same of numbers in another unit, of inverted orientations and of quaternions in another
    order, so rests are known before the declaration is.
    """
    if stream.R_inertial_sensor is not None:
        speed = np.linalg.norm(rates_of_orientation(stream)[1], axis=-1)
        slow = speed < STILL
        still = np.append(slow, True) & np.append(True, slow)
    elif stream.f_sensor is not None:
        size = np.linalg.norm(stream.f_sensor, axis=-1)
        median = np.median(size[np.isfinite(size)]) if np.isfinite(size).any() else np.nan
        still = np.abs(size - median) < STEADY * median
    else:
        still = np.zeros(len(stream), dtype=bool)
    rest = np.zeros(len(stream), dtype=bool)
    for start, stop in runs(still):
        rest[start:stop] = stream.times[stop - 1] - stream.times[start] >= SHORTEST_REST
    return rest


def specific_force(stream: SensorStream, rest: Mask) -> Check:
    """Its size at rest, less 9.81 m/s^2; where there is no rest, how many times its median in motion is
    larger or smaller.
    """
    if stream.f_sensor is None:
        return Check.unknown(FORCE, stream.name, "m/s2", "there are no accelerations")
    size = np.linalg.norm(stream.f_sensor, axis=-1)
    known = np.isfinite(size)
    seconds = float(np.sum(rest & known)) / stream.rate_hz
    if seconds >= ENOUGH_REST:
        median = float(np.median(size[rest & known]))
        text = f"Its median is {median:.3g} m/s2 in {seconds:.1f} s at rest"
        return Check(FORCE, stream.name, abs(median - STANDARD_GRAVITY), AT_REST, "m/s2", text)
    if known.sum() < 10:
        why = f"there are {known.sum()} accelerations"
        return Check.unknown(FORCE, stream.name, "m/s2", why)
    median = float(np.median(size[known]))
    text = f"Its median is {median:.3g} m/s2 in motion, and it is hardly ever at rest"
    return Check(FORCE, stream.name, _factor(median / STANDARD_GRAVITY), IN_MOTION, "times", text)


def mean_in_inertial(stream: SensorStream, rest: Mask) -> tuple[Array, float] | None:
    """The mean specific force in inertial axes (3,), and over how many seconds; None of too few."""
    f, R = stream.f_sensor, stream.R_inertial_sensor
    if f is None or R is None:
        return None
    known = np.isfinite(f).all(axis=-1) & np.isfinite(R).all(axis=(-2, -1))
    seconds = float(known.sum()) / stream.rate_hz
    if not seconds >= SHORTEST_MOTION:
        known &= rest
        if not known.sum() / stream.rate_hz >= ENOUGH_REST:
            return None
    return np.einsum("tij,tj->i", R[known], f[known]) / known.sum(), seconds


def gravity_direction(stream: SensorStream, rest: Mask) -> Check:
    """Angle of the mean specific force in inertial axes from up."""
    name, mean = DIRECTION, mean_in_inertial(stream, rest)
    if mean is None:
        return Check.unknown(name, stream.name, "deg", _no_mean(stream))
    force, seconds = mean
    size = float(np.linalg.norm(force))
    slack = np.degrees(VELOCITY / seconds / STANDARD_GRAVITY)
    x, y, z = force / max(size, 1e-12)
    angle = float(np.degrees(np.arctan2(np.hypot(x, y), z)))
    text = f"The mean specific force points along ({x:.2f}, {y:.2f}, {z:.2f}) of axes with z up"
    return Check(name, stream.name, angle, DIRECTION_DEG + slack, "deg", text)


def mean_acceleration(stream: SensorStream, rest: Mask) -> Check:
    """Size of the mean acceleration in inertial axes, gravity taken off."""
    name, mean = MEAN_ACCELERATION, mean_in_inertial(stream, rest)
    if mean is None:
        return Check.unknown(name, stream.name, "m/s2", _no_mean(stream))
    force, seconds = mean
    size = float(np.linalg.norm(force + GRAVITY_WORLD))
    text = f"Over {seconds:.0f} s the sensor would have reached {size * seconds:.0f} m/s"
    return Check(name, stream.name, size, MEAN + VELOCITY / seconds, "m/s2", text)


def turning_acceleration(stream: SensorStream) -> float:
    """Acceleration that the turning makes per metre of lever arm, ``|w|^2 + |dw/dt|`` (its 90th
    percentile), 1/s^2; NaN of a sensor that hardly turns or is too short.
    """
    if stream.R_inertial_sensor is None or len(stream) < 20:
        return float("nan")
    w = rates_of_orientation(stream)[1]
    known = np.isfinite(w).all(axis=-1)
    if known.sum() < 20 or np.degrees(trimmed_rms(w[known])) < TURNS_DEG:
        return float("nan")
    change = np.linalg.norm(np.gradient(w, axis=0), axis=-1) * stream.rate_hz
    return float(np.nanpercentile(np.sum(w**2, axis=-1) + change, 90))


def lever_arm(stream: SensorStream, per_metre: float) -> Check:
    """How many times the lever arm of accelerations and turning is longer or shorter than a body's.

    Args:
        stream: the sensor.
        per_metre: its `turning_acceleration`.
    """
    f, R = stream.f_sensor, stream.R_inertial_sensor
    if f is None or R is None or np.isnan(per_metre):
        given = f is not None and R is not None
        why = "the sensor hardly turns, or is too short" if given else _no_mean(stream)
        return Check.unknown(LEVER, stream.name, "times", why)
    a = np.linalg.norm(np.einsum("tij,tj->ti", R, f) + GRAVITY_WORLD, axis=-1)
    if not np.isfinite(a).any():
        return Check.unknown(LEVER, stream.name, "times", "nothing is known")
    arm = float(np.nanpercentile(a, 90)) / per_metre
    text = f"The two belong to a lever arm of {arm:.2g} m"
    return Check(LEVER, stream.name, _factor(arm / LEVER_ARM), LEVER_FACTOR, "times", text)


def _factor(ratio: float) -> float:
    """By how many times something is larger or smaller."""
    return max(ratio, 1 / ratio) if ratio > 0 else float("inf")


def _no_mean(stream: SensorStream) -> str:
    if stream.R_inertial_sensor is None or stream.f_sensor is None:
        return f"there is no {'orientation' if stream.R_inertial_sensor is None else 'acceleration'}"
    return f"there is neither {ENOUGH_REST:g} s at rest nor {SHORTEST_MOTION:g} s in all"
