"""Figures of all recordings together: sigma and verdicts as predictors of errors above a threshold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.verdicts import scores
from rtof_kin.core.array_types import Array

Ints = NDArray[np.int64]
Row = dict[str, Any]
THRESHOLDS = (
    ("position", 50.0),
    ("relative", 50.0),
    ("orientation", 5.0),
    ("orientation", 10.0),
    ("angle", 5.0),
    ("angle", 10.0),
)
"""Quantity, and the error in mm or deg above which it is called bad."""
_LEAST = 1e-3
"""mm or deg: the least standard deviation that counts as stated."""


@dataclass(frozen=True)
class Samples:
    """Errors (n,) of one quantity and what is stated of them, of many recordings, frames and entries."""

    error: Array
    sigma: Array
    freedom: Array
    flags: Array
    recording: Ints
    entry: Ints
    """Joint, segment or angle, and its recording."""
    person: Ints

    def __getitem__(self, index: Any) -> Samples:
        return Samples(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def samples(rows: Sequence[Row], quantity: str) -> Samples:
    """Those of all rows in which something is known."""
    people = sorted({row["person"] for row in rows})
    parts = []
    for r, row in enumerate(rows):
        own = row[quantity]
        error, sigma, freedom, flags = (
            np.array(own[field], dtype=float) for field in ("error", "sigma", "freedom", "flags")
        )  # (n, T)
        entry = 1000 * r + np.arange(len(error))[:, None] + np.zeros(error.shape, dtype=int)
        known = np.isfinite(error + sigma + freedom) & (sigma > _LEAST)
        count = int(known.sum())
        parts.append(
            (
                error[known],
                sigma[known],
                freedom[known],
                flags[known],
                np.full(count, r),
                entry[known],
                np.full(count, people.index(row["person"])),
            )
        )
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def figures(own: Samples, threshold: float) -> Row:
    """Scores of sigma as a predictor of errors above a threshold."""
    bad = own.error > threshold
    stated = scores.probability_above(threshold, own.sigma, own.freedom)
    inside = own.error**2 * own.freedom / own.sigma**2 <= scores.quantile(0.95, own.freedom)
    return {
        "count": len(bad),
        "share": float(bad.mean()),
        "auc": scores.area(own.sigma, bad),
        "auc_recording": scores.area_within(own.sigma, bad, own.recording),
        "auc_entry": scores.area_within(own.sigma, bad, own.entry),
        "ece": scores.calibration_error(stated, bad),
        "interval_error": scores.interval_error(own.error, own.sigma, own.freedom),
        "coverage": float(inside.mean()),
        "rho": scores.rank_correlation(own.sigma, own.error),
        "rho_recording": scores.rank_correlation_within(own.sigma, own.error, own.recording),
        "rho_entry": scores.rank_correlation_within(own.sigma, own.error, own.entry),
    }


def intervals(own: Samples, threshold: float) -> Row:
    """95 % bootstrap intervals over people of the pooled figures."""

    def of(figure: Callable[[Samples], float]) -> tuple[float, float]:
        return scores.bootstrap(own.person, lambda index: figure(own[index]))

    return {
        "auc": of(lambda s: scores.area(s.sigma, s.error > threshold)),
        "ece": of(
            lambda s: scores.calibration_error(
                scores.probability_above(threshold, s.sigma, s.freedom), s.error > threshold
            )
        ),
        "rho": of(lambda s: scores.rank_correlation(s.sigma, s.error)),
    }


def verdict_figures(rows: Sequence[Row], quantity: str, threshold: float) -> Row:
    """What verdicts tell: of recordings whose root mean square error is above a threshold the audit, and
    their stated sigma beside it; of single frames the flags."""
    grades = [(row["verdict"]["grades"], row["verdict"]["excess"]) for row in rows]
    whole = [samples([row], quantity) for row in rows]
    error = np.array([np.sqrt(np.mean(own.error**2)) for own in whole])
    sigma = np.array([np.sqrt(np.mean(own.sigma**2)) for own in whole])
    everything = samples(rows, quantity)
    bad = error > threshold
    return {
        "recordings": len(rows),
        "bad": int(bad.sum()),
        "auc_grades": scores.area(np.array([g for g, _ in grades]), bad),
        "auc_excess": scores.area(np.array([e for _, e in grades]), bad),
        "auc_sigma": scores.area(sigma, bad),
        "rho_excess": scores.rank_correlation(np.array([e for _, e in grades]), error),
        "rho_sigma": scores.rank_correlation(sigma, error),
        "auc_flags": scores.area(everything.flags, everything.error > threshold),
    }


def curves(own: Samples, threshold: float) -> Row:
    """Data of the figure: ROC curve of sigma, and stated and observed shares of large errors."""
    bad = own.error > threshold
    stated = scores.probability_above(threshold, own.sigma, own.freedom)
    return {"roc": scores.roc(own.sigma, bad), "calibration": scores.calibration(stated, bad)}


def parts(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Rows by what they are pooled over: everything; people and rigs; ordinary and with a fault; kind of
    2D and number of sensors."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        fault = "ordinary" if row["fault"] == "ordinary" else "with a fault"
        kind = f"{row['keypoints']}, {row['sensors']} sensors"
        for name in ("all", row["group"], fault, row["keypoints"], kind):
            found.setdefault(name, []).append(row)
    return found
