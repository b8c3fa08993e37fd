"""Figures of the paper: error curves of baseline and fusion, skeletons over the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core.jobs import Outcome
from rtof_kin.reporting.figures import STAGE_COLORS, TRUTH, save_figures, views

NAMES = {"lift": "baseline (lift)", "sf2": "sf2", "rto": "rto", "rtof": "rtof"}


def write_pictures(outcome: Outcome, folder: Path, table: SkeletonTable, rate_hz: float) -> list[Path]:
    """Draw the figures and return their paths; none if no job has curves.

    Args:
        rate_hz: frame rate, Hz.
    """
    keys = _characters(outcome)
    if not keys:
        return []
    figures = {
        "error_curves": error_curves(outcome, keys, rate_hz),
        "skeletons": _skeletons(outcome, keys[-1], table.parents, rate_hz),
    }
    return save_figures(figures, folder)


def _characters(outcome: Outcome) -> list[str]:
    """Return jobs of the takes with the least and the most motion, by the acceleration error of no motion."""
    first: dict[tuple[str, str], str] = {}
    lively: dict[tuple[str, str], float] = {}
    for key, facts in outcome.done.items():
        take = (facts["subject"], facts["take"])
        if facts["camera"] is not None:
            if set(NAMES) & set(facts["methods"]):
                first.setdefault(take, key)
        elif "no motion" in facts["methods"]:
            lively[take] = facts["methods"]["no motion"]["mpjae"]
    takes = sorted(first, key=lambda take: lively.get(take, 0.0))
    return [first[take] for take in dict.fromkeys([takes[0], takes[-1]])] if takes else []


def error_curves(outcome: Outcome, keys: Sequence[str], rate_hz: float) -> Figure:
    """Plot joint error (left) and the error of the right knee's flexion (right) over time.

    Args:
        keys: of jobs, one row each. rate_hz: frame rate, Hz.
    """
    figure = Figure(figsize=(13, 3.4 * len(keys)), layout="constrained")
    axes = figure.subplots(len(keys), 2, squeeze=False)
    columns = {"rr_mm": "joint error, root-relative [mm]", "knee_deg": "right knee flexion error [deg]"}
    for row, key in zip(axes, keys, strict=True):
        arrays, facts = outcome.arrays(key), outcome.done[key]
        where = f"{facts['subject']} {facts['take']}, camera {facts['camera']}"
        for ax, (suffix, label) in zip(row, columns.items(), strict=True):
            best = [mode for mode in ("rtof", "rto", "sf2") if f"{mode}_{suffix}" in arrays][:1]
            for mode in (["lift"] if f"lift_{suffix}" in arrays else []) + best:
                curve = arrays[f"{mode}_{suffix}"]
                text = f"{NAMES[mode]}: mean {np.nanmean(curve):.1f}"
                times = np.arange(len(curve)) / rate_hz
                ax.plot(times, curve, color=STAGE_COLORS[mode], lw=0.9, label=text)
            ax.set_title(where, fontsize=10)
            ax.set(xlabel="time [s]", ylabel=label)
            ax.set_ylim(bottom=0)
            ax.grid(alpha=0.3)
            ax.legend(loc="upper right", fontsize=8)
    return figure


def _skeletons(outcome: Outcome, key: str, parents: Sequence[int], rate_hz: float) -> Figure:
    """Plot each mode's skeleton over the truth (green) at a few instants, seen from the camera's right."""
    arrays, facts = outcome.arrays(key), outcome.done[key]
    view, label = views(arrays["R_camera_world"])[1]
    modes = [mode for mode in NAMES if f"{mode}_snapshots" in arrays]
    frames = arrays["snapshot_frames"].astype(int)
    figure = Figure(figsize=(2.6 * len(frames), 2.9 * len(modes)), layout="constrained")
    axes = figure.subplots(len(modes), len(frames), squeeze=False)
    for row, mode in zip(axes, modes, strict=True):
        for ax, frame, p, p_true in zip(
            row, frames, arrays[f"{mode}_snapshots"], arrays["snapshot_truth"], strict=True
        ):
            for points, color in ((p_true, TRUTH), (p, STAGE_COLORS[mode])):
                x, z = view @ (points - points[0]).T
                bones = np.array([(parent, child) for child, parent in enumerate(parents) if parent >= 0]).T
                ax.plot(x[bones], z[bones], color=color, lw=2, alpha=0.85)
            up = f"{NAMES[mode]}\nup [m]" if ax is row[0] else ""
            ax.set(aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.2, 1.0), xlabel=f"{label} [m]", ylabel=up)
            ax.set_title(f"{frame / rate_hz:.1f} s", fontsize=9)
    where = f"{facts['subject']} {facts['take']}, camera {facts['camera']}"
    figure.suptitle(f"{where}: estimate over the truth (green), roots together")
    return figure
