"""Folder of gait scores: ``gait_scores.json``, ``gait_scores.csv`` and ``gait_curves.csv``; degrees.

The first table has a row for each variable, side and profile score; the second the mean curves of both sides
with their standard deviations by the poses and between strides, and mean and deviation of the reference.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.gait_scores import Score
from rtof_kin.data.gait_reference import NAMES, PERCENT
from rtof_kin.reporting.gait.result import ScoredGait
from rtof_kin.reporting.gait.sentences import cautions, opening

MARKER: Final = "gait_scores.json"
TABLE: Final = "gait_scores.csv"
CURVES: Final = "gait_curves.csv"
COLUMNS: Final = (
    "score",
    "side",
    "value_deg",
    "low_deg",
    "high_deg",
    "noise_deg",
    "corrected_deg",
    "pose_sigma_deg",
    "stride_sigma_deg",
    "spread_between_strides_deg",
    "strides",
    "reference_median_deg",
)


def write_gait_scores(found: ScoredGait, folder: str | Path) -> None:
    """Write all files into an existing folder."""
    folder = Path(folder)
    text = json.dumps(plain(found), indent=2, allow_nan=False)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")
    _write_csv(folder / TABLE, COLUMNS, (row.values() for row in rows(found)))
    if found.scores is not None:
        columns = _curves(found)
        _write_csv(folder / CURVES, tuple(columns), zip(*columns.values(), strict=True))


def plain(found: ScoredGait) -> dict[str, Any]:
    """Return the scores as plain data."""
    reference, cycles = found.reference, found.cycles
    return {
        "motion": found.name,
        "is_gait": found.scores is not None,
        "why_not": cycles.why_not,
        "sentences": opening(found),
        "cautions": cautions(found),
        "strides": {side: cycles.sides.count(side) for side in ("right", "left")},
        "speed_m_per_s": _number(cycles.speed),
        "scores": list(rows(found)),
        "missing": found.missing,
        "overall_is": "nine variables of the left side and six of the right; the pelvis counts once",
        "band": "95 %, for errors of any correlation in time and between angles",
        "gdi": {
            side: {
                "value": _number(one.value),
                "low": _number(one.low),
                "high": _number(one.high),
                "explained_share": _number(one.explained),
            }
            for side, one in found.index.items()
        },
        "why_no_gdi": found.why_no_index,
        "reference": {
            "people": reference.people,
            "system": reference.system,
            "zero": reference.zero,
            "source": reference.source,
            "licence": reference.licence,
            "speed_m_per_s": None if reference.speed_range is None else list(reference.speed_range),
        },
    }


def rows(found: ScoredGait) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table, None for what there is not; none for a motion that is no gait."""
    if found.scores is None:
        return
    medians: dict[tuple[str, str], float] = {}
    if found.people is not None:
        for s, side in enumerate(("right", "left")):
            middle = np.median(found.people[0][:, s], axis=0).tolist()
            medians |= {(name, side): value for name, value in zip(NAMES, middle, strict=True)}
            medians["gps", side] = float(np.median(found.people[1][:, s]))
    for side, profile in found.scores.profile.items():
        for name, score in zip(NAMES, profile, strict=True):
            yield _row(name, side, score, medians)
    for side, score in found.scores.sides.items():
        yield _row("gps", side, score, medians)
    yield _row("gps", "overall", found.scores.overall, medians)


def _row(name: str, side: str, score: Score, medians: dict[tuple[str, str], float]) -> dict[str, Any]:
    known = np.isfinite(score.value)
    sizes = (score.low, score.high, score.noise, score.corrected, score.pose_sigma, score.stride_sigma)
    median = medians.get((name, side), float("nan"))
    figures = [score.value, *(size if known else float("nan") for size in sizes), score.spread]
    values = [_number(np.degrees(value)) for value in figures]
    return dict(zip(COLUMNS, [name, side, *values, score.strides, _number(np.degrees(median))], strict=True))


def _curves(found: ScoredGait) -> dict[str, Sequence[float | None]]:
    """Columns of the table of curves."""
    assert found.scores is not None
    columns: dict[str, Sequence[float | None]] = {"cycle_percent": PERCENT.tolist()}
    for v, name in enumerate(NAMES):
        for side, own in found.scores.curves.items():
            strides = own.strides[:, v]
            known = strides[np.isfinite(strides).all(axis=1)]
            spread = known.std(axis=0, ddof=1) if len(known) > 1 else np.full(len(PERCENT), np.nan)
            parts = {"mean": own.mean[v], "pose_sigma": np.sqrt(own.pose_variance[v]), "stride_sd": spread}
            for what, values in parts.items():
                columns[f"{name}_{side}_{what}_deg"] = [_number(x) for x in np.degrees(values)]
        for what, values in (("mean", found.reference.mean[v]), ("sd", found.reference.sd[v])):
            columns[f"{name}_reference_{what}_deg"] = [_number(x) for x in np.degrees(values)]
    return columns


def _write_csv(path: Path, header: Sequence[str], lines: Iterable[Iterable[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(["" if value is None else value for value in line] for line in lines)


def _number(value: Any) -> float | None:
    """Six digits; None, which is null in JSON, for what is not finite."""
    return float(f"{float(value):.6g}") if np.isfinite(value) else None
