"""Differences B - A between two motions with stated errors, and their tests (docs/compare.md, docs/follow.md).

The variance of a difference is the sum of these parts, as if the errors of A and B were independent, less what cancels
of two recordings of one person that were made alike (`SHARED`). Of one recording more cancels, and it is too large.

- The stated error of each mean: the mean of the standard deviations s(t) over T frames or strides, which by Cauchy and
  Schwarz never claims too little, whatever the correlation of the error. Of a range: `range_of_motion.range_deviation`.
- The spread d^2 / n of each over n strides or repetitions: another day's mean would differ by that. A single repeat
  takes d from the other motion; both sides in the same repetitions have one d, that of the differences.

So the error is e ~ N(0, K + v): K is known (stated bands); v is estimated by s^2 with nu degrees of freedom,
nu s^2 / v ~ chi^2_nu (repeats; of two motions s^2 is the sum of both, and nu Welch's). The two-sided p-value of a
difference d averages over what s^2 leaves open of v::

    p(d) = E[2 Phi(-|d| / sqrt(K + nu s^2 / x))],   x ~ chi^2_nu

the distribution of Behrens and Fisher (Fisher, Annals of Eugenics 6, 1935) with one of the variances known. Its false
positives never exceed the level (tests/clinical/test_comparison_change.py). Degrees of freedom by Satterthwaite of the
whole do not keep small levels, at which multiple tests are decided: with nu = 2 and K = 0.1 v, 16 times too many at
0.1 %.

The p-values of all angles are adjusted by Holm (Scandinavian Journal of Statistics 6, 1979), so that the chance of even
one false "changed" among them is at most `LEVEL`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Final, Literal

import numpy as np
import scipy

from rtof_kin.clinical.angle_table import AngleRow
from rtof_kin.core.array_types import Array

SHARED: Final = 0.5
"""Share of the variance of stated errors that cancels between two recordings that were made alike (`Made`), of angles
that a segment without a sensor has. Errors of the person's file, and of the method about this person, are shared. With
it the 95 % intervals of planted changes hold in every class (``python -m benchmarks visits``; docs/follow.md)."""
_NODES: Final = 150  # of the average, evenly spaced in log x
_TAIL: Final = 1e-13  # probability left out at either end


@dataclass(frozen=True)
class MixedError:
    """Normal error with mean 0 and a partly estimated variance."""

    known: float = 0.0  #: Known variance, unit^2
    estimated: float = 0.0  #: Estimated variance, unit^2
    dof: float = np.inf  #: Degrees of freedom of `estimated`
    shared: float = 0.0  #: Share of `known` that another value like it has in common, which cancels in their difference

    @property
    def sigma(self) -> float:
        """Standard deviation; NaN where nothing states it."""
        return float(np.sqrt(self.known + self.estimated)) or float("nan")

    @property
    def effective_dof(self) -> float:
        """Degrees of freedom of the whole variance by Satterthwaite; infinite if nothing is estimated."""
        return self.dof * ((self.known + self.estimated) / self.estimated) ** 2 if self.estimated else np.inf

    @property
    def mdc95(self) -> float:
        """Minimal detectable change between two values with this error, of this measure alone; NaN without one."""
        return MixedError(2 * (1 - self.shared) * self.known, 2 * self.estimated, self.dof).half_width(LEVEL)

    def p(self, difference: float) -> float:
        """Return the two-sided p-value of a difference, in the unit of the error."""
        if not np.isfinite(self.dof) or not self.estimated:
            return float(scipy.special.erfc(abs(difference) / self.sigma / np.sqrt(2)))
        chi2, weights = _average(self.dof)
        sigmas = np.sqrt(self.known + self.estimated * self.dof / chi2)
        return float(weights @ scipy.special.erfc(abs(difference) / sigmas / np.sqrt(2)))

    def half_width(self, level: float) -> float:
        """Return the difference whose p-value is a level; NaN if the error is unknown; level: two-sided, e.g. 0.05 for
        half of a 95 % interval.
        """
        return _half_width(self, level)


@lru_cache(maxsize=4096)
def _half_width(error: MixedError, level: float) -> float:
    if not error.sigma > 0:
        return float("nan")
    z = scipy.stats.norm.isf(level / 2)
    if not np.isfinite(error.dof) or not error.estimated:
        return float(z * error.sigma)
    most = z * np.sqrt(error.known) + scipy.stats.t.isf(level / 2, error.dof) * np.sqrt(error.estimated)
    return float(scipy.optimize.brentq(lambda h: error.p(h) - level, 0.0, 1.01 * most, rtol=1e-8))


@lru_cache(maxsize=256)
def _average(dof: float) -> tuple[Array, Array]:
    """Nodes and weights of the mean over chi^2."""
    chi2 = np.geomspace(float(scipy.stats.chi2.ppf(_TAIL, dof)), float(scipy.stats.chi2.isf(_TAIL, dof)), _NODES)
    weights = scipy.stats.chi2.pdf(chi2, dof) * chi2
    return chi2, weights / weights.sum()


LEVEL: Final = 0.05  #: Chance of a false "changed" among all tests of a comparison
Repeats = Literal["none", "independent", "paired"]
"""What the values of two motions are: one each; of repeats of a movement, whose spread counts; or of the same
repeats, such as both sides in the same squats, of which the spread of the differences counts."""
_NO_SIZE: Final = 1e-9  # [rad] differences below are rounding


class Verdict(StrEnum):
    """Outcome of a test; its value is its name in words."""

    CHANGED = "changed"
    NOT_SHOWN = "not shown to have changed"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class Measured:
    """One measure of one angle of one motion, from all its repeats."""

    values: Array  #: (n,) rad, one for each repeat
    band_sigma: float  #: [rad] standard deviation of the error that all repeats share; 0 if the values count as exact

    @property
    def mean(self) -> float:
        """[rad] over repeats; NaN for none."""
        return float(np.mean(self.values)) if len(self.values) else float("nan")

    @property
    def spread(self) -> float:
        """[rad] standard deviation between repeats; NaN for fewer than two."""
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else float("nan")


@dataclass(frozen=True)
class Change:
    """A difference B - A, its uncertainty and its test."""

    measure: str  #: 'mean' or 'range'
    a: float  #: [rad] of motion A
    b: float  #: [rad] of motion B
    error: MixedError  #: Of the difference
    p: float  #: Two-sided p-value of this test alone; NaN if not tested
    p_adjusted: float = float("nan")  #: Holm's, over all tests of the comparison
    detectable: float = float("nan")
    """[rad] a difference of this size is called changed whatever the other angles show."""
    independent: MixedError | None = None
    """Of the difference, had A and B no errors in common; None where they have none."""
    detectable_independent: float = float("nan")
    """[rad] `detectable`, had they none in common; NaN where they have none."""

    @property
    def sigma(self) -> float:
        """[rad] standard deviation of the difference; NaN if unknown."""
        return self.error.sigma

    @property
    def difference(self) -> float:
        """B - A, rad."""
        return self.b - self.a

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the difference, rad, of this angle alone (without Holm's correction)."""
        half = self.error.half_width(LEVEL)
        return self.difference - half, self.difference + half

    @property
    def verdict(self) -> Verdict:
        """Outcome after Holm's correction."""
        if np.isnan(self.p_adjusted):
            return Verdict.NOT_TESTED
        return Verdict.CHANGED if self.p_adjusted <= LEVEL else Verdict.NOT_SHOWN


def change(
    measure: str, a: float, b: float, error: MixedError, tested: bool = True, independent: MixedError | None = None
) -> Change:
    """Return a difference b - a with its test, not yet adjusted for others; not tested if nothing states its error."""
    if not error.sigma > _NO_SIZE:
        error = MixedError()
    tested &= bool(np.isfinite(error.sigma + b - a))
    p = error.p(b - a) if tested else float("nan")
    return Change(measure, a, b, error, p, independent=None if independent == error else independent)


@dataclass(frozen=True)
class Made:
    """How a recording of a known person was made."""

    how: tuple[object, ...]  #: Person and constants of the body, mode, version, settings, detector's points, cameras
    sensed: tuple[str, ...] = ()  #: Joints whose segments carry a sensor
    calibrated: bool = False  #: Whether mountings were found from the recording itself

    def shares(self, row: AngleRow) -> bool:
        """Return whether two such recordings have errors of an angle in common: not those of mountings, which make up
        the error between two segments with sensors, and where they are found beside one.
        """
        bare = [segment not in self.sensed for segment in row.segments]
        return any(bare) and (all(bare) or not self.calibrated)


def shared_of(made: Iterable[Made | None], rows: Iterable[AngleRow]) -> dict[str, float]:
    """Return the angles of which recordings have errors in common, with the share of their variance; none unless all
    were made alike, of a known person.
    """
    ways = {*made}
    way = ways.pop() if len(ways) == 1 else None
    return {} if way is None else {row.name: SHARED for row in rows if way.shares(row)}


def bands_of(a: Measured, b: Measured, shared: float = 0.0) -> float:
    """Return the variance that bands state of the difference of two means; shared: share of it that both have."""
    return a.band_sigma**2 + b.band_sigma**2 - 2 * shared * a.band_sigma * b.band_sigma


def error_of(a: Measured, b: Measured, repeats: Repeats, shared: float = 0.0) -> MixedError:
    """Return the error of the difference of two means; repeats: what their values are; shared: as for `bands_of`."""
    bands, own = bands_of(a, b, shared), [one for one in (a, b) if len(one.values) > 1]
    if repeats == "none" or not own:
        return MixedError(bands)
    if repeats == "paired":
        return MixedError(bands, Measured(b.values - a.values, 0.0).spread ** 2 / len(a.values), len(a.values) - 1.0)
    if len(own) == 1:  # the other motion has a single repeat
        count = len(own[0].values)
        return MixedError(bands, own[0].spread ** 2 * (1 + 1 / count), count - 1.0)
    parts = [(one.spread**2 / len(one.values), len(one.values) - 1.0) for one in own]
    spread, weight = sum(part for part, _ in parts), sum(part**2 / dof for part, dof in parts)
    return MixedError(bands, spread, spread**2 / weight if weight else np.inf)


def adjusted(changes: Sequence[Change]) -> tuple[Change, ...]:
    """Return the changes of one comparison with Holm's p-values and the detectable differences."""
    tested = [i for i, found in enumerate(changes) if np.isfinite(found.p)]
    out, largest = list(changes), 0.0
    for rank, i in enumerate(sorted(tested, key=lambda i: changes[i].p)):
        one, level = changes[i], LEVEL / len(tested)
        largest = max(largest, min(1.0, (len(tested) - rank) * one.p))
        apart = float("nan") if one.independent is None else one.independent.half_width(level)
        detectable = one.error.half_width(level)
        out[i] = replace(one, p_adjusted=largest, detectable=detectable, detectable_independent=apart)
    return tuple(out)
