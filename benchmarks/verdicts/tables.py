"""The study's figures as tables and as a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.verdicts import study
from benchmarks.verdicts.study import THRESHOLDS, Row
from rtof_kin.protocols.tables import Table

LABELS = {
    "position": "positions in world",
    "relative": "positions relative to the root",
    "orientation": "segment orientations",
    "angle": "clinical angles",
}
UNITS = {"position": "mm", "relative": "mm", "orientation": "deg", "angle": "deg"}


def label(quantity: str, threshold: float) -> str:
    """Table row of a quantity with its threshold."""
    return f"{LABELS[quantity]} > {threshold:g} {UNITS[quantity]}"


def tables(rows: Sequence[Row]) -> tuple[list[Table], Row]:
    """All tables, and their figures for the JSON."""
    parts = study.parts(rows)
    pools = {quantity: {name: study.samples(own, quantity) for name, own in parts.items()} for quantity in LABELS}
    found = {
        label(quantity, threshold): {name: study.figures(own, threshold) for name, own in pools[quantity].items()}
        for quantity, threshold in THRESHOLDS
    }
    intervals = {label(q, t): study.intervals(pools[q]["all"], t) for q, t in THRESHOLDS}
    verdicts = {label(q, t): study.verdict_figures(rows, q, t) for q, t in THRESHOLDS}
    curves = {label(q, t): study.curves(pools[q]["all"], t) for q, t in THRESHOLDS}
    shown = [_everything(found, intervals), _by_part(found), _verdicts(verdicts)]
    return shown, {"sigma": found, "intervals": intervals, "verdicts": verdicts, "curves": curves}


def _everything(found: Mapping[str, Row], intervals: Mapping[str, Row]) -> Table:
    rows = []
    for name, parts in found.items():
        own = parts["all"]
        with_interval = [
            f"{own[key]:.2f} ({low:.2f}-{high:.2f})"
            for key, (low, high) in ((key, intervals[name][key]) for key in ("auc", "ece", "rho"))
        ]
        rows.append(
            (
                name,
                100 * own["share"],
                with_interval[0],
                own["auc_recording"],
                own["auc_entry"],
                with_interval[1],
                own["interval_error"],
                100 * own["coverage"],
                with_interval[2],
                own["rho_recording"],
                own["rho_entry"],
            )
        )
    return Table(
        "sigma",
        "Stated sigma against the error, frame by frame",
        (
            "error",
            "bad %",
            "AUC",
            "in a recording",
            "of one entry",
            "ECE",
            "of intervals",
            "95 % bands cover %",
            "rank correlation",
            "in a recording",
            "of one entry",
        ),
        (0, 0, 2, 2, 2, 2, 2, 0, 2, 2, 2),
        tuple(rows),
        (
            "AUC of sigma for frames whose error is above the threshold, and Spearman's rank correlation of "
            "sigma and error: over everything; over frames and entries (joints, segments, angles) of one "
            "recording; over the frames of one entry alone.",
            "ECE: expected calibration error of the probability that the error is above the threshold; and "
            "the mean difference between meant and seen coverage of six intervals. In brackets: 95 % "
            "bootstrap over people.",
            "Of positions and orientations the error is the length of a vector, of angles the difference.",
        ),
    )


def _by_part(found: Mapping[str, Row]) -> Table:
    names = list(next(iter(found.values())))
    rows = tuple(
        (part, *(" / ".join(f"{own[part][key]:.2f}" for key in ("auc", "ece", "rho")) for own in found.values()))
        for part in names
    )
    return Table(
        "parts",
        "The same by recordings: AUC / ECE / rank correlation",
        ("recordings", *found),
        (0,) * (1 + len(found)),
        rows,
        (
            "independent: errors of each joint by itself; mediapipe: drawn from a model fitted to real "
            "detections. Rigs: motions on skeletons other than those of any fit.",
        ),
    )


def _verdicts(found: Mapping[str, Row]) -> Table:
    keys = ("auc_grades", "auc_excess", "auc_sigma", "rho_excess", "rho_sigma", "auc_flags")
    rows = tuple(
        (name, f"{own['bad']} of {own['recordings']}", *(own[key] for key in keys)) for name, own in found.items()
    )
    return Table(
        "verdicts",
        "Verdicts against the error",
        (
            "error",
            "bad recordings",
            "AUC of grades",
            "AUC of excess",
            "AUC of sigma",
            "rank correlation of excess",
            "of sigma",
            "frames: AUC of flags",
        ),
        (0, 0, 2, 2, 2, 2, 2, 2),
        rows,
        (
            "Of recordings with a root mean square error above the threshold: the report's sections' grades "
            "added up; the figures of its audit over the limits at which they warn, added up; root mean "
            "square of the stated sigma.",
            "Flags of a frame: beyond an anatomical limit, in a fault of the streams, a singular angle.",
        ),
    )


def draw(curves: Mapping[str, Any], path: Path) -> None:
    """ROC and calibration curves as PNG."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, own in curves.items():
        left.plot(*own["roc"], label=name)
        stated, seen, _ = zip(*own["calibration"], strict=True)
        right.plot(stated, seen, "o-", ms=3, label=name)
    for ax in (left, right):
        ax.plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--")
        ax.grid(alpha=0.3)
    left.set(xlabel="share of good ones doubted", ylabel="share of bad ones doubted", title="ROC")
    right.set(xlabel="probability stated", ylabel="share that is bad", title="Calibration")
    left.legend(fontsize=8)
    figure.savefig(path, dpi=90)
