"""Figure of a plan: expected errors by angle, camera places, further sensors, time for the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.plan.calibration_time import ENOUGH, UNITS
from rtof_kin.plan.plan import Option, Plan
from rtof_kin.plan.sentences import where
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.figures import save_figures

_OWN, _OTHER, _WEAK = "#1f77b4", "#9ecae1", "#d62728"
_CUT: Final = 45.0
"""[deg] Longest bar."""
_MOST: Final = 10
"""Options shown."""


def write_plan_figures(plan: Plan, folder: str | Path) -> list[Path]:
    """Write the figures as PNG, and return their paths."""
    return save_figures({"plan": plan_figure(plan)}, folder)


def plan_figure(plan: Plan) -> Figure:
    """Plot a plan."""
    compared = bool(plan.cameras or plan.sensors)
    height = 1.8 + 0.27 * len(plan.shown)
    figure = Figure(figsize=(12.0 if compared else 7.0, max(height, 6.0 if compared else 3.0)), layout="constrained")
    if not compared:
        _draw_angles(figure.subplots(), plan)
        return figure
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
    _draw_angles(figure.add_subplot(grid[:, 0]), plan)
    _draw_options(figure.add_subplot(grid[0, 1]), _shortened(plan.cameras), "camera place")
    named = [
        Option(
            " at ".join(dict.fromkeys((o.name, where(plan.setup, o.name)))) if o.name else "as planned",
            o.loss,
            o.gain,
            o.most,
            o.problem,
        )
        for o in plan.sensors
    ]
    _draw_options(figure.add_subplot(grid[1, 1]), named, "one more sensor")
    ax = figure.add_subplot(grid[2, 1])
    if plan.calibration is None:
        ax.axis("off")
    else:
        _draw_calibration(ax, plan)
    return figure


def _draw_angles(ax: Any, plan: Plan) -> None:
    own = plan.prediction.select(plan.shown)
    weak = {weakness.angle for weakness in plan.weaknesses}
    at = np.arange(len(own.names))[::-1]
    sigma, error = np.degrees(own.sigma), np.degrees(own.error)
    colours = [_WEAK if name in weak else _OWN for name in own.names]
    ax.barh(at, np.minimum(np.nan_to_num(sigma), _CUT), color=colours, height=0.7)
    ax.plot(np.minimum(error, _CUT), at, "k|", markersize=9, label="error in the simulations")
    for y, value, far in zip(at, sigma, np.fmax(sigma, error), strict=True):
        text = "not observed" if np.isnan(value) else f"{value:.1f}"
        right_of_both = (min(np.nan_to_num(far if np.isfinite(value) else 0.0), _CUT), y)
        ax.annotate(text, right_of_both, (5, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_yticks(at, [label(name) for name in own.names], fontsize=8)
    ax.set_ylim(-0.8, len(at) - 0.2)
    ax.bar(0, 0, color=_WEAK, label="not identifiable by the measurements alone")
    if plan.protocol.wanted_sd_deg is not None:
        ax.axvline(plan.protocol.wanted_sd_deg, color="0.4", linestyle="--", label="wanted")
    ax.set_xlim(0.0, None)
    ax.set_xlabel("expected standard deviation [deg]")
    ax.set_title(f"camera {plan.protocol.camera.words}", fontsize=9, loc="left")
    ax.margins(x=0.15)
    ax.figure.legend(*ax.get_legend_handles_labels(), fontsize=8, loc="outside lower left", ncols=3)


def _shortened(options: Sequence[Option]) -> list[Option]:
    """Options without what all their names end with."""
    rests = {option.name.partition(", ")[2] for option in options}
    if len(rests) > 1:
        return list(options)
    return [replace(option, name=option.name.partition(", ")[0]) for option in options]


def _draw_options(ax: Any, options: Sequence[Option], title: str) -> None:
    best = [option for option in options if not option.problem]
    possible = best[:_MOST] + [option for option in best[_MOST:] if not option.most]
    left_out = len(options) - len(possible)
    at = np.arange(len(possible))[::-1]
    losses = np.degrees([option.loss for option in possible])
    unchanged = [not option.most for option in possible]
    ax.barh(at, losses, color=[_OWN if same else _OTHER for same in unchanged], height=0.7)
    ax.margins(x=0.1)
    for y, value in zip(at, losses, strict=True):
        ax.annotate(f"{value:.1f}", (value, y), (3, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_yticks(at, [option.name for option in possible], fontsize=7)
    ax.set_xlabel("mean standard deviation [deg]", fontsize=8)
    more = f" ({left_out} not shown)" if left_out else ""
    ax.set_title(f"{title}; dark: as planned{more}", fontsize=9)


def _draw_calibration(ax: Any, plan: Plan) -> None:
    found = plan.calibration
    assert found is not None
    for kind, sigma in found.sigma.items():
        factor, unit = UNITS[kind]
        (line,) = ax.plot(found.seconds, factor * sigma, "o-", label=f"{kind} [{unit}]", markersize=4)
        ax.plot(found.seconds, factor * found.error[kind], "x:", color=line.get_color(), markersize=4)
        ax.axhline(factor * ENOUGH[kind], color=line.get_color(), linewidth=0.6, alpha=0.6)
    ax.set_ylim(0.0, None)
    ax.set_xlabel("movement for the calibration [s]", fontsize=8)
    ax.set_ylabel("standard deviation", fontsize=8)
    ax.set_title("calibration; crosses: errors in simulations; lines: enough", fontsize=9)
    ax.legend(fontsize=7)
