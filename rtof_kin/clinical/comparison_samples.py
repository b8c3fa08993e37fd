"""Samples of two motions on one common axis: the same instants, or the phases of repeated movements.

A sample is usable if its angle is observed and reliable and its posture not singular. Values of B are taken
modulo whole turns, nearest to those of A.

**Alignment.** One constant shift between the clocks of two motions, from the agreement of their angular velocities.

The agreement at a shift is the correlation of the velocities of all common angles together

::

    r(shift) = sum v_A(t) v_B(t - shift) / sqrt(sum v_A(t)^2  sum v_B(t - shift)^2)

over the instants and angles that both have, low-passed. It is 1 for equal movements, whatever the offsets of
the angles, and around 0 for unrelated ones. The standard deviation of the best shift is that of a jackknife
over the angles (Efron and Stein, Annals of Statistics 9, 1981).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.comparison_change import Measured
from rtof_kin.clinical.gait import PHASES
from rtof_kin.clinical.range_of_motion import range_deviation
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError

Spans = Mapping[str, Sequence[tuple[float, float]]]  #: Side, or '' for both -> start and stop of each repeat, s
_GAP: Final = 1.5  # longest interval between samples that is interpolated, in frames
_TURN: Final = 2 * np.pi


@dataclass(frozen=True)
class Samples:
    """One angle of one motion on the common axis."""

    values: Array  #: (n, P) rad, a row for each repeat; NaN where unusable
    sigma: Array | None  #: (n, P) rad, stated standard deviations; None if the motion has no bands

    @property
    def complete(self) -> Mask:
        """(n,) whether a repeat is usable throughout."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    def only(self, repeats: Mask) -> Samples:
        """Return some of the repeats, by a mask (n,)."""
        return Samples(self.values[repeats], None if self.sigma is None else self.sigma[repeats])

    @property
    def curve(self) -> Array:
        """(P,) rad, mean over repeats."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def curve_sigma(self) -> Array | None:
        """(P,) rad, standard deviation of `curve`: the mean band, and the spread between repeats."""
        band = np.zeros(self.values.shape[1]) if self.sigma is None else self.sigma.mean(axis=0)
        if len(self.values) > 1:
            return np.asarray(np.sqrt(band**2 + self.values.var(axis=0, ddof=1) / len(self.values)))
        return None if self.sigma is None else np.asarray(band)

    def mean(self) -> Measured:
        """Return the mean angle of each repeat."""
        band = 0.0 if self.sigma is None else float(np.nanmean(self.sigma))
        return Measured(np.nanmean(self.values, axis=1), band)

    def range(self) -> Measured:
        """Return the range of motion of each repeat."""
        rows = np.arange(len(self.values))
        high, low = np.nanargmax(self.values, axis=1), np.nanargmin(self.values, axis=1)
        band = 0.0
        if self.sigma is not None:
            ends = zip(self.sigma[rows, low].tolist(), self.sigma[rows, high].tolist(), strict=True)
            band = float(np.mean([range_deviation(*pair) for pair in ends]))
        return Measured(self.values[rows, high] - self.values[rows, low], band)

    def high(self, sign: int = 1) -> Measured:
        """Return the largest angle of each repeat."""
        rows, phase = np.arange(len(self.values)), np.nanargmax(sign * self.values, axis=1)
        band = 0.0 if self.sigma is None else float(np.mean(self.sigma[rows, phase]))
        return Measured(self.values[rows, phase], band)

    def low(self) -> Measured:
        """Return the smallest angle of each repeat."""
        return self.high(-1)


@dataclass(frozen=True)
class Pair:
    """One angle of both motions."""

    name: str
    a: Samples
    b: Samples
    share: float  #: Share of the common frames, or of all repeats, that are compared
    paired: bool = False  #: Whether the rows of both are the same repeats

    @property
    def difference_sigma(self) -> Array | None:
        """(P,) rad, standard deviation of B - A on the axis, as of independent errors; None without bands."""
        known = [sigma**2 for one in (self.a, self.b) if (sigma := one.curve_sigma) is not None]
        return np.sqrt(np.sum(known, axis=0)) if known else None


def usable(angle: ClinicalAngles) -> tuple[Array, Array | None]:
    """Return values and standard deviations (T,) rad of one angle; NaN where unobserved, unreliable or singular.

    Whole turns between two stretches are removed.
    """
    values = np.where(angle.singular[:, 0], np.nan, angle.trusted_angle(0))
    known = np.isfinite(values)
    values[known] = np.unwrap(values[known])
    return values, None if angle.sigma is None else np.where(known, angle.sigma[:, 0].astype(float), np.nan)


def in_both(a: ClinicalAngles, b: ClinicalAngles, shift: float) -> Mask:
    """Return a mask (T,) of the times of A at which there is B too; shift: s, added to the times of B."""
    return np.asarray((a.times >= b.times[0] + shift - 1e-9) & (a.times <= b.times[-1] + shift + 1e-9))


def in_time(a: ClinicalAngles, b: ClinicalAngles, shift: float) -> Pair:
    """Return one angle at the times of A at which there is B too; shift: s, added to the times of B."""
    inside = in_both(a, b, shift)
    at = np.clip(a.times[inside] - shift, b.times[0], b.times[-1])
    (values_a, sigma_a), (values_b, sigma_b), gap = usable(a), usable(b), _GAP / b.rate_hz
    values_a, values_b = values_a[inside], signals.interpolate(b.times, values_b, at, gap)
    values_b -= _TURN * np.round((values_b - values_a) / _TURN)
    sigma_a = None if sigma_a is None else sigma_a[inside]
    sigma_b = None if sigma_b is None else signals.interpolate(b.times, sigma_b, at, gap)
    both = np.isfinite(values_a) & np.isfinite(values_b)
    first, second = (
        Samples(np.where(both, values, np.nan)[None], None if sigma is None else np.where(both, sigma, np.nan)[None])
        for values, sigma in ((values_a, sigma_a), (values_b, sigma_b))
    )
    return Pair(a.names[0], first, second, float(both.mean()) if len(both) else 0.0)


def over_phases(a: ClinicalAngles, b: ClinicalAngles, spans_a: Spans, spans_b: Spans) -> Pair:
    """Return one angle at `PHASES` of all repeats in which it is usable throughout; spans_a, spans_b: repeats; an angle
    of one side is taken over those of that side, one of the trunk over those of the first side that both have.
    """
    nothing = Samples(np.empty((0, len(PHASES))), None)
    side = own_side(a.names[0], spans_a, spans_b)
    if side is None:
        return Pair(a.names[0], nothing, nothing, 0.0)
    first, second = repeats_of(a, spans_a[side]), repeats_of(b, spans_b[side])
    paired = list(spans_a[side]) == list(spans_b[side]) and np.array_equal(a.times, b.times)
    complete = [first.complete, second.complete]
    if paired:
        complete = [complete[0] & complete[1]] * 2
    first, second = first.only(complete[0]), second.only(complete[1])
    if not (len(first.values) and len(second.values)):
        return Pair(a.names[0], nothing, nothing, 0.0)
    middle = np.median(first.values)
    turns = np.round((np.median(second.values, axis=1, keepdims=True) - middle) / _TURN)
    share = (len(first.values) + len(second.values)) / (len(spans_a[side]) + len(spans_b[side]))
    return Pair(a.names[0], first, Samples(second.values - _TURN * turns, second.sigma), share, paired)


def own_side(name: str, spans_a: Spans, spans_b: Spans) -> str | None:
    """Return the side whose repeats an angle is taken over; None without repeats."""
    own = next((side for side in SIDES if name.startswith(f"{side}_")), None)
    wanted = ("", own) if own else ("", *SIDES)
    return next((side for side in wanted if spans_a.get(side) and spans_b.get(side)), None)


def repeats_of(angle: ClinicalAngles, spans: Sequence[tuple[float, float]], phases: Array = PHASES) -> Samples:
    """Return all repeats of one angle at phases, on one turn; spans: start and stop of each repeat, s."""
    values, sigma = usable(angle)
    at = np.concatenate([start + phases * (stop - start) for start, stop in spans])
    gap, shape = _GAP / angle.rate_hz, (len(spans), len(phases))
    rows = signals.interpolate(angle.times, values, at, gap).reshape(shape)
    known = rows[np.isfinite(rows).all(axis=1)]
    if len(known):
        rows = rows - _TURN * np.round((np.median(rows, axis=1, keepdims=True) - np.median(known[0])) / _TURN)
    return Samples(rows, None if sigma is None else signals.interpolate(angle.times, sigma, at, gap).reshape(shape))


def extremes(angle: ClinicalAngles) -> tuple[Samples, float]:
    """Return the lowest and the highest usable sample of one angle, if there is any, and the share of usable ones."""
    values, sigma = usable(angle)
    known = np.flatnonzero(np.isfinite(values))
    ends = known[[values[known].argmin(), values[known].argmax()]] if len(known) else known
    return Samples(values[None, ends], None if sigma is None else sigma[None, ends]), len(known) / len(values)


def in_range(a: ClinicalAngles, b: ClinicalAngles) -> Pair:
    """Return the `extremes` of one angle."""
    (first, share_a), (second, share_b) = extremes(a), extremes(b)
    return Pair(a.names[0], first, second, min(share_a, share_b))


GRID_HZ: Final = 50.0  #: Sampling rate of the velocities that are compared
CUTOFF_HZ: Final = 4.0  #: Low-pass of the velocities
POOR: Final = 0.5  #: Agreement below which two motions hardly agree
AMBIGUOUS: Final = 0.9
"""Agreement of the second best shift, as a share of the best, from which on the shift is ambiguous."""
_LEAST_OVERLAP: Final = 1.0  # [s] of a shift that is considered
_LEAST_SHARE: Final = 0.3  # of the shorter motion that overlaps at such a shift
_SHORTEST: Final = 8  # samples of a stretch that is differentiated


@dataclass(frozen=True)
class Alignment:
    """Shift of motion B onto the clock of A."""

    shift: float  #: [s] added to the times of B
    sigma: float  #: [s] standard deviation, by a jackknife over the angles; NaN for fewer than three angles
    agreement: float  #: r at the shift
    rival: float  #: [s] second best shift; NaN if there is none
    rival_agreement: float  #: r at that; NaN if there is none
    unshifted: float  #: r without a shift; NaN if the time spans hardly overlap

    @property
    def poor(self) -> bool:
        """Whether the motions hardly agree even so, e.g. because they are different movements."""
        return not self.agreement >= POOR

    @property
    def ambiguous(self) -> bool:
        """Whether another shift is nearly as good, as in periodic movement."""
        return bool(self.rival_agreement >= AMBIGUOUS * self.agreement)


def align(a: ClinicalAngles, b: ClinicalAngles, names: Sequence[str], reach: float = float("inf")) -> Alignment:
    """Estimate the shift with the best agreement, to a fraction of a frame. `InvalidInputError`: there is no common
    angle, or too few samples to compare velocities.

    Args:
        reach: s, largest shift that is considered.
    """
    first, second = _grid(a), _grid(b)
    lags = np.arange(-(len(second) - 1), len(first))
    shifts = lags / GRID_HZ + float(first[0] - second[0])
    overlap = np.minimum(len(first), lags + len(second)) - np.maximum(lags, 0)
    shorter = min(len(first), len(second))
    least = min(max(_LEAST_OVERLAP * GRID_HZ, _LEAST_SHARE * shorter), shorter)
    allowed = (overlap >= least) & (np.abs(shifts) <= reach)

    def sums(name: str) -> Array:
        """(3, L) `_correlations` of one angle."""
        return _correlations(*(_velocity(x.select([name]), grid) for x, grid in ((a, first), (b, second))))

    def agreement(of: Array) -> Array:
        """R of all shifts from sums."""
        size = np.sqrt(np.maximum(of[1], 0) * np.maximum(of[2], 0))
        return np.where(allowed, np.divide(of[0], size, out=np.zeros(len(lags)), where=size > 1e-9), -np.inf)

    every = np.zeros((3, len(lags)))
    for name in names:
        every += sums(name)
    r = agreement(every)
    if not r.max() > 0:
        raise InvalidInputError("align: the motions have no common angle that moves; name others (--angles)")
    scan = OffsetScan(shifts, r, apart=0.0)
    here = int(np.abs(shifts).argmin())
    zero = float(r[here]) if allowed[here] and abs(shifts[here]) <= 1 / GRID_HZ else float("nan")
    near = slice(max(0, scan.peak - int(GRID_HZ / 4)), scan.peak + int(GRID_HZ / 4) + 1)
    enough = names if len(names) > 2 else ()
    without = [OffsetScan(shifts[near], agreement(every - sums(name))[near]).best for name in enough]
    (rival, rival_agreement), known = scan.rival, scan.rival[1] > 0
    return Alignment(
        scan.best,
        float(np.sqrt((len(without) - 1) * np.var(without))) if without else float("nan"),  # the jackknife's
        scan.gain,
        rival if known else float("nan"),
        rival_agreement if known else float("nan"),
        zero,
    )


def _grid(angles: ClinicalAngles) -> Array:
    """(N,) s, times at `GRID_HZ`."""
    count = int((angles.times[-1] - angles.times[0]) * GRID_HZ) + 1
    return np.asarray(angles.times[0] + np.arange(count) / GRID_HZ)


def _velocity(angle: ClinicalAngles, times: Array) -> Array:
    """Velocity (N,) rad/s of one angle at times (N,) of `_grid`; 0 where unknown."""
    grid = signals.interpolate(angle.times, usable(angle)[0], times, 1.5 / angle.rate_hz)
    out = np.zeros_like(grid)
    for start, stop in signals.runs(np.isfinite(grid)):
        if stop - start >= _SHORTEST:
            out[start:stop] = np.gradient(signals.low_pass(grid[start:stop], GRID_HZ, CUTOFF_HZ)) * GRID_HZ
    return out


def _correlations(a: Array, b: Array) -> Array:
    """Sums (3, L) over the overlap at every lag: v_A v_B, v_A^2 and v_B^2 where the other is known."""
    reverse = b[::-1]
    known_a, known_b = (a != 0).astype(float), (reverse != 0).astype(float)
    pairs = (a, reverse), (a**2, known_b), (known_a, reverse**2)
    return np.stack([scipy.signal.fftconvolve(*pair) for pair in pairs])
