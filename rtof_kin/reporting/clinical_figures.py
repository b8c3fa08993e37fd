"""Figures of a clinical analysis: angles over the gait cycle, and over time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.gait import PHASES
from rtof_kin.clinical.ground_reaction import GroundReaction
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reporting.angle_names import SIDE_COLORS, side_and_name
from rtof_kin.reporting.figures import save_figures
from rtof_kin.reporting.plot_data import envelope_frames, interval_times, widest_bands

MOST_DRAWN: Final = 10_000
"""Largest number of samples of a curve; a picture has fewer columns of pixels."""
SHOWN: Final = (
    "pelvis_tilt",
    "pelvis_list",
    "spine_flexion",
    "hip_flexion",
    "hip_adduction",
    "hip_internal_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "ankle_inversion",
    "shoulder_elevation",
    "elbow_flexion",
    "elbow_pronation",
)
"""Angles that are plotted, without their side."""


def write_clinical_figures(analysis: MotionAnalysis, folder: str | Path) -> list[Path]:
    """Write ``angles.png``, ``gait_cycles.png`` of gait, and ``ground_reaction.png`` where the body mass is
    known; return their paths.
    """
    figures = {"angles": angles_over_time(analysis)}
    if analysis.curves and analysis.gait.is_gait:
        figures["gait_cycles"] = gait_cycles(analysis)
    if analysis.ground_reaction is not None and np.isfinite(analysis.ground_reaction.force).any():
        figures["ground_reaction"] = ground_reaction_over_time(analysis.ground_reaction)
    return save_figures(figures, folder)


def ground_reaction_over_time(found: GroundReaction) -> Figure:
    """Plot the vertical force with its band and the interval of each foot, and the centre of pressure."""
    figure = Figure(figsize=(10.0, 7.5), layout="constrained")
    force, each, sole = figure.subplots(3, 1, sharex=True)
    step = max(1, math.ceil(len(found.times) / MOST_DRAWN))
    times, weight = found.times[::step], found.body_weight
    total, band = found.force[::step, 2], BAND_95 * found.force_sigma[::step, 2]
    force.fill_between(times, total - band, total + band, color="0.8", lw=0, label="95 % band")
    force.plot(times, total, color="0.2", lw=1.0, label="both feet together")
    force.axhline(weight, color="0.5", lw=0.7, ls="--", label="body weight")
    force.set_ylabel("vertical force [N]")
    right = force.secondary_yaxis("right", functions=(lambda n: 100 * n / weight, lambda w: w * weight / 100))
    right.set_ylabel("% of body weight")
    for side, interval in zip(SIDES, np.moveaxis(found.vertical[::step], 1, 0), strict=True):
        colour = SIDE_COLORS[side]
        each.fill_between(times, *interval.T, color=colour, alpha=0.3, lw=0)
        alone = np.where(interval[:, 0] == interval[:, 1], interval[:, 0], np.nan)
        each.plot(times, alone, color=colour, lw=1.2, label=f"{side} foot; area: not identifiable")
    each.set_ylabel("vertical force\non each foot [N]")
    for axis, name, style in ((0, "x", "-"), (1, "y", ":")):
        at, spread = found.pressure[::step, axis], BAND_95 * found.pressure_sigma[::step, axis]
        sole.fill_between(times, at - spread, at + spread, color="0.85", lw=0)
        sole.plot(times, at, style, color="0.2", lw=1.0, label=f"{name}, world")
    sole.set_ylabel("centre of pressure [m]")
    sole.set_xlabel("time [s]")
    for ax in (force, each, sole):
        ax.legend(fontsize=8, loc="upper right")
        ax.grid(alpha=0.3)
    return figure


def gait_cycles(analysis: MotionAnalysis) -> Figure:
    """Plot mean and standard deviation of angles from heel strike to heel strike of each side."""
    figure, axes = _panels("gait cycle of the same side, from heel strike [%]")
    for curve in analysis.curves:
        if (shown := curve.name.removeprefix(f"{curve.side}_")) in axes:
            strides = f"{len(curve.curves)} stride" + "s" * (len(curve.curves) != 1)
            mean, sd = np.degrees(curve.mean), np.degrees(curve.sd)
            _plot(axes[shown], 100 * PHASES, mean, sd, curve.side, f"{curve.side}, {strides}")
    _finish(axes)
    for side, measures in analysis.gait.summary.items():
        for ax in axes.values():
            ax.axvline(100 * measures["stance_share"][0], color=SIDE_COLORS[side], lw=0.8, ls="--")
    figure.suptitle("Angles over the gait cycle: mean and standard deviation; dashed: toe off")
    return figure


def angles_over_time(analysis: MotionAnalysis) -> Figure:
    """Plot the same angles over time, with their 95 % bands."""
    figure, axes = _panels("time [s]")
    angles = analysis.angles
    for a, name in enumerate(angles.names):
        side, shown = side_and_name(name)
        if shown in axes and np.isfinite(angles.values[:, a]).any():
            _plot(axes[shown], *_curve(angles, a), side, side or None)
    _finish(axes)
    bands = "" if angles.sigma is None else "; bands: 95 %"
    figure.suptitle(f"Joint angles{bands}; gaps: not observed")
    return figure


def _curve(angles: ClinicalAngles, a: int) -> tuple[Array, Array, Array | None]:
    """Times, values and half widths of the band of an angle, deg.

    Of a long motion they are the lowest and the highest value of equal intervals, with the widest band.
    """
    times, values = angles.times, np.degrees(angles.values[:, a])
    half = None if angles.sigma is None else BAND_95 * np.degrees(angles.sigma[:, a])
    if len(times) <= MOST_DRAWN:
        return times, values, half
    step = math.ceil(2 * len(times) / MOST_DRAWN)
    if half is not None:
        half = widest_bands(half, values, step)
    return interval_times(times, step), values[envelope_frames(values, step)], half


def _plot(ax: Any, x: Any, y: Any, half: Any, side: str, label: str | None) -> None:
    color = SIDE_COLORS[side]
    ax.plot(x, y, color=color, lw=1.2, label=label)
    if half is not None:
        ax.fill_between(x, y - half, y + half, color=color, alpha=0.2, lw=0)


def _panels(label: str) -> tuple[Figure, dict[str, Any]]:
    figure = Figure(figsize=(12, 11), layout="constrained")
    grid = figure.subplots(4, 3, sharex=True)
    for ax in grid[-1]:
        ax.set_xlabel(label, fontsize=8)
    return figure, dict(zip(SHOWN, grid.ravel(), strict=True))


def _finish(axes: dict[str, Any]) -> None:
    """Add titles, with the legend beside them so that it hides no curve, and mark unobserved angles."""
    for name, ax in axes.items():
        ax.set_title(name.replace("_", " "), fontsize=9, loc="left")
        ax.set_ylabel("[deg]", fontsize=8)
        ax.grid(alpha=0.3)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(
                fontsize=7,
                loc="lower right",
                bbox_to_anchor=(1, 1),
                ncols=2,
                frameon=False,
                borderaxespad=0,
                handlelength=1,
                columnspacing=1,
            )
        elif not ax.lines:
            ax.text(0.5, 0.5, "not observed", transform=ax.transAxes, ha="center", color="0.5")
            ax.set_yticks([])
