"""Visits in words: what makes them not comparable, what changed, why, and what to be careful about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import stats

from rtof_kin.clinical.comparison_change import LEVEL, Change
from rtof_kin.clinical.follow_up import Followed, FollowUp, Outcome, Repeated
from rtof_kin.clinical.visit_measures import Measure
from rtof_kin.reporting.angle_names import label

DIGITS: Final = {"deg": 1, "%": 1, "s": 2, "m": 2, "m/s": 2, "steps/min": 0}
"""Unit -> digits after the point."""
_MOST: Final = 3  # measures that are named in one line
_BY: Final = {"cycle": "gait cycles", "repetition": "repetitions", "range": "the whole recordings"}
_REPEATS: Final = {"squat": "bends of the knees (squats or lunges)", "sit_to_stand": "rises from a seat"}


def name_of(measure: Measure) -> str:
    """Return the name of a measure in words, e.g. 'right knee flexion, range'."""
    text = label(measure.name)
    if measure.unit == "deg":
        angle, _, end = text.rpartition(" ")
        return f"{angle}, {end}"
    return text


def number(measure: Measure, value: float, sign: bool = False) -> str:
    """Return a value in its unit of output, without the unit; '' for NaN.

    Args:
        value: in the unit of computation.
    """
    if not np.isfinite(value):
        return ""
    text = f"{value * measure.scale:{'+' if sign else ''}.{DIGITS[measure.unit]}f}"
    return text if float(text) else text.replace("-", "").replace("+", "")


def opening(found: FollowUp) -> list[str]:
    """Return the first lines: what is not comparable, what is compared, and what changed."""
    lines = []
    if found.incomparable:
        count = len(found.incomparable)
        more = f"; and {count - 1} more, see the cautions" if count > 1 else ""
        lines.append(
            f"The visits may not be comparable: {found.incomparable[0].rstrip('.')}{more}. A change below "
            "may come from that and not from the patient."
        )
    first, last = found.visits[found.baseline], found.visits[found.last]
    over = _REPEATS.get(found.kind, _BY[found.by])
    trials = ", ".join(f"{visit.name} ({len(visit.trials)})" for visit in found.visits)
    lines.append(
        f"{len(found.visits)} visits with their trials: {trials}. Changes are from {first.name} to each "
        f"other visit; measured over {over}" + (f", as {found.why}." if found.why else ".")
    )
    lines += _verdicts(found, found.last, last.name)
    for number_, visit in enumerate(found.visits):
        if number_ not in (found.baseline, found.last):
            shown = [one for one in found.measures if one.changed(number_)]
            lines.append(f"{visit.name}: {_listed(shown, number_) or 'no change is shown'}.")
    return lines


def _verdicts(found: FollowUp, visit: int, name: str) -> list[str]:
    tested = [one for one in found.measures if one.outcome(visit) is not Outcome.NOT_TESTED]
    if not tested:
        return [f"{name}: nothing is tested ({found.measures[0].why_not or 'not observed'})."]
    shown = [one for one in tested if one.changed(visit)]
    level = f"{100 * LEVEL:.0f} % for all measures and visits together"
    if not shown:
        return [
            f"{name}: none of {len(tested)} measures is shown to have changed ({level}). That is not the "
            "same as unchanged: see what would have been detectable."
        ]
    count = len(shown)
    return [f"{name}: {count} of {len(tested)} measures changed ({level}): {_listed(shown, visit)}."]


def _listed(shown: Sequence[Followed], visit: int) -> str:
    """The changes with the smallest p-values."""

    def p(one: Followed) -> float:
        change = one.changes[visit]
        return 1.0 if change is None else change.p

    named = [
        f"{name_of(one.measure)} {one.outcome(visit)} "
        f"({number(one.measure, change.difference, True)} {one.measure.unit})"
        for one in sorted(shown, key=p)[:_MOST]
        if (change := one.changes[visit]) is not None
    ]
    more = f" and {len(shown) - _MOST} more" if len(shown) > _MOST else ""
    return "; ".join(named) + more


def reasoning(one: Followed, visit: int) -> str:
    """Return one sentence on why a measure has its outcome.

    Args:
        visit: index of the visit, not of the baseline.
    """
    change, outcome, unit = one.changes[visit], one.outcome(visit), one.measure.unit
    if change is None:
        return "Not observed, or not reliably, in this visit or in the baseline."
    text = f"{number(one.measure, change.difference, True)} {unit}"
    if outcome is Outcome.NOT_TESTED:
        return f"{text}, not tested: {one.why_not}."
    low, high = (number(one.measure, end, True) for end in change.interval)
    text += f" with a 95 % interval of {low} to {high} {unit}"
    if outcome is Outcome.NOT_SHOWN:
        needed = f"{number(one.measure, change.detectable)} {unit}"
        alone = number(one.measure, change.half_width(LEVEL))
        mostly = number(one.measure, one.mostly(visit))
        return (
            f"{text}; smallest change that could be shown among all measures: {needed} (of this one alone "
            f"{alone} {unit}), and a true change of {mostly} {unit} would be shown in 4 of 5 cases."
        )
    return f"{text}; p {_p(change)} among all measures and visits; {_direction(one, visit)}."


def _p(change: Change) -> str:
    return "< 0.001" if change.p_adjusted < 0.001 else f"= {change.p_adjusted:.3f}"


def _direction(one: Followed, visit: int) -> str:
    if one.better is None:
        return "no direction is known or declared to be better"
    if one.better == "zero" and not one.nearer_shown(visit):
        return "nearer to zero is better, but it is not shown which of the two is nearer"
    return "nearer to zero is better" if one.better == "zero" else f"{one.better} is better"


def cautions(found: FollowUp) -> list[str]:
    """Return what to be careful about."""
    lines = list(found.incomparable)
    unknown = [v.name for v in found.visits if any(not one.setup.software for one in v.trials)]
    if unknown:
        lines.append(
            f"Not known how all trials of {', '.join(unknown)} were recorded (no summary.json beside the "
            "motion): whether these visits are comparable was not checked in full"
        )
    if found.repeated is Repeated.STRIDES:
        lines.append(
            "Each visit has one trial: the spread between its strides or repetitions is included, but not "
            "how much the person varies from one trial to the next; record two trials or more at each visit"
        )
    elif found.repeated is Repeated.NOTHING:
        lines.append(
            "Nothing is repeated: how much the person varies from one trial to the next is not known and not "
            "included; record two trials or more at each visit"
        )
    else:
        lines += _of_trials(found)
    if found.by == "cycle":
        lines.append(
            "Times, cadence and stance of gait have no bands: errors that all trials of a visit share are "
            "not included there"
        )
    if not any(one.errors.bands.sem > 0 for one in found.measures):
        lines.append(
            "The motions have no bands: errors that all trials of a visit share (camera, mounting) are not included"
        )
    if found.by == "range":
        lines.append("Ranges are those of the whole recordings: they differ if the person did something else")
    if unequal := _unequal(found.measures):
        lines.append(
            f"Trials vary more in one visit than in another: {', '.join(unequal)}. One spread for all visits "
            "is used, which is too small for that visit"
        )
    return lines


def _of_trials(found: FollowUp) -> list[str]:
    lines = []
    single = [visit.name for visit in found.visits if len(visit.trials) == 1]
    if single:
        lines.append(f"One trial in {', '.join(single)}: its variation is taken from the visits with more trials")
    lines.append(
        "How much the person varies from one day to the next is not in the repeated trials of a day: a "
        "change is one between these days"
    )
    return lines


def _unequal(followed: Sequence[Followed]) -> list[str]:
    """Measures whose spread differs between visits, by Bartlett's test."""
    out = []
    for one in followed:
        groups = [own.values for own in one.visits if own is not None and np.ptp(own.values) > 0]
        if len(groups) > 1 and stats.bartlett(*groups).pvalue < LEVEL / len(followed):
            out.append(name_of(one.measure))
    return out


def definitions_of_sem(found: FollowUp) -> list[tuple[str, str]]:
    """Return the names of the three standard errors, and what each contains."""
    shares = found.measures[0].errors.shares
    divided = (
        f"{100 * shares.visit:.0f} % of their variance counts as common to the trials of a visit, "
        f"{100 * shares.trial:.0f} % as independent from trial to trial, and "
        f"{100 * shares.all_visits:.0f} % as common to all visits, which cancels"
    )
    twice = "Errors that differ from trial to trial are taken out of the bands, by at most what trials show"
    if not shares.trial:
        twice = (
            "Errors that differ from trial to trial are in the bands too, which do not say how large they "
            "are: it is too large rather than too small"
        )
    unit = {"trials": "trial", "strides": "stride or repetition", "nothing": "value"}[found.repeated]
    return [
        (
            "SEM, bands",
            "of a visit's value, by the bands of the reconstruction: errors of detector, sensors, camera, "
            f"mounting and model, also those that all trials of a visit share; {divided}. Not the variation "
            "of the person.",
        ),
        (
            "SEM, repeats",
            f"of one {unit}, by the spread within visits (analysis of variance, with its degrees of "
            "freedom): variation of the person, and errors that differ from trial to trial. Not errors that "
            "all trials of a visit share.",
        ),
        ("SEM, both", f"of a visit's value, the mean over its trials: both of these. {twice}."),
        (
            "MDC95",
            "the change between two visits that errors of that SEM alone exceed in 5 % of cases, of this "
            "measure by itself; 'detectable' is the same among all measures and visits.",
        ),
    ]
