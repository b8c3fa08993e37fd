"""Page of a follow-up: sentences, tables and figures in one HTML file that opens offline."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Final

from rtof_kin.clinical.comparison_change import LEVEL
from rtof_kin.clinical.follow_up import Followed, FollowUp, Outcome
from rtof_kin.clinical.measurement_error import Sem
from rtof_kin.reporting.follow.sentences import cautions, definitions_of_sem, name_of, number, opening, reasoning
from rtof_kin.reporting.html import asset, bullets, definitions, fill, folded, source_hash, table

_STYLES: Final = ("page.css", "comparison.css", "follow.css")
_GRADES: Final = {Outcome.IMPROVED: "pass", Outcome.WORSE: "fail", Outcome.CHANGED: "warn"}
_ERRORS: Final = (
    "measure",
    "SEM, bands",
    "MDC95, bands",
    "SEM, repeats (degrees of freedom)",
    "MDC95, repeats",
    "SEM, both",
    "MDC95, both",
)
_OPEN: Final = 2  # figures that are not folded


def page(found: FollowUp, pictures: Mapping[str, Path], notes: Sequence[str] = ()) -> str:
    """Return the self-contained HTML page."""
    style = "".join(map(asset, _STYLES))
    subject = found.visits[0].trials[0].setup.subject or "Follow-up"
    lines = opening(found)
    alarm = ' class="alarm"' if found.incomparable else ""
    parts = {
        "title": escape(f"{subject}: change over {len(found.visits)} visits"),
        "style": style,
        "style_hash": source_hash(style),
        "opening": f"<p{alarm}>{escape(lines[0])}</p>" + "".join(f"<p>{escape(x)}</p>" for x in lines[1:]),
        "cautions": bullets([*notes, *cautions(found)]),
        "changes": _changes(found),
        "level": f"{100 * LEVEL:.0f} %",
        "baseline": escape(found.visits[found.baseline].name),
        "figures": _figures(pictures),
        "definitions": definitions(definitions_of_sem(found)),
        "errors": table(_ERRORS, map(_error_cells, found.measures), "errors"),
        "left_out": bullets(f"{name}: {reason}" for name, reason in found.left_out.items()) or "<p>Nothing.</p>",
    }
    return fill(asset("follow.html"), parts)


def _changes(found: FollowUp) -> str:
    """A table for each visit but the baseline, the last one first and open."""
    order = [found.last, *(v for v in range(len(found.visits)) if v not in (found.baseline, found.last))]
    out = []
    for visit in order:
        header = ("measure", found.visits[found.baseline].name, found.visits[visit].name, "outcome", "why")
        inside = _change_table(found, visit, header)
        title = f"Changes at {found.visits[visit].name}"
        out.append(f"<h3>{escape(title)}</h3>{inside}" if visit == found.last else folded(title, inside))
    return "\n".join(out)


def _change_table(found: FollowUp, visit: int, header: Sequence[str]) -> str:
    """The changes that are shown, and folded all others."""
    others = (Outcome.NOT_SHOWN, Outcome.NOT_TESTED)
    shown = [one for one in found.measures if one.changed(visit)]
    shown.sort(key=lambda one: list(Outcome).index(one.outcome(visit)))
    rest = [one for outcome in others for one in found.of(outcome, visit)]
    parts = ["<p>No change is shown.</p>"]
    if shown:
        parts = [table(header, (_change_cells(found, one, visit) for one in shown), "differences")]
    if rest:
        inside = table(header, (_change_cells(found, one, visit) for one in rest), "differences")
        parts.append(folded(f"{len(rest)} measures without a change that is shown", inside))
    return "\n".join(parts)


def _change_cells(found: FollowUp, one: Followed, visit: int) -> tuple[str, ...]:
    outcome = one.outcome(visit)
    return (
        _title(one),
        _value(one, found.baseline),
        _value(one, visit),
        f'<span class="grade {_GRADES.get(outcome, "not-checked")}">{outcome.value}</span>',
        escape(reasoning(one, visit)),
    )


def _title(one: Followed) -> str:
    positive = f" <small>{escape(one.measure.positive)}</small>" if one.measure.positive else ""
    return f"{escape(name_of(one.measure))}{positive}"


def _value(one: Followed, visit: int) -> str:
    value, sigma = one.estimates[visit], one.sigmas[visit]
    if not (text := number(one.measure, value)):
        return ""
    spread = f" &plusmn; {number(one.measure, sigma)}" if sigma == sigma else ""
    return f"{text}{spread} {escape(one.measure.unit)}"


def _error_cells(one: Followed) -> tuple[str, ...]:
    errors, unit = one.errors, escape(one.measure.unit)
    dof = f" ({errors.trials.dof:.0f})" if errors.trials.sem > 0 else ""

    def pair(error: Sem, more: str = "") -> tuple[str, str]:
        sem, mdc = number(one.measure, error.sem), number(one.measure, error.mdc95)
        return (f"{sem} {unit}{more}", f"{mdc} {unit}") if sem else ("", "")

    return _title(one), *pair(errors.bands), *pair(errors.trials, dof), *pair(errors.both)


def _figures(pictures: Mapping[str, Path]) -> str:
    if not pictures:
        return "<p>No figures: matplotlib is not installed.</p>"
    out = []
    for place, (title, path) in enumerate(pictures.items()):
        data = base64.b64encode(path.read_bytes()).decode()
        words = f"{title} over the visits, with 95 % bands; the numbers are in the tables"
        image = f'<img src="data:image/png;base64,{data}" alt="{escape(words, quote=True)}">'
        shown = f"<h3>{escape(title[:1].upper() + title[1:])}</h3>{image}"
        out.append(shown if place < _OPEN else folded(title[:1].upper() + title[1:], image))
    return "\n".join(out)
