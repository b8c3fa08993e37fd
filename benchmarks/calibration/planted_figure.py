"""The figure: what was recovered of what was planted, and joint errors by the recording's length."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.calibration.planted_rows import ALL, LENGTHS, Row
from benchmarks.calibration.planted_tables import STAGES, UNITS, chosen_lengths, mean, numbers, with_known
from benchmarks.calibration.planting import ERRORS

CASES = {
    "alone x1": "#0072b2",
    "alone x1, floor known": "#e69f00",
    "all x1": "#c0392b",
    "all x1, floor known": "#2e8b57",
}
STYLES = {"before": ":", "after": "-", "known": "--"}
_MOST = 60
"""Bars drawn in a panel of each case."""


def write_figure(path: Path, rows: Sequence[Row]) -> None:
    """Draw it as PNG."""
    rows = with_known(rows)
    figure = Figure(figsize=(15, 12), layout="constrained")
    recovered, growing = figure.subfigures(2, 1, height_ratios=[2, 1.2])
    axes = recovered.subplots(2, 3)
    for ax, error in zip(axes.flat, ERRORS, strict=True):
        _recovered(ax, rows, error)
    found = [dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True)) for ax in axes.flat]
    handles = {label: own[label] for label in CASES for own in found if label in own}
    recovered.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=len(CASES))
    names = {"mpjpe_rr_mm": "root-relative", "mpjpe_mm": "absolute"}
    for ax, (key, name) in zip(growing.subplots(1, 2), names.items(), strict=True):
        _by_length(ax, rows, key)
        ax.set_ylabel(f"{name} joint error [mm]")
    figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
    figure.savefig(path, dpi=90)


def _chosen(rows: Sequence[Row], case: str, error: str) -> list[Row]:
    """The rows of a case of `CASES`."""
    wrong = error if case.startswith("alone") else ALL
    own = [r for r in rows if r["study"] == "planted" and r["case"] == wrong and r["scale"] == 1]
    return [r for r in own if r["floor"] == ("floor" in case) and r["sensors"] == "8"]


def _recovered(ax: Axes, rows: Sequence[Row], error: str) -> None:
    """Found against planted, with claimed standard deviations."""
    factor, unit = UNITS[error]
    found = {case: numbers(_chosen(rows, case, error), error) for case in CASES}
    widest = max((factor * float(np.abs(n["truth"]).max()) for n in found.values() if n), default=1.0)
    for i, (case, color) in enumerate(CASES.items()):
        if n := found[case]:
            every = slice(None, None, 1 + len(n["truth"]) // _MOST)
            truth, value, sigma = (factor * n[name][every] for name in ("truth", "value", "sigma"))
            beside = truth + 0.03 * widest * (i - 1.5)
            ax.errorbar(beside, value, sigma, fmt="o", ms=3, lw=0.7, color=color, alpha=0.7, label=case)
    ax.axline((0, 0), slope=1, color="black", lw=0.7)
    ax.set_xlim(-1.15 * widest, 1.15 * widest)
    ax.set_ylim(-2 * widest, 2 * widest)
    ax.set_title(error)
    ax.set_xlabel(f"planted [{unit}]")
    ax.set_ylabel(f"found [{unit}]")
    ax.grid(True, alpha=0.3)


def _by_length(ax: Axes, rows: Sequence[Row], key: str) -> None:
    """Errors with all quantities wrong and known floor, one colour per motion."""
    own = chosen_lengths(rows)
    for i, session in enumerate(dict.fromkeys(r["session"] for r in own)):
        mine = [r for r in own if r["session"] == session]
        seconds = sorted({r["seconds"] for r in mine})
        for stage in STAGES:
            values = [mean([r for r in mine if r["seconds"] == s], stage, key) for s in seconds]
            label = f"{session}, {stage}"
            ax.plot(seconds, values, STYLES[stage], marker="o", ms=3, color=f"C{i}", label=label)
    ax.set_xscale("log")
    ax.minorticks_off()
    ax.set_xticks(LENGTHS, [f"{s:g}" for s in LENGTHS])
    ax.set_xlabel("length of the recording [s]")
    ax.set_ylim(bottom=0)
    ax.grid(True, alpha=0.3)
    if own:
        ax.legend(fontsize=7, ncols=2)
