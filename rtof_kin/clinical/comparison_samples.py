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
from scipy.signal import fftconvolve

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


def usable(angles: ClinicalAngles) -> tuple[Array, Array | None]:
    """Return values and standard deviations (T, A) rad; NaN where unobserved, unreliable or singular.

    Whole turns between two stretches are removed.
    """
    values = np.where(angles.singular, np.nan, angles.trusted_values)
    for column in values.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
    return values, None if angles.sigma is None else np.where(np.isfinite(values), angles.sigma, np.nan)


def in_time(a: ClinicalAngles, b: ClinicalAngles, names: Sequence[str], shift: float) -> tuple[Array, list[Pair]]:
    """Return the common instants (P,) s on A's clock, and the angles at them; shift: s, added to the times of B."""
    a, b = a.select(names), b.select(names)
    inside = (a.times >= b.times[0] + shift - 1e-9) & (a.times <= b.times[-1] + shift + 1e-9)
    times, at = a.times[inside], np.clip(a.times[inside] - shift, b.times[0], b.times[-1])
    values_a, sigma_a = (None if x is None else x[inside] for x in usable(a))
    values_b, sigma_b = (
        None if x is None else signals.interpolate(b.times, x, at, _GAP / b.rate_hz) for x in usable(b)
    )
    assert values_a is not None
    assert values_b is not None
    values_b = values_b - _TURN * np.round((values_b - values_a) / _TURN)
    both = np.isfinite(values_a) & np.isfinite(values_b)

    def samples(values: Array, sigma: Array | None, column: int) -> Samples:
        known = both[:, column]
        own = None if sigma is None else np.where(known, sigma[:, column], np.nan)[None]
        return Samples(np.where(known, values[:, column], np.nan)[None], own)

    pairs = [
        Pair(name, samples(values_a, sigma_a, k), samples(values_b, sigma_b, k), float(both[:, k].mean()))
        for k, name in enumerate(names)
        if both[:, k].any()
    ]
    return times, pairs


def over_phases(
    a: ClinicalAngles, b: ClinicalAngles, names: Sequence[str], spans_a: Spans, spans_b: Spans
) -> list[Pair]:
    """Return the angles at `PHASES` of all repeats in which they are usable throughout; spans_a, spans_b: repeats;
    angles of one side are taken over those of that side, angles of the trunk over those of the first side that both
    have.
    """
    pairs = []
    for name in names:
        side = own_side(name, spans_a, spans_b)
        if side is None:
            continue
        first, second = repeats_of(a, name, spans_a[side]), repeats_of(b, name, spans_b[side])
        paired = list(spans_a[side]) == list(spans_b[side]) and np.array_equal(a.times, b.times)
        complete = [first.complete, second.complete]
        if paired:
            complete = [complete[0] & complete[1]] * 2
        first, second = first.only(complete[0]), second.only(complete[1])
        if len(first.values) and len(second.values):
            middle = np.median(first.values)
            turns = np.round((np.median(second.values, axis=1, keepdims=True) - middle) / _TURN)
            total = len(spans_a[side]) + len(spans_b[side])
            share = (len(first.values) + len(second.values)) / total
            pairs.append(Pair(name, first, Samples(second.values - _TURN * turns, second.sigma), share, paired))
    return pairs


def own_side(name: str, spans_a: Spans, spans_b: Spans) -> str | None:
    """Return the side whose repeats an angle is taken over; None without repeats."""
    own = next((side for side in SIDES if name.startswith(f"{side}_")), None)
    wanted = ("", own) if own else ("", *SIDES)
    return next((side for side in wanted if spans_a.get(side) and spans_b.get(side)), None)


def repeats_of(
    angles: ClinicalAngles, name: str, spans: Sequence[tuple[float, float]], phases: Array = PHASES
) -> Samples:
    """Return all repeats of one angle at phases, on one turn; spans: start and stop of each repeat, s."""
    values, sigma = usable(angles.select([name]))
    at = np.concatenate([start + phases * (stop - start) for start, stop in spans])
    gap, shape = _GAP / angles.rate_hz, (len(spans), len(phases))
    rows = signals.interpolate(angles.times, values, at, gap).reshape(shape)
    known = rows[np.isfinite(rows).all(axis=1)]
    if len(known):
        rows = rows - _TURN * np.round((np.median(rows, axis=1, keepdims=True) - np.median(known[0])) / _TURN)
    return Samples(rows, None if sigma is None else signals.interpolate(angles.times, sigma, at, gap).reshape(shape))


def whole(angles: ClinicalAngles, name: str) -> tuple[Samples, float]:
    """Return all usable samples of one angle, and their share."""
    values, sigma = usable(angles.select([name]))
    return Samples(values.T, None if sigma is None else sigma.T), float(np.isfinite(values).mean())


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
    start_a, first = _velocities(a, names)
    start_b, second = _velocities(b, names)
    products, energies_a, energies_b = _correlations(first, second)
    lags = np.arange(-(len(second) - 1), len(first))
    shifts = lags / GRID_HZ + (start_a - start_b)
    overlap = np.minimum(len(first), lags + len(second)) - np.maximum(lags, 0)
    shorter = min(len(first), len(second))
    least = min(max(_LEAST_OVERLAP * GRID_HZ, _LEAST_SHARE * shorter), shorter)
    allowed = (overlap >= least) & (np.abs(shifts) <= reach)

    def agreement(chosen: Array) -> Array:
        """R of all shifts from some of the angles."""
        size = np.sqrt(np.maximum(chosen @ energies_a, 0) * np.maximum(chosen @ energies_b, 0))
        r = np.divide(chosen @ products, size, out=np.zeros(len(lags)), where=size > 1e-9)
        return np.where(allowed, r, -np.inf)

    every = np.ones(len(names))
    r = agreement(every)
    if not r.max() > 0:
        raise InvalidInputError("align: the motions have no common angle that moves; name others (--angles)")
    scan = OffsetScan(shifts, r, apart=0.0)
    here = int(np.abs(shifts).argmin())
    zero = float(r[here]) if allowed[here] and abs(shifts[here]) <= 1 / GRID_HZ else float("nan")
    without = [agreement(every - one) for one in np.eye(len(names))]
    (rival, rival_agreement), known = scan.rival, scan.rival[1] > 0
    return Alignment(
        scan.best,
        _jackknife(shifts, without, scan.peak),
        scan.gain,
        rival if known else float("nan"),
        rival_agreement if known else float("nan"),
        zero,
    )


def _velocities(angles: ClinicalAngles, names: Sequence[str]) -> tuple[float, Array]:
    """Time of the first sample, s, and velocities (T, A) rad/s at `GRID_HZ`; 0 where unknown."""
    values = usable(angles.select(names))[0]
    count = int((angles.times[-1] - angles.times[0]) * GRID_HZ) + 1
    times = angles.times[0] + np.arange(count) / GRID_HZ
    grid = signals.interpolate(angles.times, values, times, 1.5 / angles.rate_hz)
    out = np.zeros_like(grid)
    for column in range(grid.shape[1]):
        for start, stop in signals.runs(np.isfinite(grid[:, column])):
            if stop - start >= _SHORTEST:
                smooth = signals.low_pass(grid[start:stop, column], GRID_HZ, CUTOFF_HZ)
                out[start:stop, column] = np.gradient(smooth) * GRID_HZ
    return float(times[0]), out


def _correlations(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Sums (A, L) over the overlap at every lag: v_A v_B, v_A^2 and v_B^2 where the other is known."""
    reverse = b[::-1]

    def total(x: Array, y: Array) -> Array:
        return np.asarray(fftconvolve(x, y, axes=0).T)

    known_a, known_b = (a != 0).astype(float), (reverse != 0).astype(float)
    return total(a, reverse), total(a**2, known_b), total(known_a, reverse**2)


def _jackknife(shifts: Array, agreements: Sequence[Array], best: int) -> float:
    """Standard deviation, s, of the peak near the best one, over the angles left out one by one."""
    if len(agreements) < 3:
        return float("nan")
    near = slice(max(0, best - int(GRID_HZ / 4)), best + int(GRID_HZ / 4) + 1)
    peaks = [OffsetScan(shifts[near], r[near]).best for r in agreements]
    n = len(peaks)
    return float(np.sqrt((n - 1) / n * np.sum((np.array(peaks) - np.mean(peaks)) ** 2)))
