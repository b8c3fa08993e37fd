"""The reliability figure: what bands are meant to cover against what they cover, and their widths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.confidence.study import COVERED, NOMINAL, Row
from benchmarks.confidence.tables import TITLES

COLORS = {"0": "#999999", "4": "#e69f00", "8": "#0072b2", "10": "#009e73"}


def reliability(found: Sequence[Row], path: Path) -> None:
    """Draw the realistic rows as PNG: above, coverage by kind; below, widths beside errors."""
    figure = Figure(figsize=(15, 9), layout="constrained")
    above, below = figure.subplots(2, 3, height_ratios=(1, 1.1))
    for kind, top, bottom in zip(TITLES, above, below, strict=True):
        own = [row for row in found if row["kind"] == kind and row["keypoints"] == "realistic"]
        _coverage(top, own)
        top.set_title(TITLES[kind])
        _widths(bottom, own)
    figure.suptitle(
        "Bands against errors, realistic 2D. Above: thin, every joint or angle; thick, their mean. "
        "Below: dots, root mean square error; bars, a quarter of the 95 % band's width"
    )
    figure.savefig(path, dpi=90)


def _coverage(ax: Any, own: Sequence[Row]) -> None:
    x = 100 * np.array(NOMINAL)
    ax.plot([40, 100], [40, 100], color="0.5", lw=0.8, ls="--")
    ax.fill_between([94, 96], *(100 * np.array(COVERED)), color="0.85", lw=0)
    for sensors, color in COLORS.items():
        lines = [list(r["coverage"].values()) for r in own if r["sensors"] == sensors]
        if lines:
            ax.plot(x, 100 * np.transpose(lines), color=color, lw=0.4, alpha=0.5)
            ax.plot(x, 100 * np.mean(lines, axis=0), color=color, lw=2, label=f"{sensors} sensors")
    ax.set_xlabel("meant to cover [%]")
    ax.set_ylabel("covers [%]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)


def _widths(ax: Any, own: Sequence[Row]) -> None:
    names = list(dict.fromkeys(row["name"] for row in own))
    for i, (sensors, color) in enumerate(COLORS.items()):
        rows = [row for row in own if row["sensors"] == sensors]
        x = np.array([names.index(row["name"]) for row in rows]) + 0.2 * (i - 1.5)
        ax.bar(x, [row["width"] / 4 for row in rows], width=0.18, color=color, alpha=0.4)
        ax.plot(x, [row["rms"] for row in rows], "o", ms=3, color=color)
    ax.set_xticks(range(len(names)), [n.replace("_", " ") for n in names], rotation=90, fontsize=7)
    ax.set_ylabel(f"[{own[0]['unit']}]" if own else "")
    ax.grid(alpha=0.3, axis="y")
