"""Checks of a sensor's clock and channels: rate, gaps, missing, stuck and saturated values, iron."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.plausibility import Check
from rtof_kin.core.signals import runs
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorStream

Array = NDArray[np.float64]
_WHAT = {
    "f_sensor": "acceleration", "w_sensor": "gyroscope", "m_sensor": "magnetometer",
    "R_inertial_sensor": "orientation",
}  # fmt: skip
_RATE = 1.0  # [%] deviation of the time stamps' rate from the declared one
_JITTER = 25.0  # [%] 95th percentile of the steps' deviation from their median, without lost samples
_LOST, _MISSING = 5.0, 5.0  # [%] of samples absent, and NaN
_STUCK = 0.5  # [s] without a change of any component
_SATURATED = 0.1  # [%] of samples at the end of the range
_IRON, _DISTURBED = 0.2, 10.0  # [-] deviation of the magnetic field's size, in at most this [%] of samples


def check_sampling(stream: SensorStream, declared: Declaration) -> list[Check]:
    """Check the clock and all channels of a sensor.

    Args:
        stream: the sensor. declared: its declaration.
    """
    checks = _clock(stream, declared)
    for name, values in _as_filed(stream, declared).items():
        checks += [_missing(stream, name, values), _stuck(stream, name, values)]
        if name in ("f_sensor", "w_sensor"):
            checks.append(_saturated(stream, name, values))
    if stream.m_sensor is not None:
        checks.append(_disturbed(stream, stream.m_sensor))
    return checks


def _as_filed(stream: SensorStream, declared: Declaration) -> dict[str, Array]:
    """Return the channels (T, K); accelerations in the file's own axes, whose range has ends."""
    f, R = stream.f_sensor, stream.R_inertial_sensor
    channels = {
        "f_sensor": None if f is None else declared.filed_acceleration(f, R),
        "w_sensor": stream.w_sensor,
        "m_sensor": stream.m_sensor,
        "R_inertial_sensor": None if R is None else R.reshape(len(stream), 9),
    }
    return {name: values for name, values in channels.items() if values is not None}


def _clock(stream: SensorStream, declared: Declaration) -> list[Check]:
    """Check rate, jitter and lost samples of the time stamps."""
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
    return [
        _rate(names[0], stream, rate_hz, declared.rate_hz),
        Check(names[1], stream.name, float(np.percentile(off, 95)), _JITTER, "%", uneven),
        Check(names[2], stream.name, 100 * lost / expected, _LOST, "%",
              f"{lost:.0f} of {expected:.0f} are not there; {longest}"),
    ]  # fmt: skip


def _rate(name: str, stream: SensorStream, rate_hz: float, declared_hz: float | None) -> Check:
    if declared_hz is None:
        return Check.unknown(name, stream.name, "%", f"none is declared; it is {rate_hz:.4g} Hz")
    off = 100 * abs(rate_hz / declared_hz - 1)
    advice = f"By the time stamps it is {rate_hz:.4g} Hz, {declared_hz:.4g} Hz is declared"
    likely = {"rate_hz": round(rate_hz, 2)} if off > _RATE else {}
    return Check(name, stream.name, off, _RATE, "%", advice, likely)


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
    return Check(f"missing samples of {_WHAT[name]}", stream.name, share, _MISSING, "%", advice)


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
    return Check(f"stuck values of {_WHAT[name]}", stream.name, float(seconds), _STUCK, "s", advice)


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
    return Check(f"saturated samples of {_WHAT[name]}", stream.name, share, _SATURATED, "%", advice)


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
