"""Visits of one person beside each other, as a document: what changed, why, and what to be careful about.

``follow.csv`` has a row for each measure and visit, in the unit of the column ``unit``; ``follow.json`` the
sentences, the settings and the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import scipy
from markupsafe import Markup

from rtof_kin.clinical.comparison_change import LEVEL, MixedError
from rtof_kin.clinical.follow_up import Followed, FollowUp, Outcome, Repeated, follow_up
from rtof_kin.clinical.visits import Measure, Movement
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, some
from rtof_kin.reporting.angle_names import SIDE_COLORS, label, side_and_name
from rtof_kin.reporting.comparison import shared_line
from rtof_kin.reporting.document import (
    Badge,
    Cell,
    Document,
    Figure,
    Section,
    Table,
    fixed,
    label_panel,
    number,
    sentence,
    subplots,
)
from rtof_kin.reporting.visit_folders import Progress, read_visits

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

_DIGITS: Final = {"deg": 1, "%": 1, "s": 2, "m": 2, "m/s": 2, "steps/min": 0}
_MOST: Final = 3  # measures that are named in one line
_PRINTED: Final = 14  # measures in the printed table, unless they are chosen
_BY: Final = {"cycle": "gait cycles", "repetition": "repetitions", "range": "the whole recordings"}
_REPEATS: Final = {"squat": "bends of the knees (squats or lunges)", "sit_to_stand": "rises from a seat"}
_GRADES: Final = {Outcome.IMPROVED: "pass", Outcome.WORSE: "fail", Outcome.CHANGED: "warn"}
_MARKS: Final = {Outcome.IMPROVED: "^", Outcome.WORSE: "v", Outcome.CHANGED: "D"}  # in figures
_FIGURES: Final = {
    "changed": "measures with a change",
    "gait": "gait",
    "range": "range of motion",
    "mean": "mean angle",
    "max": "largest angle",
    "min": "smallest angle",
}
_OPEN: Final = 2  # figures of the page that are not folded
_PANELS: Final = 4  # in a row of a figure
_SHIFT: Final = 0.012  # of the axis of a figure, between the sides


def follow(
    folder: str | Path | Sequence[str | Path],
    *,
    baseline: str = "",
    by: Movement | None = None,
    kind: str = "",
    measures: Sequence[str] = (),
    progress: Progress | None = None,
) -> Document:
    """Compare the visits of one person, which have a folder each. `FileFormatError`: there are no two visits, or a file
    is damaged; `UnknownNameError`: of a visit or measure.

    Args:
        folder: see `rtof_kin.reporting.visit_folders`; ``follow.toml`` in it may declare the same and more. Or the
            folders of the visits.
        baseline: visit that the others are compared with; default: the first.
        by, kind, measures: see `follow_up`.
        progress: called with the number of trials read, and of all.
    """
    read = read_visits(folder, progress)
    plan, first = read.plan, read.baseline
    if baseline:
        names = [visit.name for visit in read.visits]
        first = indices_of("visit", [plan.names.get(baseline, baseline)], names)[0]
    found = follow_up(
        read.visits,
        baseline=first,
        by=by or plan.by,
        kind=kind or plan.repetitions,
        better=plan.better,
        names=list(measures) or list(plan.measures),
    )
    return document(found, read.notes, all_printed=bool(measures))


def document(found: FollowUp, notes: Sequence[str] = (), all_printed: bool = False) -> Document:
    """Return a follow-up as a document; notes: cautions about the input; all_printed: whether the terminal shows all
    measures.
    """
    headline, *others = _opening(found)
    subject = found.visits[0].trials[0].setup.subject or "Follow-up"
    figures = _figures(found)
    return Document(
        "follow",
        f"{subject}: change over {len(found.visits)} visits",
        headline,
        others,
        [*notes, *_cautions(found)],
        bool(found.incomparable),
        printed=_printed(found, all_printed),
        sections=[
            Section("changes", f"Changes from {found.visits[found.baseline].name}", [_NOTE, *_changes(found)]),
            Section(
                "figures",
                "Over the visits",
                [
                    Section("", sentence(title), [figure], folded=k >= _OPEN)
                    for k, (title, figure) in enumerate(figures.items())
                ],
            ),
            Section(
                "errors",
                "Standard errors of measurement, and minimal detectable changes",
                [_definitions(found), _errors(found)],
            ),
            Section("left-out", "Left out", [tuple(f"{k}: {v}" for k, v in found.left_out.items()) or "Nothing."]),
        ],
        figures=list(figures.values()),
        tables={"follow.csv": table(found)},
        facts=_facts(found),
    )


def name_of(measure: Measure) -> str:
    """Return the name of a measure in words, e.g. 'right knee flexion, range'."""
    text = label(measure.name)
    if measure.unit == "deg":
        angle, _, end = text.rpartition(" ")
        return f"{angle}, {end}"
    return text


def value_text(measure: Measure, value: float, sign: bool = False) -> str:
    """Return a value, in the unit of computation, in that of output, without the unit; '' for NaN."""
    return fixed(value * measure.scale, _DIGITS[measure.unit], sign)


def _opening(found: FollowUp) -> list[str]:
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
    for v, visit in enumerate(found.visits):
        if v not in (found.baseline, found.last):
            shown = [one for one in found.measures if one.changed(v)]
            lines.append(f"{visit.name}: {_listed(shown, v) or 'no change is shown'}.")
    people = {one.setup.person for visit in found.visits for one in visit.trials}
    if len(people) > 1 and len({person[0] for person in people if person}) == 1:
        lines.append(
            "Not all trials were made with the same bones and posture of the person's file, so that no error is taken "
            "as shared: reconstruct all of them with the file as it is now."
        )
    return lines + shared_line(found.shared, (one.changes[found.last] for one in found.measures))


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
        f"({value_text(one.measure, change.difference, True)} {one.measure.unit})"
        for one in sorted(shown, key=p)
        if (change := one.changes[visit]) is not None
    ]
    return some(named, _MOST, "; ")


def reasoning(one: Followed, visit: int) -> str:
    """Return one sentence on why a measure has its outcome at a visit, not the baseline."""
    change, outcome, unit = one.changes[visit], one.outcome(visit), one.measure.unit
    if change is None:
        return "Not observed, or not reliably, in this visit or in the baseline."
    text = f"{value_text(one.measure, change.difference, True)} {unit}"
    if outcome is Outcome.NOT_TESTED:
        return f"{text}, not tested: {one.why_not}."
    low, high = (value_text(one.measure, end, True) for end in change.interval)
    text += f" with a 95 % interval of {low} to {high} {unit}"
    if outcome is Outcome.NOT_SHOWN:
        needed = f"{value_text(one.measure, change.detectable)} {unit}"
        alone = value_text(one.measure, change.error.half_width(LEVEL))
        apart = value_text(one.measure, change.detectable_independent)
        apart = f"; of independent recordings it would be {apart} {unit}" if apart else ""
        mostly = value_text(one.measure, one.mostly(visit))
        return (
            f"{text}; smallest change that could be shown among all measures: {needed} (of this one alone "
            f"{alone} {unit}{apart}), and a true change of {mostly} {unit} would be shown in 4 of 5 cases."
        )
    p = "< 0.001" if change.p_adjusted < 0.001 else f"= {change.p_adjusted:.3f}"
    direction = f"{one.better} is better"
    if one.better is None:
        direction = "no direction is known or declared to be better"
    elif one.better == "zero":
        nearer = "" if one.nearer_shown(visit) else ", but it is not shown which of the two is nearer"
        direction = f"nearer to zero is better{nearer}"
    return f"{text}; p {p} among all measures and visits; {direction}."


def _cautions(found: FollowUp) -> list[str]:
    """Return what to be careful about."""
    lines = list(found.incomparable)
    unknown = [v.name for v in found.visits if any(not one.setup.software for one in v.trials)]
    if unknown:
        lines.append(
            f"Not known how all trials of {', '.join(unknown)} were recorded (no summary.json beside the "
            "motion): whether these visits are comparable was not checked in full"
        )
    certified = {visit.name: [one.setup.certified for one in visit.trials] for visit in found.visits}
    certified = {name: [size for size in own if math.isfinite(size)] for name, own in certified.items()}
    if any(certified.values()):
        sizes = (f"{name} {max(own):.1f} deg" if own else f"{name} not certified" for name, own in certified.items())
        lines.append(
            f"A segment without its sensor is predicted to: {', '.join(sizes)} (the worst trial of each visit)"
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
        if single := [visit.name for visit in found.visits if len(visit.trials) == 1]:
            lines.append(f"One trial in {', '.join(single)}: its variation is taken from the visits with more trials")
        lines.append(
            "How much the person varies from one day to the next is not in the repeated trials of a day: a "
            "change is one between these days"
        )
    if found.by == "cycle":
        lines.append(
            "Times, cadence and stance of gait have no bands: errors that all trials of a visit share are "
            "not included there"
        )
    if not any(one.errors.bands.sigma > 0 for one in found.measures):
        lines.append(
            "The motions have no bands: errors that all trials of a visit share (camera, mounting) are not included"
        )
    if found.by == "range":
        lines.append("Ranges are those of the whole recordings: they differ if the person did something else")
    unequal = []  # measures whose spread differs between visits, by Bartlett's test
    for one in found.measures:
        groups = [own.values for own in one.visits if own is not None and np.ptp(own.values) > 0]
        if len(groups) > 1 and scipy.stats.bartlett(*groups).pvalue < LEVEL / len(found.measures):
            unequal.append(name_of(one.measure))
    if unequal:
        lines.append(
            f"Trials vary more in one visit than in another: {', '.join(unequal)}. One spread for all visits "
            "is used, which is too small for that visit"
        )
    return lines


def _definitions(found: FollowUp) -> dict[str, str]:
    """Name of each standard error -> what it contains."""
    unit = {"trials": "trial", "strides": "stride or repetition", "nothing": "value"}[found.repeated]
    return {
        "SEM, bands": "of a visit's value, by the bands of the reconstruction: errors of detector, sensors, camera, "
        "mounting and model, all taken as common to the trials of a visit. Not the variation of the person.",
        "SEM, repeats": f"of one {unit}, by the spread within visits (analysis of variance, with its degrees of "
        "freedom): variation of the person, and errors that differ from trial to trial. Not errors that "
        "all trials of a visit share.",
        "SEM, both": "of a visit's value, the mean over its trials: both of these. Errors that differ from trial to "
        "trial are in the bands too, which do not say how large they are: it is too large rather than too small.",
        "MDC95": "the change between two visits that errors of that SEM alone exceed in 5 % of cases, of this "
        "measure by itself; 'detectable' is the same among all measures and visits.",
    }


# --- tables --------------------------------------------------------------------------------------

_NOTE: Final = Markup(
    '<p class="note">Values &plusmn; one standard deviation. The outcome is that of a two-sided test at {:.0f} % for '
    "all measures and visits together (Holm). <i>Not shown</i> is not <i>unchanged</i>: the last column says which "
    "change could have been shown.</p>"
).format(100 * LEVEL)
_ERRORS: Final = (
    *("measure", "SEM, bands", "MDC95, bands", "SEM, repeats (degrees of freedom)", "MDC95, repeats"),
    *("SEM, both", "MDC95, both"),
)


def _printed(found: FollowUp, all_of_them: bool) -> list[Table | str]:
    """Table of the last visit against the baseline; those that changed first, then the smallest p-values."""
    visit = found.last

    def key(one: Followed) -> tuple[float, float]:
        change = one.changes[visit]
        return (2.0, 1.0) if change is None else (float(change.p != change.p), change.p)

    ordered = sorted(found.measures, key=key)
    shown = ordered if all_of_them else ordered[:_PRINTED]
    rows = []
    for one in shown:
        change, measure, both = one.changes[visit], one.measure, one.errors.both
        sizes = (math.nan, math.nan) if change is None else (change.difference, change.detectable)
        rows.append(
            (
                f"{name_of(measure)} [{measure.unit}]",
                *(value_text(measure, one.estimates[v]) for v in (found.baseline, visit)),
                value_text(measure, sizes[0], True),
                *(value_text(measure, value) for value in (sizes[1], both.sigma, both.mdc95)),
                _badge(one, visit),
            )
        )
    columns = ("measure", "from", "to", "change", "detect-\nable", "SEM", "MDC95", "outcome")
    return [
        f"From {found.visits[found.baseline].name} to {found.visits[visit].name}:",
        Table(columns, rows),
        *(f"{name_of(one.measure)}: {reasoning(one, visit)}" for one in shown[:3]),
        *([f"and {len(ordered) - len(shown)} more: -o OUT, or --measures"] if len(shown) < len(ordered) else []),
    ]


def table(found: FollowUp) -> Table:
    """Return the row of each measure and visit, None for what there is not."""
    return Table.of([_row(found, one, v) for one in found.measures for v in range(len(found.visits))])


def _row(found: FollowUp, one: Followed, visit: int) -> dict[str, Cell]:
    here, change, scale, own = found.visits[visit], one.changes[visit], one.measure.scale, one.visits[visit]

    def size(value: float) -> float | None:
        return number(scale * value)

    bands, trials, both = (one.errors.bands, one.errors.trials, one.errors.both)
    sizes, tests = [math.nan] * 5, [math.nan] * 2
    if change is not None:
        sizes = [change.difference, *change.interval, change.detectable, one.mostly(visit)]
        tests = [change.p, change.p_adjusted]
    difference, low, high, detectable, mostly = map(size, sizes)
    return {
        "measure": one.measure.name,
        "unit": one.measure.unit,
        "visit": here.name,
        "day": here.day.isoformat() if here.day else None,
        "trials": 0 if own is None else len(own.values),
        "value": size(one.estimates[visit]),
        "sd": size(one.sigmas[visit]),
        "change": difference,
        "interval_low": low,
        "interval_high": high,
        "outcome": None if visit == found.baseline else one.outcome(visit).value,
        "detectable": detectable,
        "detectable_independent": None if change is None else size(change.detectable_independent),
        "shown_in_4_of_5": mostly,
        "p": number(tests[0]),
        "p_holm": number(tests[1]),
        "better": one.better,
        "sem_bands": size(bands.sigma),
        "sem_repeats": size(trials.sigma),
        "sem_repeats_dof": number(trials.effective_dof),
        "sem_both": size(both.sigma),
        "mdc95_bands": size(bands.mdc95),
        "mdc95_repeats": size(trials.mdc95),
        "mdc95_both": size(both.mdc95),
    }


def _changes(found: FollowUp) -> list[Section]:
    """A section for each visit but the baseline, the last one first and open, those without a change folded."""
    order = [found.last, *(v for v in range(len(found.visits)) if v not in (found.baseline, found.last))]
    out = []
    for visit in order:
        columns = ("measure", found.visits[found.baseline].name, found.visits[visit].name, "outcome", "why")
        ordered = sorted(found.measures, key=lambda one: list(Outcome).index(one.outcome(visit)))
        shown, rest = ([one for one in ordered if one.changed(visit) is changed] for changed in (True, False))
        tables = [
            Table(columns, [_change_cells(found, one, visit) for one in own], kind="differences reasons")
            for own in (shown, rest)
        ]
        parts: list[Any] = [tables[0] if shown else "No change is shown."]
        if rest:
            parts.append(Section("", f"{len(rest)} measures without a change that is shown", [tables[1]], folded=True))
        out.append(Section("", f"Changes at {found.visits[visit].name}", parts, folded=visit != found.last))
    return out


def _change_cells(found: FollowUp, one: Followed, visit: int) -> tuple[Cell, ...]:
    values = []
    for v in (found.baseline, visit):
        text, spread = (value_text(one.measure, x) for x in (one.estimates[v], one.sigmas[v]))
        text += f" \u00b1 {spread}" if spread else ""
        values.append(f"{text} {one.measure.unit}" if text else "")
    return _title(one), *values, _badge(one, visit), reasoning(one, visit)


def _badge(one: Followed, visit: int) -> Badge:
    outcome = one.outcome(visit)
    return Badge(outcome.value, _GRADES.get(outcome, "not-checked"))


def _title(one: Followed) -> Markup:
    positive = Markup(" <small>{}</small>").format(one.measure.positive) if one.measure.positive else ""
    return Markup("{}{}").format(name_of(one.measure), positive)


def _errors(found: FollowUp) -> Table:
    def pair(one: Followed, error: MixedError, more: str = "") -> tuple[str, str]:
        sem, mdc = (value_text(one.measure, value) for value in (error.sigma, error.mdc95))
        return (f"{sem} {one.measure.unit}{more}", f"{mdc} {one.measure.unit}") if sem else ("", "")

    rows = []
    for one in found.measures:
        errors = one.errors
        dof = f" ({errors.trials.dof:.0f})" if errors.trials.sigma > 0 else ""
        rows.append((_title(one), *pair(one, errors.bands), *pair(one, errors.trials, dof), *pair(one, errors.both)))
    return Table(_ERRORS, rows, kind="errors")


def _facts(found: FollowUp) -> dict[str, Any]:
    return {
        "visits": [
            {
                "name": visit.name,
                "day": visit.day.isoformat() if visit.day else None,
                "trials": [one.name for one in visit.trials],
            }
            for visit in found.visits
        ],
        "baseline": found.visits[found.baseline].name,
        "by": found.by,
        "repetitions": found.kind,
        "repeated": found.repeated.value,
        "level": LEVEL,
        "correction": "Holm, over all rows with a p",
        "comparable": not found.incomparable,
        "shared": dict(found.shared),
        "definitions": _definitions(found),
        "measures": [_measure_facts(found, one) for one in found.measures],
        "rows": table(found).records(),
        "left_out": dict(found.left_out),
    }


def _measure_facts(found: FollowUp, one: Followed) -> dict[str, Any]:
    scale, errors = one.measure.scale, one.errors
    return {
        "name": one.measure.name,
        "unit": one.measure.unit,
        "positive": one.measure.positive,
        "better": one.better,
        "why_not_tested": one.why_not,
        "values": [None if own is None else [number(scale * value) for value in own.values] for own in one.visits],
        "band_sd": [None if own is None else number(scale * own.band_sigma) for own in one.visits],
        "errors": {
            name: {"sem": number(scale * error.sigma), "degrees_of_freedom": number(error.effective_dof)}
            | {"mdc95": number(scale * error.mdc95)}
            for name, error in (("bands", errors.bands), ("repeats", errors.trials), ("both", errors.both))
        },
        "reasoning": {visit.name: reasoning(one, v) for v, visit in enumerate(found.visits) if v != found.baseline},
    }


# --- figures -------------------------------------------------------------------------------------


def _figures(found: FollowUp) -> dict[str, Figure]:
    """Title -> figure of what changed, of gait, and of each statistic of the angles."""
    visits = range(len(found.visits))
    changed = {side_and_name(one.measure.name)[1] for one in found.measures if any(map(one.changed, visits))}
    both = [one for one in found.measures if side_and_name(one.measure.name)[1] in changed]
    groups = {"changed": both} if both else {}
    for one in found.measures:
        kind = "gait" if one.measure.is_gait else one.measure.name.rpartition("_")[2]
        groups.setdefault(kind, []).append(one)
    out = {}
    for kind, title in _FIGURES.items():
        if kind in groups:
            alt = f"{title} over the visits, with 95 % bands; the numbers are in the tables"
            out[title] = Figure(f"figures/{kind}", alt, partial(trajectories, found, groups[kind], title))
    return out


def trajectories(found: FollowUp, measures: Sequence[Followed], title: str) -> Plot:
    """Plot measures over visits, both sides in one panel."""
    panels: dict[tuple[str, str], list[Followed]] = {}
    for one in measures:
        name = side_and_name(one.measure.name)[1]
        panels.setdefault((name, one.measure.unit), []).append(one)
    lines = math.ceil(len(panels) / _PANELS)
    figure, axes = subplots(lines, _PANELS, (13, 0.9 + 2.2 * lines))
    grid = axes.ravel()
    days = [visit.day.toordinal() for visit in found.visits if visit.day is not None]
    if len(set(days)) < len(found.visits):  # then they are numbered
        days = list(range(len(found.visits)))
    x, names = np.array(days, dtype=float), [visit.name for visit in found.visits]
    for ax, ((name, unit), own) in zip(grid, panels.items(), strict=False):
        for one in own:
            _plot(ax, found, one, x)
        label_panel(ax, name_of(replace(own[0].measure, name=name)), f"[{unit}]")
        ax.margins(x=0.08)
        ax.set_xticks(x, names, fontsize=7, rotation=15)
    for ax in grid[len(panels) :]:
        ax.set_axis_off()
    figure.suptitle(
        f"{sentence(title)} over visits with 95 % bands; dots: trials; blue: right, red: left; "
        "large marks: change from the baseline (up: improved, down: worse, diamond: changed)",
        fontsize=10,
    )
    return figure


def _plot(ax: Any, found: FollowUp, one: Followed, x: Array) -> None:
    side = side_and_name(one.measure.name)[0]
    color, scale = SIDE_COLORS[side], one.measure.scale
    x = x + {"right": -1, "left": 1, "": 0}[side] * _SHIFT * float(np.ptp(x) or 1.0)
    y, half = scale * one.estimates, scale * one.half_bands
    ax.errorbar(x, y, yerr=np.nan_to_num(half), color=color, lw=1.2, capsize=2, label=side or None)
    for visit, own in enumerate(one.visits):
        if own is not None and len(own.values) > 1:
            ax.plot(np.full(len(own.values), x[visit]), scale * own.values, ".", color=color, ms=4, alpha=0.5)
        if mark := _MARKS.get(one.outcome(visit)) if visit != found.baseline else None:
            ax.plot(x[visit], y[visit], mark, color=color, ms=9)
