"""Folder of a comparison: ``comparison.csv``, ``comparison.json`` and ``comparison.html``.

The table has a row for each angle and measure, with units in the names of its columns and empty cells where
there is no value; the JSON has the sentences, the settings and the same numbers.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.comparison import AngleComparison, Comparison
from rtof_kin.clinical.comparison_change import LEVEL, Change
from rtof_kin.reporting.comparison.page import page
from rtof_kin.reporting.comparison.sentences import cautions, opening

MARKER: Final = "comparison.json"
TABLE: Final = "comparison.csv"
PAGE: Final = "comparison.html"
COLUMNS: Final = (
    "angle",
    "positive",
    "measure",
    "verdict",
    "a_deg",
    "b_deg",
    "difference_deg",
    "difference_sd_deg",
    "interval_low_deg",
    "interval_high_deg",
    "detectable_deg",
    "p",
    "p_holm",
    "rmse_deg",
    "mae_deg",
    "median_absolute_error_deg",
    "rmse_without_offset_deg",
    "largest_deg",
    "largest_at",
    "correlation",
    "outside_band_share",
    "share",
    "repeats_a",
    "repeats_b",
)


def write_comparison(found: Comparison, folder: str | Path, why: str = "") -> None:
    """Write all files into an existing folder."""
    folder = Path(folder)
    with (folder / TABLE).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for row in rows(found):
            writer.writerow("" if value is None else value for value in row.values())
    text = json.dumps(plain(found, why), indent=2, allow_nan=False)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")
    (folder / PAGE).write_text(page(found, why), encoding="utf-8", newline="\n")


def plain(found: Comparison, why: str = "") -> dict[str, Any]:
    """Return a comparison as plain data."""
    clocks = found.alignment
    return {
        "a": found.a.name,
        "b": found.b.name,
        "differences": "B - A",
        "by": found.by,
        "repetitions": found.kind,
        "shift_of_b_s": found.shift,
        "agreement": None
        if clocks is None
        else {
            "at_the_shift": _number(clocks.unshifted),
            "best": _number(clocks.agreement),
            "best_further_shift_s": _number(clocks.shift),
            "best_further_shift_sd_s": _number(clocks.sigma),
            "second_best_further_shift_s": _number(clocks.rival),
            "second_best": _number(clocks.rival_agreement),
        },
        "identical": found.identical,
        "level": LEVEL,
        "correction": "Holm, over all rows with a p",
        "largest_at_is": "s" if found.by == "time" else "share of the cycle or repetition",
        "sentences": opening(found, why),
        "cautions": cautions(found),
        "angles": list(rows(found)),
        "not_compared": dict(found.left_out),
    }


def rows(found: Comparison) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table, None for what there is not; see `COLUMNS`."""
    for one in found.angles:
        for change in one.changes:
            yield dict(zip(COLUMNS, _row(one, change), strict=True))


def _row(one: AngleComparison, change: Change) -> list[Any]:
    nan, errors = float("nan"), one.errors
    sizes = (
        (nan,) * 5
        if errors is None
        else (errors.rmse, errors.mae, errors.median, errors.offset_removed, errors.largest)
    )
    figures = (change.a, change.b, change.difference, change.sigma, *change.interval, change.detectable)
    others = (nan, nan) if errors is None else (errors.at, errors.correlation)
    return [
        one.name,
        one.positive,
        change.measure,
        change.verdict.value,
        *(_number(np.degrees(value)) for value in figures),
        _number(change.p),
        _number(change.p_adjusted),
        *(_number(np.degrees(value)) for value in sizes),
        *map(_number, others),
        _number(one.outside),
        _number(one.share),
        *one.repeats,
    ]


def _number(value: Any) -> float | None:
    """Six digits; None, which is null in JSON, for NaN."""
    return float(f"{float(value):.6g}") if np.isfinite(value) else None
