"""Figures of a follow-up: every measure over the visits, with 95 % bands and the trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.clinical.follow_up import Followed, FollowUp, Outcome
from rtof_kin.core.array_types import Array
from rtof_kin.reporting.angle_names import side_and_name
from rtof_kin.reporting.clinical_figures import SIDE_COLORS
from rtof_kin.reporting.figures import save_figures
from rtof_kin.reporting.follow.sentences import name_of

MARKS: Final = {Outcome.IMPROVED: "^", Outcome.WORSE: "v", Outcome.CHANGED: "D"}
"""Marker of a visit with a change."""
_COLUMNS: Final = 4
_SHIFT: Final = 0.012  # of the axis, between the sides
_TITLES: Final = {
    "changed": "measures with a change",
    "gait": "gait",
    "range": "range of motion",
    "mean": "mean angle",
    "max": "largest angle",
    "min": "smallest angle",
}


def write_trajectories(found: FollowUp, folder: str | Path) -> dict[str, Path]:
    """Write PNGs of what changed, of gait, and of each statistic of the angles; return title -> path."""
    visits = range(len(found.visits))
    changed = {side_and_name(one.measure.name)[1] for one in found.measures if any(map(one.changed, visits))}
    both = [one for one in found.measures if side_and_name(one.measure.name)[1] in changed]
    groups = {"changed": both} if both else {}
    for one in found.measures:
        kind = "gait" if one.measure.is_gait else one.measure.name.rpartition("_")[2]
        groups.setdefault(kind, []).append(one)
    figures = {kind: trajectories(found, groups[kind], title) for kind, title in _TITLES.items() if kind in groups}
    paths = save_figures(figures, folder)
    return {_TITLES[kind]: path for kind, path in zip(figures, paths, strict=True)}


def trajectories(found: FollowUp, measures: Sequence[Followed], title: str) -> Figure:
    """Plot measures over visits, both sides in one panel."""
    panels: dict[tuple[str, str], list[Followed]] = {}
    for one in measures:
        name = side_and_name(one.measure.name)[1]
        panels.setdefault((name, one.measure.unit), []).append(one)
    lines = math.ceil(len(panels) / _COLUMNS)
    height = 0.9 + 2.2 * lines  # inches
    figure = Figure(figsize=(13, height))
    figure.subplots_adjust(0.045, 0.45 / height, 0.99, 1 - 0.75 / height, wspace=0.27, hspace=0.45)
    grid = figure.subplots(lines, _COLUMNS, squeeze=False).ravel()
    x, names = _places(found), [visit.name for visit in found.visits]
    for ax, ((name, unit), own) in zip(grid, panels.items(), strict=False):
        for one in own:
            _plot(ax, found, one, x)
        ax.set_title(name_of(replace(own[0].measure, name=name)), fontsize=9, loc="left")
        ax.set_ylabel(f"[{unit}]", fontsize=8)
        ax.grid(alpha=0.3)
        ax.margins(x=0.08)
        ax.set_xticks(x, names, fontsize=7, rotation=15)
    for ax in grid[len(panels) :]:
        ax.set_axis_off()
    figure.suptitle(
        f"{title[:1].upper()}{title[1:]} over visits with 95 % bands; dots: trials; blue: right, red: left; "
        "large marks: change from the baseline (up: improved, down: worse, diamond: changed)",
        fontsize=10,
        y=1 - 0.1 / height,
        va="top",
    )
    return figure


def _places(found: FollowUp) -> Array:
    """(V,) days of the visits, or their numbers where not all have days of their own."""
    days = [visit.day.toordinal() for visit in found.visits if visit.day is not None]
    if len(set(days)) < len(found.visits):
        return np.arange(len(found.visits), dtype=float)
    return np.array(days, dtype=float)


def _plot(ax: Any, found: FollowUp, one: Followed, x: Array) -> None:
    side = side_and_name(one.measure.name)[0]
    color, scale = SIDE_COLORS[side], one.measure.scale
    x = x + {"right": -1, "left": 1, "": 0}[side] * _SHIFT * float(np.ptp(x) or 1.0)
    y, half = scale * one.estimates, scale * one.half_bands
    ax.errorbar(x, y, yerr=np.nan_to_num(half), color=color, lw=1.2, capsize=2, label=side or None)
    for visit, own in enumerate(one.visits):
        if own is not None and len(own.values) > 1:
            ax.plot(np.full(len(own.values), x[visit]), scale * own.values, ".", color=color, ms=4, alpha=0.5)
        if mark := MARKS.get(one.outcome(visit)) if visit != found.baseline else None:
            ax.plot(x[visit], y[visit], mark, color=color, ms=9)
