"""Range of motion and angular velocity of clinical angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.core import signals

Array = NDArray[np.float64]
CUTOFF_HZ = 6.0
"""Low-pass of angles before they are differentiated (Winter, Biomechanics and Motor Control, 2009)."""


@dataclass(frozen=True)
class RangeOfMotion:
    """What one angle did over a recording; radians and seconds.

    Singular postures, where the angle is not defined, and values that are not trusted are left out.
    """

    name: str
    low: float
    """Smallest value; NaN, as all that follow, where the angle has no value to go by."""
    high: float
    mean: float
    time_low: float
    """When it was smallest."""
    time_high: float
    peak_velocity: float
    """Largest absolute angular velocity, rad/s."""
    known_share: float
    """Share of the frames in which somebody saw the angle."""
    singular_share: float
    """Share of those in which only its sum with another angle is defined, nearly; NaN for none."""
    trusted_share: float = 1.0
    """Share of those whose value is trusted (`clinical.trust`); NaN for none."""

    @property
    def range(self) -> float:
        """High minus low."""
        return self.high - self.low


def angular_velocity(angles: ClinicalAngles, cutoff_hz: float | None = CUTOFF_HZ) -> Array:
    """Derivatives over time (T, A) of clinical angles, rad/s; NaN where the angle is, or is not defined
    or not trusted.

    Args:
        angles: as they are. cutoff_hz: of the zero-phase low-pass before differentiation; None for none.
            A stretch between two gaps that is too short to filter is differentiated as it is; one of a
            single frame has no velocity.
    """
    out = np.full_like(angles.values, np.nan)
    for column in range(len(angles.rows)):
        values, defined = angles.trusted_values[:, column], ~angles.singular[:, column]
        for start, stop in signals.runs(np.isfinite(values) & defined):
            if stop - start < 2:
                continue
            stretch = smoothed(values[start:stop], angles.rate_hz, cutoff_hz)
            out[start:stop, column] = np.gradient(stretch, angles.times[start:stop])
    return out


def smoothed(values: Array, rate_hz: float, cutoff_hz: float | None) -> Array:
    """Values (T, ...) low-passed; as they are where the rate is too low or the stretch too short."""
    if cutoff_hz is None or cutoff_hz >= 0.45 * rate_hz or len(values) < rate_hz / cutoff_hz:
        return values
    return signals.low_pass(values, rate_hz, cutoff_hz)


def ranges_of_motion(angles: ClinicalAngles) -> tuple[RangeOfMotion, ...]:
    """What each angle did, in the order of the angles."""
    velocity = np.abs(angular_velocity(angles))
    return tuple(_range(angles, column, velocity[:, column]) for column in range(len(angles.rows)))


def _range(angles: ClinicalAngles, column: int, speed: Array) -> RangeOfMotion:
    name, known = angles.names[column], angles.known[:, column]
    trusted, singular = angles.trusted_values[:, column], angles.singular[:, column]
    values = np.where(singular, np.nan, trusted)
    share, nan = float(known.mean()), float("nan")
    singular_share, trusted_share = (
        float(flag[known].mean()) if known.any() else nan for flag in (singular, np.isfinite(trusted))
    )
    if not np.isfinite(values).any():
        return RangeOfMotion(name, nan, nan, nan, nan, nan, nan, share, singular_share, trusted_share)
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    return RangeOfMotion(
        name=name,
        low=float(values[low]),
        high=float(values[high]),
        mean=float(np.nanmean(values)),
        time_low=float(angles.times[low]),
        time_high=float(angles.times[high]),
        peak_velocity=float(np.nanmax(speed)) if np.isfinite(speed).any() else float("nan"),
        known_share=share,
        singular_share=singular_share,
        trusted_share=trusted_share,
    )
