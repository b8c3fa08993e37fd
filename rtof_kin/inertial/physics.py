"""Checks of sensor streams by physics, and the likely meaning of a file that fails them.

Nothing is changed: a failed check names the change of the declaration under which the same numbers obey the
law. For that the declared conversion is undone and another one applied, for every combination of the relevant
choices; of those that obey, the one with the fewest changes is the likeliest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.core.signals import runs
from rtof_kin.data.imu_stream import CHOICES, Declaration, SensorLog, SensorStream
from rtof_kin.inertial import laws

LAWS: Final = (laws.FORCE, laws.DIRECTION, laws.MEAN_ACCELERATION, laws.LEVER, laws.GYROSCOPE)
"""Names of the checks that fail for a wrong declaration of a unit or of axes."""
SIGNALS: Final = {
    "f_sensor": "acceleration",
    "w_sensor": "gyroscope",
    "m_sensor": "magnetometer",
    "R_inertial_sensor": "orientation",
}
"""Field of `SensorStream` -> what it holds."""
_RATE = 1.0  # [%] deviation of the time stamps' rate from the declared one
_JITTER = 25.0  # [%] 95th percentile of the steps' deviation from their median, without lost samples
_LOST, _MISSING = 5.0, 5.0  # [%] of samples absent, and NaN
_STUCK = 0.5  # [s] without a change of any component
_SATURATED = 0.1  # [%] of samples at the end of the range
_IRON, _DISTURBED = 0.2, 10.0  # [-] deviation of the magnetic field's size, in at most this [%] of samples
_SAMPLES = 600  # spread over the recording, for gravity
_STEPS = 3000  # for turning
_LEAST_FACTOR = 3.0  # between the best declaration's excess and the next one's
_OF_TURNING = ("angular_unit", "quaternion_order", "orientation_maps")


def check_log(log: SensorLog) -> tuple[Check, ...]:
    """Check all sensors of a file, which share one declaration: for each the laws, then clock and channels.
    `Check.likely` of a failed law is the change of the declaration under which all failing sensors obey, if there is a
    single one.
    """
    streams, declared, out = log.streams, log.declaration, list[Check]()
    with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers give infinite figures, which fail
        found = [_laws(stream, declared) for stream in streams]
        wrong = [stream for stream, checks in zip(streams, found, strict=True) if _broken(checks)]
        changes = _likely_changes(wrong, declared) if wrong else []
        for stream, checks in zip(streams, found, strict=True):
            if broken := _broken(checks):
                why, likely = _explanation(stream, declared, broken, changes)
                said = (replace(c, advice=f"{c.advice}. {why}", likely=likely) if c in broken else c for c in checks)
                checks = tuple(said)
            out += [*checks, *_sampling(stream, declared)]
    return tuple(out)


def _laws(stream: SensorStream, declared: Declaration) -> tuple[Check, ...]:
    per_metre = laws.turning_acceleration(stream)
    force, direction, mean, lever = laws.gravity_checks(stream, laws.at_rest(stream), per_metre)
    if declared.gravity == "removed" and direction.passed:  # what `Declaration` put back points up
        why = "gravity was removed, so that no direction of it is left"
        direction = Check.unknown(laws.DIRECTION, stream.name, "deg", why)
    return (force, direction, mean, lever, *laws.turning_checks(stream))


def _broken(checks: Sequence[Check]) -> list[Check]:
    return [check for check in checks if check.failed and check.name in LAWS]


def _explanation(
    stream: SensorStream, declared: Declaration, broken: Sequence[Check], changes: Sequence[Mapping[str, str]]
) -> tuple[str, Mapping[str, Any]]:
    if changes:
        text = "; or with ".join(_declared(change) for change in changes)
        return f"It would hold with {text}", changes[0] if len(changes) == 1 else {}
    fixed, R = laws.fixed_axes(stream), stream.R_inertial_sensor
    if fixed is not None and R is not None:
        R_sensor_oriented, axes = fixed
        turned = replace(stream, R_inertial_sensor=R @ R_sensor_oriented.T)
        mirrored = np.linalg.det(R_sensor_oriented) < 0
        return f"By the gyroscope, {axes}{'' if mirrored else f'; {_then(turned, declared)}'}", {}
    rate_hz = laws.likely_rate(stream)
    if rate_hz is not None and [check.name for check in broken] == [laws.GYROSCOPE]:
        likely = {"rate_hz": round(rate_hz, 1)}
        return f"It would hold with {_declared(likely)}", likely
    return "No other declaration makes it hold", {}


def _then(stream: SensorStream, declared: Declaration) -> str:
    wrong = _broken(_laws(stream, declared))
    if not wrong:
        return "with that rotation gravity points up"
    changes = _likely_changes([stream], declared)
    if len(changes) == 1:
        return f"with that rotation, and {_declared(changes[0])}, gravity points up"
    return f"with that rotation {wrong[0].name} is still off by {wrong[0].value:.3g} {wrong[0].unit}"


def _declared(change: Mapping[str, Any]) -> str:
    return " and ".join(f"{field} = {value}" for field, value in change.items())


def _redeclared(stream: SensorStream, declared: Declaration, other: Declaration) -> SensorStream:
    """Convert a stream as if its file had been declared otherwise."""
    f, R, w = stream.f_sensor, stream.R_inertial_sensor, stream.w_sensor
    new_R = R
    if R is not None and stream.quaternion_norm is not None:
        new_R = other.rotations(declared.filed_quaternions(R))
    elif R is not None:
        new_R = other.upright(declared.filed_rotations(R))
    if f is not None:
        f = other.specific_force(declared.filed_acceleration(f, R), new_R)
    if w is not None:
        w = other.angular_velocity(declared.filed_angular_velocity(w))
    return replace(stream, f_sensor=f, R_inertial_sensor=new_R, w_sensor=w)


def _likely_changes(streams: Sequence[SensorStream], declared: Declaration) -> list[Mapping[str, str]]:
    """Return the smallest changes of a declaration under which most streams obey the laws, the best first.

    Only the best is returned if it is clearly better; none if no change helps.
    """
    cases = [_Case(stream, declared) for stream in streams]
    found: list[tuple[float, Mapping[str, str]]] = []
    for changes in _changes(streams, declared):
        if found and len(changes) > len(found[0][1]):
            break
        other = declared.changed(**changes)
        excess = float(np.median([case.excess(other) for case in cases]))
        if excess <= 1:
            found.append((excess, changes))
    found.sort(key=lambda pair: pair[0])
    if len(found) > 1 and found[1][0] > _LEAST_FACTOR * found[0][0]:
        found = found[:1]
    return [changes for _, changes in found]


def _changes(streams: Sequence[SensorStream], declared: Declaration) -> Iterator[Mapping[str, str]]:
    """Generate all changes of the fields that concern the streams' channels, the fewest first."""
    channels = {name for stream in streams for name in stream.holds}
    fields = []
    if "f_sensor" in channels:
        fields += ["acceleration_unit"]
    if "w_sensor" in channels:
        fields += ["angular_unit"]
    if "R_inertial_sensor" in channels:
        fields += ["orientation_maps", "inertial_axes"]
        fields += ["gravity", "acceleration_axes"] if "f_sensor" in channels else []
        if any(stream.quaternion_norm is not None for stream in streams):
            fields += ["quaternion_order"]
    every = [
        {k: v for k, v in zip(fields, values, strict=True) if v != getattr(declared, k)}
        for values in product(*(CHOICES[field] for field in fields))
    ]
    yield from sorted((changes for changes in every if changes), key=len)


class _Case:
    """One stream and its excess over the laws' limits under any declaration."""

    def __init__(self, stream: SensorStream, declared: Declaration):
        self._declared = declared
        every = max(1, len(stream) // _SAMPLES)
        self._thinned = stream[::every]
        self._rest = laws.at_rest(stream)[::every]
        self._start = replace(stream[:_STEPS], f_sensor=None)
        self._shift = laws.delay(stream)
        self._per_metre = laws.turning_acceleration(stream)
        self._turning = cache(self._turned)

    def excess(self, other: Declaration) -> float:
        """Return the largest figure of a law as a multiple of its limit."""
        excess = self._turning(*(getattr(other, field) for field in _OF_TURNING))
        if excess > 1:
            return excess
        stream = _redeclared(self._thinned, self._declared, other)
        checks = laws.gravity_checks(stream, self._rest, self._per_metre)
        return max(excess, *map(_excess, checks))

    def _turned(self, *values: str) -> float:
        other = self._declared.changed(**dict(zip(_OF_TURNING, values, strict=True)))
        return _excess(laws.gyroscope(_redeclared(self._start, self._declared, other), self._shift))


def _excess(check: Check) -> float:
    return float(np.nan_to_num(check.value / check.limit))


def _sampling(stream: SensorStream, declared: Declaration) -> list[Check]:
    checks = _clock(stream, declared)
    # Channels (T, K); accelerations in the file's own axes, whose range has ends.
    f, R = stream.f_sensor, stream.R_inertial_sensor
    channels = {
        "f_sensor": None if f is None else declared.filed_acceleration(f, R),
        "w_sensor": stream.w_sensor,
        "m_sensor": stream.m_sensor,
        "R_inertial_sensor": None if R is None else R.reshape(len(stream), 9),
    }
    for name, values in ({name: values for name, values in channels.items() if values is not None}).items():
        checks += [_missing(stream, name, values), _stuck(stream, name, values)]
        if name in ("f_sensor", "w_sensor"):
            checks.append(_saturated(stream, name, values))
    if stream.m_sensor is not None:
        checks.append(_disturbed(stream, stream.m_sensor))
    return checks


def _clock(stream: SensorStream, declared: Declaration) -> list[Check]:
    names = ("rate against the declared one", "jitter of time stamps", "samples lost")
    steps = np.diff(stream.times)
    if len(steps) < 2:
        why = f"there are {len(stream)} samples"
        return [Check.unknown(name, stream.name, "%", why) for name in names]
    period = _period(steps)
    periods = np.maximum(np.round(steps / period), 1)
    off = 100 * np.abs(steps / (period * periods) - 1)
    lost = float(np.sum(periods - 1))
    expected = len(stream) + lost
    gap = int(np.argmax(steps))
    uneven = f"Steps of about {1000 * period:.3g} ms are uneven; are these times of arrival, not of sampling?"
    longest = f"the longest gap is {steps[gap]:.3g} s, from {stream.times[gap]:.3f} s"
    rate_hz = float(np.sum(periods) / np.sum(steps))  # the median of rounded stamps would be biased
    rate = Check.unknown(names[0], stream.name, "%", f"none is declared; it is {rate_hz:.4g} Hz")
    if declared.rate_hz is not None:
        off_rate = 100 * abs(rate_hz / declared.rate_hz - 1)
        advice = f"By the time stamps it is {rate_hz:.4g} Hz, {declared.rate_hz:.4g} Hz is declared"
        likely = {"rate_hz": round(rate_hz, 2)} if off_rate > _RATE else {}
        rate = Check(names[0], stream.name, off_rate, _RATE, "%", advice, likely)
    return [
        rate,
        Check(names[1], stream.name, float(np.percentile(off, 95)), _JITTER, "%", uneven),
        Check(
            names[2],
            stream.name,
            100 * lost / expected,
            _LOST,
            "%",
            f"{lost:.0f} of {expected:.0f} are not there; {longest}",
        ),
    ]


def _period(steps: Array) -> float:
    """Return the step without lost samples: the median, or its half or third if that occurs."""
    median = float(np.median(steps))
    for parts in (3, 2):
        if np.mean(np.abs(steps * parts / median - 1) < 0.25) > 0.02:
            return median / parts
    return median


def _missing(stream: SensorStream, name: str, values: Array) -> Check:
    missing = int(np.sum(~np.isfinite(values).all(axis=-1)))
    share = 100 * missing / len(values)
    advice = f"{missing} of {len(values)} are not there"
    return Check(f"missing samples of {SIGNALS[name]}", stream.name, share, _MISSING, "%", advice)


def _stuck(stream: SensorStream, name: str, values: Array) -> Check:
    """Check the longest time without change; a constant component counts as stuck all the time."""
    times = stream.times
    same = values[1:] == values[:-1]
    together = [(times[stop] - times[start], start) for start, stop in runs(same.all(axis=-1))]
    seconds, start = max(together, default=(0.0, 0))
    advice = f"It stays the same to the last digit from {times[start]:.3f} s"
    constant = [axis for axis, stays in zip("xyz", same.all(axis=0), strict=False) if stays]
    if len(values) > 2 and constant and name != "R_inertial_sensor":
        seconds = times[-1] - times[0]
        advice = f"Component {', '.join(constant)} never changes"
    return Check(f"stuck values of {SIGNALS[name]}", stream.name, float(seconds), _STUCK, "s", advice)


def _saturated(stream: SensorStream, name: str, values: Array) -> Check:
    """Check the share of samples in runs of three or more at a component's extreme values."""
    at_end = np.zeros(len(values), dtype=bool)
    for column in values.T:
        known = column[np.isfinite(column)]
        far = 2 * np.std(known) if len(known) else 0.0
        for end in (known.max(), known.min()) if len(known) else ():
            if abs(end - np.median(known)) > far > 0:
                for start, stop in runs(np.abs(column - end) < 1e-9 * np.ptp(known)):
                    at_end[start:stop] |= stop - start >= 3
    share = 100 * float(at_end.mean())
    advice = "The motion was faster than the sensor can measure; set a larger range, or leave these out"
    return Check(f"saturated samples of {SIGNALS[name]}", stream.name, share, _SATURATED, "%", advice)


def _disturbed(stream: SensorStream, m_sensor: Array) -> Check:
    size = np.linalg.norm(m_sensor, axis=-1)
    name = "disturbed magnetic field"
    if not np.isfinite(size).any() or not np.nanmedian(size) > 0:
        return Check.unknown(name, stream.name, "%", "there is no magnetic field")
    size = size[np.isfinite(size)]
    off = np.abs(size / np.median(size) - 1) > _IRON
    share = 100 * float(off.mean())
    advice = f"Its size is off by more than {100 * _IRON:.0f} %: iron is near, headings are unreliable"
    return Check(name, stream.name, share, _DISTURBED, "%", advice)
