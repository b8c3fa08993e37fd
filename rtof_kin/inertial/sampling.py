"""Checks of a sensor's clock and channels: rate, gaps, missing, stuck and saturated values, iron."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.plausibility import Check
from rtof_kin.core.signals import runs
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorStream

Array = NDArray[np.float64]
WHAT = {
    "f_sensor": "acceleration", "w_sensor": "gyroscope", "m_sensor": "magnetometer",
    "R_inertial_sensor": "orientation",
}  # fmt: skip
RATE = 1.0
"""Largest distance of the time stamps' rate from the one declared, %."""
JITTER = 25.0
"""Largest distance of 95 % of the steps from their median, %, steps across lost samples left out."""
LOST, MISSING = 5.0, 5.0
"""Largest share of samples that are not there, and that are NaN, %."""
STUCK = 0.5
"""Longest time, s, in which no component of a quantity changes."""
SATURATED = 0.1
"""Largest share of samples at the end of the range, %."""
IRON, DISTURBED = 0.2, 10.0
"""The magnetic field is disturbed where its size is off by this share; so at most in this %."""


def check_sampling(stream: SensorStream, declared: Declaration) -> list[Check]:
    """All checks of this module on one sensor."""
    checks = _clock(stream, declared)
    for name, values in _as_filed(stream, declared).items():
        checks += [_missing(stream, name, values), _stuck(stream, name, values)]
        if name in ("f_sensor", "w_sensor"):
            checks.append(_saturated(stream, name, values))
    if stream.m_sensor is not None:
        checks.append(_disturbed(stream, stream.m_sensor))
    return checks


def _as_filed(stream: SensorStream, declared: Declaration) -> dict[str, Array]:
    """Its quantities (T, K) as the file has them: ends of a range are of the file's own axes."""
    T, f, R = len(stream), stream.f_sensor, stream.R_inertial_sensor
    out = {}
    if f is not None:
        out["f_sensor"] = declared.filed_acceleration(f, R)
    if stream.w_sensor is not None:
        out["w_sensor"] = stream.w_sensor
    if stream.m_sensor is not None:
        out["m_sensor"] = stream.m_sensor
    if R is not None:
        out["R_inertial_sensor"] = R.reshape(T, 9)
    return out


def _clock(stream: SensorStream, declared: Declaration) -> list[Check]:
    """Rate, jitter and lost samples by the time stamps."""
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
    uneven = (
        f"Steps of about {1000 * period:.3g} ms are uneven; were the times of arrival logged, not those "
        "of sampling?"
    )
    longest = f"the longest gap is {steps[gap]:.3g} s, from {stream.times[gap]:.3f} s"
    # The mean: stamps in whole milliseconds have no better median.
    rate_hz = float(np.sum(periods) / np.sum(steps))
    return [
        _rate(names[0], stream, rate_hz, declared.rate_hz),
        Check(names[1], stream.name, float(np.percentile(off, 95)), JITTER, "%", uneven),
        Check(names[2], stream.name, 100 * lost / expected, LOST, "%",
              f"{lost:.0f} of {expected:.0f} are not there; {longest}"),
    ]  # fmt: skip


def _rate(name: str, stream: SensorStream, rate_hz: float, declared_hz: float | None) -> Check:
    if declared_hz is None:
        why = f"none is declared; it is {rate_hz:.4g} Hz"
        return Check.unknown(name, stream.name, "%", why)
    off = 100 * abs(rate_hz / declared_hz - 1)
    advice = f"By the time stamps it is {rate_hz:.4g} Hz, {declared_hz:.4g} Hz is declared"
    likely = {"rate_hz": round(rate_hz, 2)} if off > RATE else {}
    return Check(name, stream.name, off, RATE, "%", advice, likely)


def _period(steps: Array) -> float:
    """The step between samples none of which was lost: the median one, or where many were lost, that
    half or third of it that does occur.
    """
    median = float(np.median(steps))
    for parts in (3, 2):
        if np.mean(np.abs(steps * parts / median - 1) < 0.25) > 0.02:
            return median / parts
    return median


def _missing(stream: SensorStream, name: str, values: Array) -> Check:
    missing = int(np.sum(~np.isfinite(values).all(axis=-1)))
    share = 100 * missing / len(values)
    advice = f"{missing} of {len(values)} are not there"
    return Check(f"missing samples of {WHAT[name]}", stream.name, share, MISSING, "%", advice)


def _stuck(stream: SensorStream, name: str, values: Array) -> Check:
    """The longest time in which a quantity stays the same to the last digit; of one with a component
    that never changes, all the time.
    """
    times = stream.times
    same = values[1:] == values[:-1]
    together = [(times[stop] - times[start], start) for start, stop in runs(same.all(axis=-1))]
    seconds, start = max(together, default=(0.0, 0))
    advice = f"It stays the same to the last digit from {times[start]:.3f} s"
    constant = [axis for axis, stays in zip("xyz", same.all(axis=0), strict=False) if stays]
    if len(values) > 2 and constant and name != "R_inertial_sensor":
        seconds = times[-1] - times[0]
        advice = f"Component {', '.join(constant)} never changes"
    return Check(f"stuck values of {WHAT[name]}", stream.name, float(seconds), STUCK, "s", advice)


def _saturated(stream: SensorStream, name: str, values: Array) -> Check:
    """Samples that stay, three or more, at the largest or smallest value a component has."""
    at_end = np.zeros(len(values), dtype=bool)
    for column in values.T:
        known = column[np.isfinite(column)]
        if len(known) == 0:
            continue
        far = 2 * np.std(known)
        for end in (known.max(), known.min()):
            if abs(end - np.median(known)) > far > 0:
                for start, stop in runs(np.abs(column - end) < 1e-9 * np.ptp(known)):
                    at_end[start:stop] |= stop - start >= 3
    share = 100 * float(at_end.mean())
    advice = "The motion was faster than the sensor can measure; set a larger range, or leave these out"
    return Check(f"saturated samples of {WHAT[name]}", stream.name, share, SATURATED, "%", advice)


def _disturbed(stream: SensorStream, m_sensor: Array) -> Check:
    size = np.linalg.norm(m_sensor, axis=-1)
    name = "disturbed magnetic field"
    if not np.isfinite(size).any() or not np.nanmedian(size) > 0:
        return Check.unknown(name, stream.name, "%", "there is no magnetic field")
    size = size[np.isfinite(size)]
    off = np.abs(size / np.median(size) - 1) > IRON
    share = 100 * float(off.mean())
    advice = f"Its size is off by more than {100 * IRON:.0f} %: iron is near, do not trust headings"
    return Check(name, stream.name, share, DISTURBED, "%", advice)
