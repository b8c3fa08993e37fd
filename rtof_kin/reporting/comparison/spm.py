"""Statistical parametric mapping in the folder of a comparison: ``spm.json`` and ``spm.png``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.comparison import Comparison
from rtof_kin.clinical.comparison_spm import AngleSpm, ComparisonSpm
from rtof_kin.core.packages import can_draw
from rtof_kin.reporting.angle_names import label

SPM: Final = "spm.json"
_MOST_DRAWN: Final = 12
_COLUMNS: Final = 3


def spm_lines(found: ComparisonSpm) -> list[str]:
    """Return the clusters in words, and what to be careful about."""
    count = len(found.angles)
    lines = []
    for one in found.angles:
        for cluster in one.clusters:
            band = {None: "no bands", True: "beyond the band of B - A", False: "within the band of B - A"}
            p = "p < 0.001" if cluster.p < 0.001 else f"p = {cluster.p:.3f}"
            lines.append(
                f"{label(one.name)}: {100 * cluster.start:.0f} to {100 * cluster.stop:.0f} % of the cycle, "
                f"{'B' if cluster.sign > 0 else 'A'} larger, {p}, {band[cluster.beyond_bands]}"
            )
    head = f"SPM{{t}} of {count} angles, each at level {found.level:.2g}: {len(lines) or 'no'} clusters"
    if not count:
        head = "SPM{t}: no angle can be tested"
    caution = (
        "SPM knows the spread between repeats alone: errors that last through a recording make clusters "
        "too, so a cluster within the band of B - A is no change that was shown"
    )
    reasons: dict[str, list[str]] = {}
    for name, why in found.not_tested.items():
        reasons.setdefault(why, []).append(label(name))
    missing = [f"SPM not computed: {why}: {', '.join(names)}" for why, names in reasons.items()]
    return [head, *lines, *([caution] if lines else []), *missing]


def write_spm(found: ComparisonSpm, comparison: Comparison, folder: str | Path) -> None:
    """Write the files into an existing folder."""
    folder = Path(folder)
    data = {
        "differences": "B - A",
        "level_of_each_angle": found.level,
        "correction": "Bonferroni over angles",
        "phases": found.phases.tolist(),
        "sentences": spm_lines(found),
        "angles": [_plain(one) for one in found.angles],
        "not_tested": found.not_tested,
    }
    text = json.dumps(data, indent=2, allow_nan=False)
    (folder / SPM).write_text(text + "\n", encoding="utf-8")
    if found.angles and can_draw():
        from rtof_kin.reporting.figures import save_figures

        save_figures({"spm": spm_figure(found, comparison)}, folder)


def _plain(one: AngleSpm) -> dict[str, Any]:
    return {
        "angle": one.name,
        "test": "paired" if one.paired else "two-sample, Welch",
        "repeats": list(one.repeats),
        "degrees_of_freedom": one.dof,
        "threshold": one.threshold,
        "t": [float(f"{value:.6g}") for value in one.t],
        "clusters": [
            {
                "start": c.start,
                "stop": c.stop,
                "p": c.p,
                "larger": "B" if c.sign > 0 else "A",
                "beyond_bands": c.beyond_bands,
            }
            for c in one.clusters
        ],
    }


def spm_figure(found: ComparisonSpm, comparison: Comparison) -> Any:
    """Plot t over the cycle with threshold and clusters; angles with clusters first, a dozen at most."""
    from matplotlib.figure import Figure

    shown = sorted(found.angles, key=lambda one: (not one.clusters, -float(np.abs(one.t).max())))
    shown = shown[:_MOST_DRAWN]
    height = math.ceil(len(shown) / _COLUMNS)
    figure = Figure(figsize=(12, 0.8 + 2.6 * height), layout="constrained")
    axes = figure.subplots(height, _COLUMNS, sharex=True, squeeze=False).ravel()
    x = 100 * found.phases
    for ax, one in zip(axes, shown, strict=False):
        ax.plot(x, one.t, color="0.15", lw=1.2)
        for sign in (-1, 1):
            ax.axhline(sign * one.threshold, color="#c0392b", lw=0.8, ls="--")
        for cluster in one.clusters:
            color = "#c0392b" if cluster.beyond_bands else "0.5"
            ax.axvspan(100 * cluster.start, 100 * cluster.stop, color=color, alpha=0.3, lw=0)
        ax.set_title(label(one.name), fontsize=9, loc="left")
        ax.set_ylabel("SPM{t}, B - A", fontsize=8)
        ax.grid(alpha=0.3)
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    figure.suptitle(
        f"{comparison.a.name} (A) and {comparison.b.name} (B) over the cycle [%]: dashed, threshold; "
        "clusters: red beyond the band of B - A, grey not"
    )
    return figure
