"""The figure: errors by placement, and errors against the windows that a training has seen."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from benchmarks.lifter.rows import STILL, Row
from benchmarks.lifter.tables import ERRORS, WORN, chosen, unseeded, values
from lifting.training.train import windows_axis
from rtof_kin.core.errors import FileFormatError
from rtof_kin.protocols.tables import pooled

COLORS = ("#0072b2", "#c0392b", "#e69f00", "#2e8b57", "#8e44ad", "#56b4e9", "#8c8c8c", "#000000")
LABELS = {"rr": "joint error relative to the root [mm]", "abs": "absolute joint error [mm]"}
SHOWN = {"perfect": "-", "realistic": "--"}
"""2D of the validation whose curves are drawn, and how."""


def read_curves(path: Path) -> dict[str, Any]:
    """The recipe and history of a training.

    Raises:
        FileFormatError: not written by a training.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        content["recipe"]["seed"], content["history"][0]["validation"]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise FileFormatError(
            path, f"not the curves of a training ({error}); give the .curves.json beside a lifter"
        ) from error
    return content


def write_figure(path: Path, rows: Sequence[Row], curves: Sequence[Path]) -> None:
    """Draw it as PNG.

    Raises:
        FileFormatError: a file of curves cannot be read.
    """
    trainings = [(file.name.partition(".")[0], read_curves(file)) for file in curves]
    figure = Figure(figsize=(15, 10 if trainings else 5), layout="constrained")
    axes = figure.subplots(1 + bool(trainings), len(ERRORS), squeeze=False)
    for ax, (error, key) in zip(axes[0], ERRORS.items(), strict=True):
        _placements(ax, rows, key)
        ax.set_ylabel(LABELS[error])
    if trainings:
        for ax, error in zip(axes[1], ERRORS, strict=True):
            _windows(ax, trainings, f"{error}_mm")
            ax.set_ylabel(f"validation: {LABELS[error]}")
    for row, place in zip(axes, ("upper", "lower"), strict=False):
        handles, labels = row[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc=f"outside {place} center", ncols=4, fontsize=8)
    figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
    figure.savefig(path, dpi=110)


def _placements(ax: Axes, rows: Sequence[Row], key: str) -> None:
    """Groups of bars: realistic 2D, a colour for every lifter, a shade for what it was given."""
    rows = [row for row in chosen(rows, keypoints="realistic") if row["lifter"] != STILL]
    places = values(rows, "placement")
    ways = list(dict.fromkeys((row["lifter"], row["sensors"]) for row in rows))
    lifters, counts = (list(dict.fromkeys(column)) for column in zip(*ways, strict=True))
    width, at = 0.8 / max(len(ways), 1), np.arange(len(places))
    for i, (name, count) in enumerate(ways):
        same = chosen(rows, lifter=name, sensors=count)
        means = [pooled(chosen(same, placement=place), key) or np.nan for place in places]
        ax.bar(
            at + (i - (len(ways) - 1) / 2) * width,
            means,
            0.9 * width,
            color=COLORS[lifters.index(name) % len(COLORS)],
            label=f"{name}, {WORN[count]}",
            alpha=1 - 0.7 * counts.index(count) / len(counts),
        )
    ax.set_xticks(at, places)
    ax.set_xlabel("camera, realistic 2D")
    ax.grid(True, axis="y", alpha=0.3)


def _windows(ax: Axes, trainings: Sequence[tuple[str, dict[str, Any]]], key: str) -> None:
    """Error against windows seen, one line a training and kind of 2D; seeds have one colour."""
    names = list(dict.fromkeys(unseeded(name) for name, _ in trainings))
    labels = set[str]()
    for name, training in trainings:
        history, what = training["history"], unseeded(name)
        for kind, style in SHOWN.items():
            label = f"{what}, {kind} 2D"
            ax.plot(
                [row["windows"] for row in history],
                [row["validation"].get(kind, {}).get(key, np.nan) for row in history],
                style,
                color=COLORS[names.index(what) % len(COLORS)],
                lw=1,
                label=None if label in labels else label,
            )
            labels.add(label)
    windows_axis(ax, "windows seen in training")
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, alpha=0.3)
