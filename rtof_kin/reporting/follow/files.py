"""Folder of a follow-up: ``follow.csv``, ``follow.json``, ``follow.html`` and figures.

The table has a row for each measure and visit, in the unit of the column ``unit``; empty cells where there
is no value. The JSON has the sentences, the settings and the same numbers.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.comparison_change import LEVEL
from rtof_kin.clinical.follow_up import Followed, FollowUp
from rtof_kin.clinical.measurement_error import Sem
from rtof_kin.core.packages import can_draw
from rtof_kin.reporting.follow.page import page
from rtof_kin.reporting.follow.sentences import cautions, definitions_of_sem, opening, reasoning

MARKER: Final = "follow.json"
TABLE: Final = "follow.csv"
PAGE: Final = "follow.html"
COLUMNS: Final = (
    "measure",
    "unit",
    "visit",
    "day",
    "trials",
    "value",
    "sd",
    "change",
    "interval_low",
    "interval_high",
    "outcome",
    "detectable",
    "shown_in_4_of_5",
    "p",
    "p_holm",
    "better",
    "sem_bands",
    "sem_repeats",
    "sem_repeats_dof",
    "sem_both",
    "mdc95_bands",
    "mdc95_repeats",
    "mdc95_both",
)


def write_follow_up(found: FollowUp, folder: str | Path, notes: Sequence[str] = ()) -> None:
    """Write all files into an existing folder."""
    folder = Path(folder)
    with (folder / TABLE).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for row in rows(found):
            writer.writerow("" if value is None else value for value in row.values())
    text = json.dumps(plain(found, notes), indent=2, allow_nan=False)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")
    pictures: dict[str, Path] = {}
    if can_draw():
        from rtof_kin.reporting.follow.figures import write_trajectories

        pictures = write_trajectories(found, folder / "figures")
    (folder / PAGE).write_text(page(found, pictures, notes), encoding="utf-8", newline="\n")


def plain(found: FollowUp, notes: Sequence[str] = ()) -> dict[str, Any]:
    """Return a follow-up as plain data."""
    shares = found.measures[0].errors.shares
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
        "band_shares": {"all_visits": shares.all_visits, "visit": shares.visit, "trial": shares.trial},
        "comparable": not found.incomparable,
        "sentences": opening(found),
        "cautions": [*notes, *cautions(found)],
        "definitions": dict(definitions_of_sem(found)),
        "measures": [_measure(found, one) for one in found.measures],
        "rows": list(rows(found)),
        "left_out": dict(found.left_out),
    }


def rows(found: FollowUp) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table, None for what there is not; see `COLUMNS`."""
    for one in found.measures:
        for visit in range(len(found.visits)):
            yield dict(zip(COLUMNS, _row(found, one, visit), strict=True))


def _row(found: FollowUp, one: Followed, visit: int) -> list[Any]:
    place, change, scale = found.visits[visit], one.changes[visit], one.measure.scale
    nan, own = float("nan"), one.visits[visit]
    figures = (
        [nan] * 5 if change is None else [change.difference, *change.interval, change.detectable, one.mostly(visit)]
    )
    size, low, high, needed, mostly = (_number(scale * value) for value in figures)
    p = (nan, nan) if change is None else (change.p, change.p_adjusted)
    errors = (one.errors.bands, one.errors.trials, one.errors.both)
    return [
        one.measure.name,
        one.measure.unit,
        place.name,
        place.day.isoformat() if place.day else None,
        0 if own is None else len(own.values),
        _number(scale * one.estimates[visit]),
        _number(scale * one.sigmas[visit]),
        size,
        low,
        high,
        None if visit == found.baseline else one.outcome(visit).value,
        needed,
        mostly,
        *map(_number, p),
        one.better,
        _number(scale * errors[0].sem),
        _number(scale * errors[1].sem),
        _number(errors[1].dof),
        _number(scale * errors[2].sem),
        *(_number(scale * sem.mdc95) for sem in errors),
    ]


def _measure(found: FollowUp, one: Followed) -> dict[str, Any]:
    scale = one.measure.scale
    return {
        "name": one.measure.name,
        "unit": one.measure.unit,
        "positive": one.measure.positive,
        "better": one.better,
        "why_not_tested": one.why_not,
        "values": [None if own is None else [_number(scale * value) for value in own.values] for own in one.visits],
        "band_sd": [None if own is None else _number(scale * own.band_sigma) for own in one.visits],
        "errors": {
            "bands": _sem(one.errors.bands, scale),
            "repeats": _sem(one.errors.trials, scale),
            "both": _sem(one.errors.both, scale),
        },
        "reasoning": {
            found.visits[visit].name: reasoning(one, visit)
            for visit in range(len(found.visits))
            if visit != found.baseline
        },
    }


def _sem(error: Sem, scale: float) -> dict[str, float | None]:
    return {
        "sem": _number(scale * error.sem),
        "degrees_of_freedom": _number(error.dof),
        "mdc95": _number(scale * error.mdc95),
    }


def _number(value: Any) -> float | None:
    """Six digits; None, which is null in JSON, for NaN and infinity."""
    return float(f"{float(value):.6g}") if np.isfinite(value) else None
