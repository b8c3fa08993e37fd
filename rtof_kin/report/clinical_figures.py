"""Pictures of an analysis: angles over the gait cycle, or over time where nobody walks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.gait import PHASES
from rtof_kin.data.confidence import BAND_95
from rtof_kin.report.figures import save_figures

SIDE_COLORS = {"right": "#0072b2", "left": "#c0392b", "": "0.25"}
SHOWN = (
    "pelvis_tilt", "pelvis_list", "spine_flexion",
    "hip_flexion", "hip_adduction", "hip_internal_rotation",
    "knee_flexion", "ankle_dorsiflexion", "ankle_inversion",
    "shoulder_elevation", "elbow_flexion", "elbow_pronation",
)  # fmt: skip
"""Angles that are drawn, without their side."""


def write_clinical_figures(analysis: MotionAnalysis, folder: str | Path) -> list[Path]:
    """Draw what there is into a folder, as PNG.

    Returns:
        The paths written: ``angles.png``, and ``gait_cycles.png`` where there are strides.
    """
    figures = {"angles": angles_over_time(analysis)}
    if analysis.curves:
        figures["gait_cycles"] = gait_cycles(analysis)
    return save_figures(figures, folder)


def gait_cycles(analysis: MotionAnalysis) -> Figure:
    """Mean and one standard deviation of angles from heel strike to heel strike, each side its own."""
    figure, axes = _panels("gait cycle of the same side, from heel strike [%]")
    for curve in analysis.curves:
        shown = curve.name.removeprefix(f"{curve.side}_")
        if shown not in axes:
            continue
        ax, color = axes[shown], SIDE_COLORS[curve.side]
        mean, sd = np.degrees(curve.mean), np.degrees(curve.sd)
        strides = "1 stride" if len(curve.curves) == 1 else f"{len(curve.curves)} strides"
        ax.plot(100 * PHASES, mean, color=color, label=f"{curve.side}, {strides}")
        ax.fill_between(100 * PHASES, mean - sd, mean + sd, color=color, alpha=0.2, lw=0)
    _finish(axes)
    for side, measures in analysis.gait.summary.items():
        for ax in axes.values():
            ax.axvline(100 * measures["stance_share"][0], color=SIDE_COLORS[side], lw=0.8, ls="--")
    figure.suptitle("Angles over the gait cycle: mean and standard deviation; dashed: toe off")
    return figure


def angles_over_time(analysis: MotionAnalysis) -> Figure:
    """The same angles over time; a gap is where nobody saw the angle."""
    figure, axes = _panels("time [s]")
    angles = analysis.angles
    for name in angles.names:
        side = next((s for s in ("right", "left") if name.startswith(f"{s}_")), "")
        shown = name.removeprefix(f"{side}_")
        if shown in axes and np.isfinite(angles[name]).any():
            value = np.degrees(angles[name])
            axes[shown].plot(angles.times, value, color=SIDE_COLORS[side], lw=1, label=side or None)
            if angles.sigma is not None:
                half = BAND_95 * np.degrees(angles.sigma[:, angles.names.index(name)])
                axes[shown].fill_between(
                    angles.times, value - half, value + half, color=SIDE_COLORS[side], alpha=0.15, lw=0
                )
    _finish(axes)
    bands = "" if angles.sigma is None else "; bands: 95 %"
    figure.suptitle(f"Joint angles{bands}; a gap: nobody saw the angle")
    return figure


def _panels(label: str) -> tuple[Figure, dict[str, Any]]:
    figure = Figure(figsize=(12, 11), layout="constrained")
    grid = figure.subplots(4, 3, sharex=True)
    for ax in grid[-1]:
        ax.set_xlabel(label, fontsize=8)
    return figure, dict(zip(SHOWN, grid.ravel(), strict=True))


def _finish(axes: dict[str, Any]) -> None:
    """Titles, with the legend beside them, where it hides no curve; what nobody saw is said."""
    for name, ax in axes.items():
        ax.set_title(name.replace("_", " "), fontsize=9, loc="left")
        ax.set_ylabel("[deg]", fontsize=8)
        ax.grid(alpha=0.3)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False,
                      borderaxespad=0, handlelength=1, columnspacing=1)  # fmt: skip
        elif not ax.lines:
            ax.text(0.5, 0.5, "nobody saw it", transform=ax.transAxes, ha="center", color="0.5")
            ax.set_yticks([])
