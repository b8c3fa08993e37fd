"""Range of motion and angular velocity of clinical angles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

CUTOFF_HZ: Final = 6.0  # low-pass before differentiation (Winter, Biomechanics and Motor Control, 2009)


@dataclass(frozen=True)
class RangeOfMotion:
    """Range of one angle over a recording, radians and seconds, NaN without a usable value.

    Singular postures and unreliable values are excluded.
    """

    name: str
    low: float
    high: float
    mean: float
    time_low: float
    time_high: float
    peak_velocity: float
    """[rad/s] largest absolute angular velocity."""
    known_share: float
    """Share of the frames in which the angle is observed."""
    singular_share: float
    """Share of those near a singular posture; NaN for none."""
    trusted_share: float = 1.0
    """Share of those with a reliable value (`angle_confidence`); NaN for none."""
    low_sigma: float = float("nan")
    """[rad] standard deviation of `low`; NaN if the motion has no confidence."""
    high_sigma: float = float("nan")
    """[rad] standard deviation of `high`; NaN if the motion has no confidence."""
    range_sigma: float = float("nan")
    """[rad] standard deviation of `range` (`range_deviation`); NaN if the motion has no confidence."""
    about_vertical: bool = False
    """Whether the angle is a heading (see `Travel`) and its range no range of motion."""

    @property
    def range(self) -> float:
        """High minus low."""
        return self.high - self.low


def range_deviation(low_sigma: float, high_sigma: float) -> float:
    """Return the standard deviation of a range, rad.

    The errors of its two ends count as independent. A constant bias cancels in a range, and errors are
    correlated over time, which makes this too large; the extremum of a noisy curve lies outward, which makes
    it too small. ``python -m benchmarks.range_bands`` measures the balance.

    Args:
        low_sigma, high_sigma: standard deviations of the two ends, rad.
    """
    return float(np.hypot(low_sigma, high_sigma))


def angular_velocity(angles: ClinicalAngles) -> Array:
    """Return time derivatives (T, A) of clinical angles, rad/s; NaN where singular, unknown or unreliable.

    Args:
        angles: to smooth and differentiate; single frames between gaps have no velocity.
    """
    rate_hz = angles.rate_hz
    columns = [_velocity(angles, column, rate_hz) for column in range(len(angles.rows))]
    return np.stack(columns, axis=1)


def _velocity(angles: ClinicalAngles, column: int, rate_hz: float) -> Array:
    """(T,) time derivative of one angle, rad/s."""
    values, out = _usable(angles, column), np.full(len(angles), np.nan)
    for start, stop in signals.runs(np.isfinite(values)):
        if stop - start > 1:
            stretch = smoothed(values[start:stop], rate_hz, CUTOFF_HZ)
            out[start:stop] = np.gradient(stretch, angles.times[start:stop])
    return out


def _usable(angles: ClinicalAngles, column: int) -> Array:
    """(T,) rad of one angle; NaN where it is singular, unknown or unreliable."""
    return np.where(angles.singular[:, column], np.nan, angles.trusted_angle(column))


def smoothed(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Low-pass values; unchanged if the rate is too low or the stretch too short.

    Args:
        values: (T, ...). rate_hz: sampling rate, Hz. cutoff_hz: -3 dB frequency, Hz.
    """
    if cutoff_hz >= 0.45 * rate_hz or len(values) < rate_hz / cutoff_hz:
        return values
    return signals.low_pass(values, rate_hz, cutoff_hz)


def ranges_of_motion(angles: ClinicalAngles) -> tuple[RangeOfMotion, ...]:
    """Return the range of motion of each angle, in their order.

    Args:
        angles: over time.
    """
    rate_hz = angles.rate_hz
    return tuple(
        _range(angles, column, np.abs(_velocity(angles, column, rate_hz)))
        for column in range(len(angles.rows))
    )


def _range(angles: ClinicalAngles, column: int, speed: Array) -> RangeOfMotion:
    name, known = angles.names[column], np.isfinite(angles.values[:, column])
    trusted, singular = angles.trusted_angle(column), angles.singular[:, column]
    values, nan = _usable(angles, column), float("nan")
    shares: dict[str, Any] = {
        "known_share": float(known.mean()),
        "about_vertical": angles.rows[column].about_vertical,
    }
    for share, flag in (("singular_share", singular), ("trusted_share", np.isfinite(trusted))):
        shares[share] = float(flag[known].mean()) if known.any() else nan
    if not np.isfinite(values).any():
        return RangeOfMotion(name, nan, nan, nan, nan, nan, nan, **shares)
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    peak = float(np.nanmax(speed)) if np.isfinite(speed).any() else nan
    ends = (nan, nan) if angles.sigma is None else angles.sigma[[low, high], column].tolist()
    return RangeOfMotion(
        name, float(values[low]), float(values[high]), float(np.nanmean(values)), float(angles.times[low]),
        float(angles.times[high]), peak, **shares, low_sigma=ends[0], high_sigma=ends[1],
        range_sigma=range_deviation(*ends),
    )  # fmt: skip
