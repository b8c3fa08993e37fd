"""Range of motion and angular velocity of clinical angles.

A range is between the lowest and the highest **reliable** value. Where the band of an unreliable sample leads
beyond them, the range is a least one: the uncertain end says for how long, up to which value, and up to which
bound. The intervals of both ends and of the range contain these samples, so that no frame is dropped unsaid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95

LEAST_RELIABLE: Final = 0.9
"""Share of the frames in which an angle must be known, reliable and regular to be compared with another."""
CUTOFF_HZ: Final = 6.0  # low-pass before differentiation (Winter, Biomechanics and Motor Control, 2009)


@dataclass(frozen=True)
class UncertainEnd:
    """Unreliable samples that may lie beyond the reliable values of an angle, at one end of its range."""

    seconds: float  #: [s] in which they may
    value: float  #: [rad] the furthest of their values, or the reliable end where none lies beyond it
    bound: float  #: [rad] the furthest end of their 95 % bands; NaN if the motion has no confidence


@dataclass(frozen=True)
class RangeOfMotion:
    """Range of one angle over a recording, radians and seconds, NaN without a usable value.

    Singular postures are excluded; unreliable values are in the uncertain ends and the intervals.
    """

    name: str
    low: float
    high: float
    mean: float
    time_low: float
    time_high: float
    peak_velocity: float  #: [rad/s] largest absolute angular velocity
    known_share: float  #: Share of the frames in which the angle is observed
    singular_share: float  #: Share of those near a singular posture; NaN for none
    trusted_share: float = 1.0  #: Share of those with a reliable value (`decomposition`); NaN for none
    low_sigma: float = float("nan")  #: [rad] standard deviation of `low`; NaN if the motion has no confidence
    high_sigma: float = float("nan")  #: [rad] standard deviation of `high`; NaN if the motion has no confidence
    range_sigma: float = float("nan")
    """[rad] standard deviation of `range` (`range_deviation`); NaN if the motion has no confidence."""
    about_vertical: bool = False  #: Whether the angle is a heading (see `Travel`) and its range no range of motion
    uncertain_low: UncertainEnd | None = None
    """Unreliable samples that may be lower than `low`; None if there are none."""
    uncertain_high: UncertainEnd | None = None
    """Unreliable samples that may be higher than `high`; None if there are none."""
    largest_sigma: float = float("nan")
    """[rad] largest standard deviation of the reliable values; NaN if the motion has no confidence."""
    one_turn: bool = True
    """Whether all usable values lie in the interval of the angle, without whole turns between them."""

    @property
    def range(self) -> float:
        """High minus low; the least range where an end is uncertain."""
        return self.high - self.low

    @property
    def is_uncertain(self) -> bool:
        """Whether unreliable samples may lie beyond either end."""
        return self.uncertain_low is not None or self.uncertain_high is not None

    @property
    def is_comparable(self) -> bool:
        """Whether it is a range of motion that may be compared with another."""
        return not (self.why_not_comparable or self.about_vertical)

    @property
    def why_not_comparable(self) -> str:
        """Phrase on why it is not compared with other ranges; '' if it may be."""
        shares = np.array([self.known_share, self.trusted_share, 1 - self.singular_share])
        if not np.isfinite(self.range) or not np.all(shares >= LEAST_RELIABLE):
            return f"observed, reliable and regular in less than {100 * LEAST_RELIABLE:.0f} % of the frames"
        if self.is_uncertain:
            return f"its range is {self.text}"
        return "" if self.one_turn else "its values differ by whole turns"

    @property
    def low_interval(self) -> tuple[float, float]:
        """[rad] 95 % interval of the lowest value of all frames; NaN if the motion has no confidence."""
        half = BAND_95 * self.low_sigma
        beyond = self.low - half if self.uncertain_low is None else self.uncertain_low.bound
        return beyond, self.low + half

    @property
    def high_interval(self) -> tuple[float, float]:
        """[rad] 95 % interval of the highest value of all frames; NaN if the motion has no confidence."""
        half = BAND_95 * self.high_sigma
        beyond = self.high + half if self.uncertain_high is None else self.uncertain_high.bound
        return self.high - half, beyond

    @property
    def range_interval(self) -> tuple[float, float]:
        """[rad] 95 % interval of the range of all frames; NaN if the motion has no confidence."""
        half = BAND_95 * self.range_sigma
        least, most = max(self.range - half, 0.0), self.range + half
        if self.is_uncertain:
            most = max(most, self.high_interval[1] - self.low_interval[0])
        return least, most

    @property
    def text(self) -> str:
        """The range, deg, as '107 \u00b1 23' or '>= 107, the highest 1.0 s is uncertain (up to 141)'."""
        if not np.isfinite(self.range):
            return ""
        half = np.degrees(BAND_95 * self.range_sigma)
        if not self.is_uncertain:
            return f"{np.degrees(self.range):.0f}" + (f" \u00b1 {half:.0f}" if np.isfinite(half) else "")
        said = []
        for word, to, reliable, end in (
            ("lowest", "down to", self.low, self.uncertain_low),
            ("highest", "up to", self.high, self.uncertain_high),
        ):
            if end is not None:
                value = f" ({to} {np.degrees(end.value):.0f})" if end.value != reliable else ""
                said.append(f"the {word} {end.seconds:.1f} s is uncertain{value}")
        return ", ".join([f">= {np.degrees(self.range):.0f}", *said])


def range_deviation(low_sigma: float, high_sigma: float) -> float:
    """Return the standard deviation of a range, rad.

    The errors of its two ends count as independent. A constant bias cancels in a range, and errors are
    correlated over time, which makes this too large; the extremum of a noisy curve lies outward, which makes
    it too small. ``python -m benchmarks range_bands`` measures the balance.

    Args:
        low_sigma, high_sigma: standard deviations of the two ends, rad.
    """
    return float(np.hypot(low_sigma, high_sigma))


def angular_velocity(angles: ClinicalAngles, column: int) -> Array:
    """Return the time derivative (T,) of one angle, rad/s, smoothed; NaN where it is singular, unknown or unreliable;
    single frames between gaps have no velocity.
    """
    values, out = _usable(angles, column), np.full(len(angles), np.nan)
    for start, stop in signals.runs(np.isfinite(values)):
        if stop - start > 1:
            stretch = smoothed(values[start:stop], angles.rate_hz, CUTOFF_HZ)
            out[start:stop] = np.gradient(stretch, angles.times[start:stop])
    return out


def _usable(angles: ClinicalAngles, column: int) -> Array:
    """(T,) rad of one angle; NaN where it is singular, unknown or unreliable."""
    return np.where(angles.singular[:, column], np.nan, angles.trusted_angle(column))


def smoothed(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Low-pass values; unchanged if the rate is too low or the stretch too short; values: (T, ...); rate_hz: sampling
    rate, Hz; cutoff_hz: -3 dB frequency, Hz.
    """
    if cutoff_hz >= 0.45 * rate_hz or len(values) < rate_hz / cutoff_hz:
        return values
    return signals.low_pass(values, rate_hz, cutoff_hz)


def ranges_of_motion(angles: ClinicalAngles) -> tuple[RangeOfMotion, ...]:
    """Return the range of motion of each angle, in their order."""
    return tuple(_range(angles, column) for column in range(len(angles.rows)))


def _range(angles: ClinicalAngles, column: int) -> RangeOfMotion:
    row, known = angles.rows[column], np.isfinite(angles.values[:, column])
    trusted, singular = angles.trusted_angle(column), angles.singular[:, column]
    values, nan = _usable(angles, column), float("nan")
    shares: dict[str, Any] = {"known_share": float(known.mean()), "about_vertical": row.about_vertical}
    for share, flag in (("singular_share", singular), ("trusted_share", np.isfinite(trusted))):
        shares[share] = float(flag[known].mean()) if known.any() else nan
    if not np.isfinite(values).any():
        return RangeOfMotion(row.name, nan, nan, nan, nan, nan, nan, **shares)
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    speed = np.abs(angular_velocity(angles, column))
    peak = float(np.nanmax(speed)) if np.isfinite(speed).any() else nan
    ends = (nan, nan) if angles.sigma is None else angles.sigma[[low, high], column].tolist()
    sigmas = np.array([]) if angles.sigma is None else angles.sigma[np.isfinite(values), column]
    return RangeOfMotion(
        row.name,
        float(values[low]),
        float(values[high]),
        float(np.nanmean(values)),
        float(angles.times[low]),
        float(angles.times[high]),
        peak,
        **shares,
        low_sigma=ends[0],
        high_sigma=ends[1],
        range_sigma=range_deviation(*ends),
        uncertain_low=_beyond(angles, column, values[[low, high]], ends[0], -1),
        uncertain_high=_beyond(angles, column, values[[high, low]], ends[1], 1),
        largest_sigma=float(sigmas.max()) if len(sigmas) else nan,
        one_turn=row.range[0] <= values[low] and values[high] <= row.range[1],
    )


def _beyond(angles: ClinicalAngles, column: int, ends: Array, sigma: float, sign: int) -> UncertainEnd | None:
    """Unreliable samples of an angle that may lie beyond a reliable end; each counts for the nearer end; ends: (2,)
    rad, this reliable end and the other; sigma: rad, of this end; sign: 1 for the highest, -1 for the lowest.
    """
    values, end = sign * angles.values[:, column], sign * float(ends[0])
    doubtful = np.isfinite(values) & ~np.isfinite(angles.trusted_angle(column)) & ~angles.singular[:, column]
    half = 0.0 if angles.sigma is None else np.fmin(BAND_95 * angles.sigma[:, column], np.pi)
    bounds = values + half  # an angle that is not determined at all is within half a turn
    reach = end + (BAND_95 * sigma if np.isfinite(sigma) else 0.0)
    own = doubtful & (values >= sign * ends.mean()) & ((bounds > reach) | (values > end))
    if not own.any():
        return None
    known = angles.sigma is not None and np.isfinite(bounds[own]).any()
    bound = sign * max(float(np.nanmax(bounds[own])), reach) if known else float("nan")
    return UncertainEnd(float(own.sum() / angles.rate_hz), sign * max(float(values[own].max()), end), bound)
