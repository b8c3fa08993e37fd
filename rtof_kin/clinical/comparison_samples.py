"""Samples of two motions on one common axis: the same instants, or the phases of repeated movements.

A sample is usable if its angle is observed and reliable and its posture not singular. Values of B are taken
modulo whole turns, nearest to those of A.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.comparison_change import Measured
from rtof_kin.clinical.gait import PHASES
from rtof_kin.clinical.range_of_motion import range_deviation
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask

Spans = Mapping[str, Sequence[tuple[float, float]]]
"""Side, or '' for both -> start and stop of each repeat, s."""
_GAP: Final = 1.5  # longest interval between samples that is interpolated, in frames
_TURN: Final = 2 * np.pi


@dataclass(frozen=True)
class Samples:
    """One angle of one motion on the common axis."""

    values: Array
    """(n, P) rad, a row for each repeat; NaN where unusable."""
    sigma: Array | None
    """(n, P) rad, stated standard deviations; None if the motion has no bands."""

    @property
    def complete(self) -> Mask:
        """(n,) whether a repeat is usable throughout."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    def only(self, repeats: Mask) -> Samples:
        """Return some of the repeats.

        Args:
            repeats: (n,) which.
        """
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

    def high(self) -> Measured:
        """Return the largest angle of each repeat."""
        return self._at(np.nanargmax(self.values, axis=1))

    def low(self) -> Measured:
        """Return the smallest angle of each repeat."""
        return self._at(np.nanargmin(self.values, axis=1))

    def _at(self, phase: NDArray[np.intp]) -> Measured:
        rows = np.arange(len(self.values))
        band = 0.0 if self.sigma is None else float(np.mean(self.sigma[rows, phase]))
        return Measured(self.values[rows, phase], band)


@dataclass(frozen=True)
class Pair:
    """One angle of both motions."""

    name: str
    a: Samples
    b: Samples
    share: float
    """Share of the common frames, or of all repeats, that are compared."""
    paired: bool = False
    """Whether the rows of both are the same repeats."""


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
    """Return the common instants (P,) s on the clock of A, and the angles at them.

    Args:
        shift: s, added to the times of B.
    """
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
    """Return the angles at `PHASES` of all repeats in which they are usable throughout.

    Args:
        spans_a, spans_b: repeats; angles of one side are taken over those of that side, angles of the trunk over
            those of the first side that both have.
    """
    pairs = []
    for name in names:
        side = own_side(name, spans_a, spans_b)
        if side is None:
            continue
        first, second = repeats_of(a, name, spans_a[side]), repeats_of(b, name, spans_b[side])
        paired = list(spans_a[side]) == list(spans_b[side]) and np.array_equal(a.times, b.times)
        if paired:
            both = first.complete & second.complete
            first, second = first.only(both), second.only(both)
        else:
            first, second = first.only(first.complete), second.only(second.complete)
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


def repeats_of(angles: ClinicalAngles, name: str, spans: Sequence[tuple[float, float]]) -> Samples:
    """Return all repeats of one angle at `PHASES`, on one turn.

    Args:
        spans: start and stop of each repeat, s.
    """
    values, sigma = usable(angles.select([name]))
    at = np.concatenate([start + PHASES * (stop - start) for start, stop in spans])
    gap, shape = _GAP / angles.rate_hz, (len(spans), len(PHASES))
    rows = signals.interpolate(angles.times, values, at, gap).reshape(shape)
    known = rows[np.isfinite(rows).all(axis=1)]
    if len(known):
        rows = rows - _TURN * np.round((np.median(rows, axis=1, keepdims=True) - np.median(known[0])) / _TURN)
    return Samples(rows, None if sigma is None else signals.interpolate(angles.times, sigma, at, gap).reshape(shape))


def whole(angles: ClinicalAngles, name: str) -> tuple[Samples, float]:
    """Return all usable samples of one angle, and their share."""
    values, sigma = usable(angles.select([name]))
    return Samples(values.T, None if sigma is None else sigma.T), float(np.isfinite(values).mean())
