"""Figure of gait scores: the Movement Analysis Profile, and the nine curves over those of the reference."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.gait_reference import PERCENT, VARIABLES
from rtof_kin.reporting.angle_names import SIDE_COLORS
from rtof_kin.reporting.gait.result import ScoredGait

_WIDTH: Final = 0.38  # of a bar


def gait_figure(found: ScoredGait) -> Figure:
    """Plot the profile above the nine curves, with 95 % bands."""
    figure = Figure(figsize=(12, 14), layout="constrained")
    grid = figure.add_gridspec(4, 3, height_ratios=(1.2, 1, 1, 1))
    _profile(figure.add_subplot(grid[0, :]), found)
    for v in range(len(VARIABLES)):
        _curve(figure.add_subplot(grid[1 + v // 3, v % 3]), found, v)
    figure.suptitle(f"{found.name}: bars and lines with 95 % bands; grey: reference, mean and two standard deviations")
    return figure


def _profile(ax: Any, found: ScoredGait) -> None:
    """Bars of the variable scores and profile scores, with those of the reference's people."""
    scores = found.scores
    assert scores is not None
    labels = [variable.label.replace(" ", "\n", 1) for variable in VARIABLES]
    for s, (side, own) in enumerate(scores.profile.items()):
        bars = [*own, scores.sides[side]]
        x = np.arange(len(bars)) + (s - 0.5) * _WIDTH
        values = np.degrees([bar.value for bar in bars])
        ends = np.degrees([[bar.value - bar.low, bar.half_width] for bar in bars]).T
        ax.bar(x, values, _WIDTH, color=SIDE_COLORS[side], alpha=0.8, label=side)
        ax.errorbar(x, values, yerr=ends, fmt="none", ecolor="0.2", elinewidth=1, capsize=2)
        for place, value in zip(x, values, strict=True):
            if np.isnan(value):
                ax.text(place, 0, "not observed", rotation=90, fontsize=7, color="0.4", ha="center")
    overall = np.degrees([scores.overall.value, scores.overall.value - scores.overall.low])
    at = len(labels) + 1
    ax.bar(at, overall[0], _WIDTH, color="0.4", label="both")
    half = np.degrees(scores.overall.half_width)
    ax.errorbar(at, overall[0], yerr=[[overall[1]], [half]], fmt="none", ecolor="0.2", capsize=2)
    if found.people is not None:
        sizes = np.degrees(np.concatenate([found.people[0], found.people[1][..., None]], axis=2))
        low, middle, high = np.quantile(sizes.reshape(-1, sizes.shape[-1]), [0, 0.5, 1], axis=0)
        places = np.arange(len(middle))
        ax.bar(places, high - low, 0.9, low, color="0.5", alpha=0.25, lw=0, label="reference's people, range")
        ax.hlines(middle, places - 0.45, places + 0.45, color="0.2", lw=1, ls=":", label="and median")
    ax.set_xticks(range(at + 1), [*labels, "GPS", "GPS\noverall"], fontsize=8)
    ax.set_ylabel("score [deg]", fontsize=8)
    ax.set_ylim(bottom=0)
    ax.set_title("Movement Analysis Profile", fontsize=9, loc="left")
    ax.legend(fontsize=7, ncols=5, frameon=False, loc="lower right", bbox_to_anchor=(1, 1))


def _curve(ax: Any, found: ScoredGait, v: int) -> None:
    """One variable over the cycle."""
    assert found.scores is not None
    mean, sd = (np.degrees(one[v]) for one in (found.reference.mean, found.reference.sd))
    ax.plot(PERCENT, mean, color="0.4", lw=1)
    if np.isfinite(sd).all():
        ax.fill_between(PERCENT, mean - 2 * sd, mean + 2 * sd, color="0.5", alpha=0.3, lw=0)
    for side, own in found.scores.curves.items():
        if not np.isfinite(own.mean[v]).all():
            continue
        y = np.degrees(own.mean[v])
        variance = np.nan_to_num(own.pose_variance[v]) + np.nan_to_num(own.stride_bound[v])
        half = BAND_95 * np.degrees(np.sqrt(variance))
        ax.plot(PERCENT, y, color=SIDE_COLORS[side], lw=1.2)
        ax.fill_between(PERCENT, y - half, y + half, color=SIDE_COLORS[side], alpha=0.15, lw=0)
    if not len(ax.lines) or np.isnan(mean).all():
        ax.text(0.5, 0.5, "not in the reference", transform=ax.transAxes, ha="center", color="0.5")
    variable = VARIABLES[v]
    ax.set_title(f"{variable.label} (+ {variable.positive})", fontsize=8, loc="left")
    ax.set_ylabel("[deg]", fontsize=8)
    ax.set_xlim(0, 100)
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.3)
    if v >= 6:
        ax.set_xlabel("gait cycle of the side, from heel strike [%]", fontsize=8)
