"""Range of motion and angular velocity of clinical angles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

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

    @property
    def range(self) -> float:
        """High minus low."""
        return self.high - self.low


def angular_velocity(angles: ClinicalAngles) -> Array:
    """Return time derivatives (T, A) of clinical angles, rad/s; NaN where singular, unknown or unreliable.

    Args:
        angles: to smooth and differentiate; single frames between gaps have no velocity.
    """
    out = np.full_like(angles.values, np.nan)
    usable = np.where(angles.singular, np.nan, angles.trusted_values)
    for column, values in enumerate(usable.T):
        for start, stop in signals.runs(np.isfinite(values)):
            if stop - start > 1:
                stretch = smoothed(values[start:stop], angles.rate_hz, CUTOFF_HZ)
                out[start:stop, column] = np.gradient(stretch, angles.times[start:stop])
    return out


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
    speed = np.abs(angular_velocity(angles))
    return tuple(_range(angles, column, speed[:, column]) for column in range(len(angles.rows)))


def _range(angles: ClinicalAngles, column: int, speed: Array) -> RangeOfMotion:
    name, known = angles.names[column], angles.known[:, column]
    trusted, singular = angles.trusted_values[:, column], angles.singular[:, column]
    values, nan = np.where(singular, np.nan, trusted), float("nan")
    shares = [
        float(known.mean()),
        *(float(flag[known].mean()) if known.any() else nan for flag in (singular, np.isfinite(trusted))),
    ]
    if not np.isfinite(values).any():
        return RangeOfMotion(name, nan, nan, nan, nan, nan, nan, *shares)
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    peak = float(np.nanmax(speed)) if np.isfinite(speed).any() else nan
    return RangeOfMotion(
        name, float(values[low]), float(values[high]), float(np.nanmean(values)), float(angles.times[low]),
        float(angles.times[high]), peak, *shares,
    )  # fmt: skip
