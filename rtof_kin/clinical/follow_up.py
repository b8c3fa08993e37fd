"""Did a person change over visits? Measures of every visit, their errors, and changes from the baseline.

All changes are tested together: with Holm's correction (`comparison_change.adjusted`) the chance of even one false
verdict is at most 5 %. Trial t of visit v, one of n_v, gives (docs/follow.md)

::

    y_vt = mu_v + a + c_v + m_vt + w_vt

with the true value mu_v, the error a that all visits share, which cancels in a change, c_v that the trials of a visit
share, m_vt of each trial, and the variation w_vt of the person. Bands state the variance B^2 of a + c + m together. Of
a person who is known by the same constants in all trials, the share r = `SHARED` of it counts as a, in angles whose
error is not that of mountings (`shared_of`); else all counts as c, which claims least (r = 0). Trials vary within
visits by the variance W^2 of m + w. The variances of a visit's mean and of a change are ::

    V_v = B_v^2 + W^2 / n_v        B_a^2 + B_b^2 - 2 r B_a B_b + W^2 (1 / n_a + 1 / n_b)

and without repeated trials those without W. The minimal detectable change of a standard error of measurement (SEM) is
MDC95 = 1.96 sqrt(2) SEM (Weir, J Strength Cond Res 19, 2005; de Vet et al., J Clin Epidemiol 59, 2006), of bands times
sqrt(1 - r), with Student's t in place of 1.96 where the SEM is estimated from few trials, and `MixedError` where it is
partly so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np
import scipy

from rtof_kin.clinical.comparison_change import (
    LEVEL,
    Change,
    Measured,
    MixedError,
    Verdict,
    adjusted,
    bands_of,
    change,
    shared_of,
)
from rtof_kin.clinical.visits import (
    BETTER,
    BETTERS,
    Better,
    Measure,
    Movement,
    Visit,
    incomparable,
    measures_of,
    movement,
)
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError, UnknownNameError

POWER: Final = 0.8  #: Probability with which a change of the size `shown_mostly` is shown


@dataclass(frozen=True)
class MeasurementErrors:
    """The three standard errors of measurement of one measure; an error without a variance is stated by nothing."""

    bands: MixedError
    """Of the value of a visit, from its bands: detector, sensors, camera, mounting, model. Without the
    variation of the person."""
    trials: MixedError
    """Of the value of one trial, from repeated trials: variation of the person, and errors of measurement
    that differ from trial to trial. Without errors that the trials of a visit share."""
    both: MixedError
    """Of the value of a visit: all of these; of a typical visit (mean variance over visits)."""

    def of_means(self, *visits: Measured, shared: float = 0.0) -> MixedError:
        """Return the error of the difference of the means of two visits, or of the mean of one; the spread of both is
        estimated by one mean square. shared: share of the bands' variance that two visits have in common.
        """
        bands = bands_of(*visits, shared) if len(visits) == 2 else visits[0].band_sigma ** 2
        share = sum(1 / len(one.values) for one in visits)
        return MixedError(bands, share * self.trials.estimated, self.trials.dof)

    def of_sum(self, a: Measured, b: Measured) -> float:
        """Return the largest standard deviation of the sum of the means of two visits: of shared errors."""
        return float(np.sqrt(self.of_means(a, b).sigma ** 2 + 2 * a.band_sigma * b.band_sigma))


def measurement_errors(visits: Sequence[Measured], shared: float = 0.0) -> MeasurementErrors:
    """Return the standard errors of one measure; visits: the values of the trials of each visit, at least one, and the
    mean standard deviation that the bands of a visit state (0: they state none); shared: as for `of_means`.
    """
    within, dof = mean_square_within([one.values for one in visits])
    bands = float(np.mean([one.band_sigma**2 for one in visits]))
    spread = float(np.mean([within / len(one.values) for one in visits]))
    own, both = MixedError(bands, shared=shared), MixedError(bands, spread, dof, shared)
    return MeasurementErrors(own, MixedError(0.0, within, dof), both)


def mean_square_within(groups: Sequence[Array]) -> tuple[float, float]:
    """Return the mean square within groups, unit^2, and its degrees of freedom; (0, infinite) without repeats;
    groups: (n_v,) values of each visit.
    """
    dof = sum(len(group) - 1 for group in groups if len(group))
    if not dof:
        return 0.0, np.inf
    total = sum(float(np.sum((group - np.mean(group)) ** 2)) for group in groups if len(group))
    return total / dof, float(dof)


def shown_mostly(error: MixedError, needed: float) -> float:
    """Return the true change that is shown with a probability of `POWER`."""
    return needed + float(scipy.stats.norm.ppf(POWER)) * error.sigma


_TURN: Final = 2 * np.pi


class Outcome(StrEnum):
    """Answer for one measure and visit; its value is its name in words."""

    IMPROVED = "improved"
    WORSE = "worse"
    CHANGED = "changed"  #: Changed, but no direction is known to be better, or it is not shown which
    NOT_SHOWN = "not shown"
    NOT_TESTED = "not tested"


class Repeated(StrEnum):
    """What repeats within a visit."""

    TRIALS = "trials"
    STRIDES = "strides"  #: Strides or repetitions of the single trial of each visit
    NOTHING = "nothing"


@dataclass(frozen=True)
class Followed:
    """One measure over all visits."""

    measure: Measure
    better: Better | None
    """Direction that is better: 'up', 'down', towards 'zero'; None where none is known or declared."""
    visits: tuple[Measured | None, ...]
    """Of each visit: the values of its trials (of its strides, see `FollowUp.repeated`), and their mean band;
    None where it was not observed."""
    baseline: int  #: Index of the visit that the others are compared with
    errors: MeasurementErrors
    changes: tuple[Change | None, ...]
    """Of each visit from the baseline; None for the baseline and where either was not observed."""
    why_not: str = ""  #: Why no change is tested; '' if it is

    @property
    def estimates(self) -> Array:
        """(V,) means of the visits, in the unit of computation; NaN where not observed."""
        return np.array([np.nan if one is None else one.mean for one in self.visits])

    @property
    def sigmas(self) -> Array:
        """(V,) standard deviations of the estimates by bands and repeats; NaN where nothing states them."""
        return np.array([np.nan if one is None else self.errors.of_means(one).sigma for one in self.visits])

    @property
    def half_bands(self) -> Array:
        """(V,) halves of the 95 % intervals of the estimates; NaN where nothing states them."""
        return np.array([np.nan if one is None else self.errors.of_means(one).half_width(LEVEL) for one in self.visits])

    def outcome(self, visit: int) -> Outcome:
        """Return the answer for a visit."""
        change = self.changes[visit]
        if change is None or change.verdict is Verdict.NOT_TESTED:
            return Outcome.NOT_TESTED
        if change.verdict is Verdict.NOT_SHOWN:
            return Outcome.NOT_SHOWN
        if self.better is None:
            return Outcome.CHANGED
        gain = change.difference
        if self.better == "down":
            gain = -gain
        elif self.better == "zero":
            if not self.nearer_shown(visit):
                return Outcome.CHANGED
            gain = -change.difference * (change.a + change.b)
        return Outcome.IMPROVED if gain > 0 else Outcome.WORSE

    def changed(self, visit: int) -> bool:
        """Return whether a change from the baseline is shown, in whichever direction."""
        change = self.changes[visit]
        return change is not None and change.verdict is Verdict.CHANGED

    def nearer_shown(self, visit: int) -> bool:
        """Return whether it is shown which of a visit and the baseline is nearer to zero, if they differ.

        b is nearer than a if b - a and b + a have opposite signs, so the sign of the sum has to be shown too.
        """
        change, first = self.changes[visit], self.visits[self.baseline]
        own = self.visits[visit]
        if change is None or first is None or own is None:
            return False
        wider = self.errors.of_sum(first, own) / change.sigma
        return abs(change.a + change.b) >= change.detectable * max(1.0, wider)

    def mostly(self, visit: int) -> float:
        """Return the true change that would be shown with a probability of 80 %; NaN if not tested."""
        change = self.changes[visit]
        if change is None:
            return float("nan")
        return shown_mostly(change.error, change.detectable)


@dataclass(frozen=True)
class FollowUp:
    """Answer for all measures."""

    visits: tuple[Visit, ...]  #: In order
    baseline: int
    by: Movement
    kind: str  #: Of the repetitions; '' for others
    why: str  #: Why it is measured by this; '' if it was given
    repeated: Repeated
    measures: tuple[Followed, ...]
    incomparable: tuple[str, ...]  #: What makes visits not comparable, in sentences, the gravest first
    left_out: Mapping[str, str]  #: Trials and measures that are left out -> why
    shared: Mapping[str, float] = field(default_factory=dict)
    """Angle -> share of the variance of its bands that all visits have in common."""

    @property
    def last(self) -> int:
        """Index of the visit that the verdict is about: the last one, or the one before of the baseline."""
        return len(self.visits) - 1 if self.baseline != len(self.visits) - 1 else self.baseline - 1


def follow_up(
    visits: Sequence[Visit],
    *,
    baseline: int = 0,
    by: Movement | None = None,
    kind: str = "",
    better: Mapping[str, Better] | None = None,
    names: Sequence[str] = (),
) -> FollowUp:
    """Compare the visits of one person with a baseline, measure by measure. `InvalidInputError`: fewer than two visits,
    a motion that occurs twice, no common measure, or a trial without what is requested; `UnknownNameError`: a measure
    that there is not, or no such direction.

    Args:
        visits: two or more, in their order, each with trials of the same movement.
        baseline: index of the visit that the others are compared with.
        by: what is measured over; by default gait cycles if all visits are walking, else repetitions that all trials
            have two of, else the whole recordings.
        better: measure -> direction that is better, beside `BETTER`.
        names: measures to follow, or angles with all of theirs; none for all. Fewer are tested more sharply.
    """
    visits = tuple(visits)
    _check(visits, baseline)
    chosen, kind, why, out = movement(visits, by, kind)
    used = [[one for one in visit.trials if f"{visit.name}, {one.name}" not in out] for visit in visits]
    values = [[measures_of(one, chosen, kind) for one in trials] for trials in used]
    measures = list(dict.fromkeys(m for visit in values for one in visit for m in one))
    known = [measure.name for measure in measures]
    indices_of("measure", list(better or {}), known)
    names = _expanded(names, known)
    if wrong := set((better or {}).values()) - set(BETTERS):
        raise UnknownNameError("direction that is better", sorted(wrong), BETTERS)
    repeated = Repeated.TRIALS
    if not any(len(trials) > 1 for trials in used):
        most = max((len(one.values) for visit in values for own in visit for one in own.values()), default=0)
        repeated = Repeated.STRIDES if most > 1 else Repeated.NOTHING
    series: dict[Measure, list[Measured | None]] = {}
    for measure in measures:
        if names and measure.name not in names:
            continue
        own = [_of_visit(visit, measure, repeated) for visit in values]
        if own[baseline] is None or sum(one is not None for one in own) < 2:
            absent = [visit.name for visit, one in zip(visits, own, strict=True) if one is None]
            out[measure.name] = f"not observed, or not reliably, in {', '.join(absent)}"
            continue
        series[measure] = own
    if not series:
        raise InvalidInputError("follow: no measure is observed in the baseline and in another visit")
    unlike = [f"{name}: {reason}" for name, reason in out.items() if name not in known]
    causes = (*incomparable(visits, baseline), *unlike)
    every = [one for visit in visits for one in visit.trials]
    alike = () if causes or chosen == "range" else (one.setup.made for one in every)
    shared = shared_of(alike, every[0].analysis.angles.rows)
    followed = follow_measures(series, baseline, repeated, better or {}, shared)
    return FollowUp(visits, baseline, chosen, kind, why, repeated, followed, causes, out, shared)


def follow_measures(
    series: Mapping[Measure, Sequence[Measured | None]],
    baseline: int,
    repeated: Repeated,
    better: Mapping[str, Better],
    shared: Mapping[str, float] | None = None,
) -> tuple[Followed, ...]:
    """Return the errors and changes of measures whose values are known, tested together.

    Args:
        series: measure -> of each visit the values of its trials and their mean band, in the unit of computation;
            None where it was not observed, but in the baseline.
        baseline: index of the visit that the others are compared with.
        better: measure -> direction that is better, beside `BETTER`.
        shared: angle -> share of the variance of its bands that all visits have in common.
    """
    directions = BETTER | dict(better)
    shares = {m: (shared or {}).get(m.name.rpartition("_")[0], 0.0) for m in series}
    followed = [_followed(m, own, baseline, repeated, directions, shares[m]) for m, own in series.items()]
    tested = iter(adjusted([change for one in followed for change in one.changes if change is not None]))
    return tuple(
        replace(one, changes=tuple(None if change is None else next(tested) for change in one.changes))
        for one in followed
    )


def _expanded(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Measures by name; the name of an angle stands for all of its."""
    out = []
    for name in names:
        own = [measure for measure in known if measure == name or measure.rpartition("_")[0] == name]
        indices_of("measure", [] if own else [name], known)
        out += own
    return out


def _check(visits: Sequence[Visit], baseline: int) -> None:
    if len(visits) < 2:
        raise InvalidInputError("follow: a change needs two visits or more")
    if not 0 <= baseline < len(visits):
        raise InvalidInputError(f"follow: no visit {baseline}; there are {len(visits)}")
    seen: list[tuple[str, Array]] = []
    for visit in visits:
        if not visit.trials:
            raise InvalidInputError(f"follow: visit {visit.name} has no motion")
        for one in visit.trials:
            name, values = f"{visit.name}, {one.name}", one.analysis.angles.values
            for other, same in seen:
                if np.array_equal(values, same, equal_nan=True):
                    raise InvalidInputError(
                        f"follow: {name} is the same motion as {other}, which is no repeat of it; remove one of them"
                    )
            seen.append((name, values))


def _of_visit(trials: Sequence[Mapping[Measure, Measured]], measure: Measure, repeated: Repeated) -> Measured | None:
    """Values of the trials of one visit, or of the repeats within its single trial."""
    own = [one[measure] for one in trials if measure in one and np.isfinite(one[measure].mean)]
    if not own:
        return None
    if repeated is Repeated.TRIALS:
        bands = [one.band_sigma for one in own if one.band_sigma > 0]
        return Measured(np.array([one.mean for one in own]), float(np.mean(bands)) if bands else 0.0)
    return own[0]


def _followed(
    measure: Measure,
    own: Sequence[Measured | None],
    baseline: int,
    repeated: Repeated,
    better: Mapping[str, Better],
    shared: float,
) -> Followed:
    if measure.unit == "deg" and not measure.name.endswith("_range") and (first := own[baseline]) is not None:
        middle = np.median(first.values)  # values within half a turn of the baseline
        turns = [np.round((one.values - middle) / _TURN) if one is not None else 0.0 for one in own]
        own = [one and replace(one, values=one.values - _TURN * turn) for one, turn in zip(own, turns, strict=True)]
    widest = max((one.band_sigma for one in own if one is not None and one.band_sigma > 0), default=0.0)
    own = [one if one is None or one.band_sigma > 0 else replace(one, band_sigma=widest) for one in own]
    errors = measurement_errors([one for one in own if one is not None], shared)
    why_not, first = "", own[baseline]
    if measure.is_gait and not (repeated is Repeated.TRIALS and np.isfinite(errors.trials.dof)):
        why_not = (
            "no visit has two trials of it, so nothing says how much it varies from one walk to the next; "
            "record each walk two times or more"
        )
    elif not errors.both.sigma > 0:
        why_not = "nothing states its error: the motions have no bands, and it was not repeated"
    changes: list[Change | None] = []
    for number, one in enumerate(own):
        if number == baseline or one is None or first is None:
            changes.append(None)
            continue
        error, apart = (errors.of_means(first, one, shared=share) for share in (shared, 0.0))
        changes.append(change(measure.name, first.mean, one.mean, error, not why_not, apart))
    return Followed(measure, better.get(measure.name), tuple(own), baseline, errors, tuple(changes), why_not)
