"""Figures: error against lag, and how long a frame takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness import pooled
from benchmarks.online.accuracy import BATCH, CAUSAL, GOALS, ONLINE, WINDOW
from benchmarks.online.speed import MOST, STEP

COLORS = {"8": "#0072b2", "10": "#c0392b", "4": "#009e73"}
LINES = ("#0072b2", "#e69f00", "#c0392b", "#009e73")
PANELS = {"mpjpe_rr_mm": "error relative to the root [mm]", "mpjpe_mm": "absolute error [mm]"}


def error_against_lag(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw errors against lag as PNG, batch dashed, the goals as marks.

    Args:
        rows: of `accuracy`. path: of the file.
    """
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    for ax, (name, label) in zip(figure.subplots(1, 2), PANELS.items(), strict=True):
        for sensors in dict.fromkeys(row["sensors"] for row in rows):
            own = [row for row in rows if row["sensors"] == sensors]
            _curve(ax, own, name, sensors)
        ax.set_xlabel("lag [s]")
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    figure.suptitle("Online against batch: realistic 2D, held-out people and rigs; bars: 95 % over motions")
    figure.savefig(path, dpi=110)


def _curve(ax: Any, rows: Sequence[dict[str, Any]], name: str, sensors: str) -> None:
    color = COLORS.get(sensors, "0.3")
    lags = sorted({row["lag"] for row in rows if row["estimate"] == WINDOW})
    mean = [_mean(rows, WINDOW, lag, name) for lag in lags]
    ax.plot(lags, mean, ".-", color=color, lw=1, label=f"window of 1 s, {sensors} sensors")
    own = [_mean(rows, ONLINE, lag, name) for lag in GOALS]
    label = f"window of the lag, {sensors} sensors"
    ax.plot(list(GOALS), own, "s", ms=5, mfc="none", color=color, label=label)
    batch, causal = _mean(rows, BATCH, 0.0, name), _mean(rows, CAUSAL, 0.0, name)
    ax.axhline(batch, color=color, ls="--", lw=1, label=f"batch, {sensors} sensors")
    ax.plot([0], [causal], "x", color=color, label=f"causal SF2, {sensors} sensors")
    if name != "mpjpe_rr_mm":
        return
    for lag, most in GOALS.items():
        low, high = _interval(rows, lag)
        ax.plot([lag, lag], [low, high], color=color, lw=0.8, alpha=0.5)
        goal = batch * (1 + most / 100)
        ax.plot([lag], [goal], "_", ms=16, mew=2, color=color)
        ax.annotate(f"+{most:g} %", (lag, goal), xytext=(9, -3), textcoords="offset points", color=color, fontsize=7)


def _mean(rows: Sequence[dict[str, Any]], estimate: str, lag: float, name: str) -> float:
    own = [row for row in rows if (row["estimate"], row["lag"]) == (estimate, lag)]
    return float(pooled(own, (name,))[name])


def _interval(rows: Sequence[dict[str, Any]], lag: float) -> tuple[float, float]:
    own = [row for row in rows if (row["estimate"], row["lag"]) == (ONLINE, lag)]
    low, high = pooled(own, ())["rr_interval"]
    return low, high


def histogram(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw how long frames take as PNG.

    Args:
        rows: of `speed`. path: of the file.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax = figure.subplots()
    edges = np.arange(0.0, MOST + STEP / 2, STEP)
    for color, row in zip(LINES, rows, strict=False):
        ax.stairs(row["counts"], edges, color=color, label=row["case"])
        for name, style in (("p50", ":"), ("p99", "--")):
            ax.axvline(row["ms"]["processor"][name], color=color, ls=style, lw=0.8)
    ax.set_yscale("log")
    ax.set_xlim(0, min(MOST, 2.5 * max(row["ms"]["processor"]["p99"] for row in rows)))
    ax.set_xlabel("processor time of a frame, lift included [ms]; dotted: median, dashed: 99 %")
    ax.set_ylabel("frames")
    ax.legend(fontsize=8)
    figure.savefig(path, dpi=110)
