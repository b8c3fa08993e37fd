"""Standard error of measurement (SEM) and minimal detectable change (MDC) of one measure over visits.

A visit v has n_v trials, repetitions of one movement. Trial t gives

::

    y_vt = mu_v + a + c_v + m_vt + w_vt

with the true value mu_v, the error a of measurement that all visits share (what the method gets wrong about
this person; it cancels in a change), the error c_v that the trials of a visit share (camera, mounting,
neutral posture), the error m_vt of each trial by itself, and the variation w_vt of the person.

- **Bands** state the variance B^2 of a + c + m together. `BandShares` divides it. A reconstruction does not
  say how; by default all of it is c, which claims least: then averaging trials does not help, and nothing cancels.
- **Trials** vary within visits by the variance W^2 of m + w, the mean square within visits of a one-way
  analysis of variance, with nu = sum of (n_v - 1) degrees of freedom.

m is in both. The error of a visit's mean that counts in a change is therefore

::

    V_v = Var(c) + W^2 / n_v,     Var(c) = B_v^2 (1 - share of a) - min(B_v^2 (share of m), W^2)

so m is counted once: taken out of the bands by at most what the trials show of it, and otherwise left in.
With the default shares m stays in B as well as in W; V_v is then too large, by Var(m) at most, never too
small. Without repeated trials V_v is B_v^2 (share of c + share of m / n_v), and w is not in it.

The SEM is the standard deviation of an error, the MDC the difference of two visits that such errors exceed with a
probability of 5 %: MDC95 = 1.96 sqrt(2) SEM (Weir, J Strength Cond Res 19, 2005; de Vet et al., J Clin Epidemiol 59,
2006: SEM of agreement), with Student's t in place of 1.96 where the SEM is estimated from few trials, and `MixedError`
where it is partly so. A true change of the size of the MDC is shown in half of the cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import stats

from rtof_kin.clinical.comparison_change import LEVEL, Measured
from rtof_kin.clinical.mixed_error import MixedError
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError

POWER: Final = 0.8
"""Probability with which a change of the size `shown_mostly` is shown."""


@dataclass(frozen=True)
class BandShares:
    """How the variance of the bands is divided; what is left is independent from trial to trial."""

    all_visits: float = 0.0
    """Share of the error that all visits have in common, which cancels in a change."""
    visit: float = 1.0
    """Share of the error that the trials of one visit have in common."""

    def __post_init__(self) -> None:
        if not (min(self.all_visits, self.visit) >= 0 and self.all_visits + self.visit <= 1 + 1e-12):
            raise InvalidInputError(
                f"shares of the bands: {self.all_visits:g} of all visits and {self.visit:g} of a visit; "
                "give numbers from 0 to 1 that together are at most 1"
            )

    @property
    def trial(self) -> float:
        """Share of the error that is independent from trial to trial."""
        return max(0.0, 1.0 - self.all_visits - self.visit)


@dataclass(frozen=True)
class Sem:
    """A standard error of measurement."""

    error: MixedError
    """Of one value; without a variance where nothing states it."""

    @property
    def sem(self) -> float:
        """In the unit of the measure; NaN where nothing states it."""
        return self.error.sigma or float("nan")

    @property
    def dof(self) -> float:
        """Degrees of freedom; infinite if it is stated."""
        return self.error.effective_dof

    @property
    def mdc95(self) -> float:
        """Minimal detectable change between two such values, of this measure alone; NaN without a SEM."""
        return _sum(self.error, self.error).half_width(LEVEL)


@dataclass(frozen=True)
class MeasurementErrors:
    """The three standard errors of one measure, and what changes of it are tested with."""

    bands: Sem
    """Of the value of a visit, from its bands: detector, sensors, camera, mounting, model. Without the
    variation of the person, and without the share that cancels in a change."""
    trials: Sem
    """Of the value of one trial, from repeated trials: variation of the person, and errors of measurement
    that differ from trial to trial. Without errors that the trials of a visit share."""
    both: Sem
    """Of the value of a visit: all of these; of a typical visit (mean variance over visits)."""
    within: tuple[float, float]
    """Mean square within visits, unit^2, and its degrees of freedom; (NaN, 0) without repeated trials."""
    shares: BandShares

    def of_visit(self, one: Measured) -> MixedError:
        """Return the error of the mean of a visit that counts in a change."""
        return _of_visit(one, self.within, self.shares)

    def of_value(self, one: Measured) -> MixedError:
        """Return the error of the value of a visit, with what cancels in a change."""
        own = self.of_visit(one)
        return replace(own, known=own.known + self.shares.all_visits * one.band_sigma**2)

    def of_change(self, a: Measured, b: Measured) -> MixedError:
        """Return the error of the difference of the means of two visits."""
        return _sum(self.of_visit(a), self.of_visit(b))

    def of_sum(self, a: Measured, b: Measured) -> float:
        """Return the largest standard deviation of the sum of the means of two visits: of shared errors."""
        first, second = self.of_value(a), self.of_value(b)
        known = (np.sqrt(first.known) + np.sqrt(second.known)) ** 2
        return float(np.sqrt(known + first.estimated + second.estimated))


def measurement_errors(visits: Sequence[Measured], shares: BandShares) -> MeasurementErrors:
    """Return the standard errors of one measure.

    Args:
        visits: the values of the trials of each visit, at least one, and the mean standard deviation that the bands
            of a visit state (0: they state none).
    """
    within = mean_square_within([one.values for one in visits])
    bands = MixedError(float(np.mean([one.band_sigma**2 for one in visits])) * (1 - shares.all_visits))
    trials = MixedError(0.0, *within) if within[1] else MixedError()
    own = [_of_visit(one, within, shares) for one in visits]
    both = MixedError(
        float(np.mean([one.known for one in own])), float(np.mean([one.estimated for one in own])), own[0].dof
    )
    return MeasurementErrors(Sem(bands), Sem(trials), Sem(both), within, shares)


def mean_square_within(groups: Sequence[Array]) -> tuple[float, float]:
    """Return the mean square within groups, unit^2, and its degrees of freedom; (NaN, 0) without repeats.

    Args:
        groups: (n_v,) values of each visit.
    """
    dof = sum(len(group) - 1 for group in groups if len(group))
    if not dof:
        return float("nan"), 0.0
    total = sum(float(np.sum((group - np.mean(group)) ** 2)) for group in groups if len(group))
    return total / dof, float(dof)


def shown_mostly(error: MixedError, needed: float) -> float:
    """Return the true change that is shown with a probability of `POWER`."""
    return needed + float(stats.norm.ppf(POWER)) * error.sigma


def _of_visit(one: Measured, within: tuple[float, float], shares: BandShares) -> MixedError:
    band, count = one.band_sigma**2, len(one.values)
    spread, dof = within
    if not dof:
        return MixedError(band * (shares.visit + shares.trial / count))
    common = band * (1 - shares.all_visits) - min(band * shares.trial, spread)
    return MixedError(common, spread / count, dof)


def _sum(a: MixedError, b: MixedError) -> MixedError:
    """Of two errors whose estimated variances are from one mean square."""
    return MixedError(a.known + b.known, a.estimated + b.estimated, min(a.dof, b.dof))
