"""Tables as Markdown, and a figure of energy against time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.solvers.side_by_side import BASIN_MM, N

Columns = dict[str, tuple[str, str | Callable[[Any], str]]]
"""Key of a row -> heading, format."""
LEAST_EXCESS, LEAST_SECONDS = 1e-8, 1e-3
"""Lower bound of the plotted values."""


def table(rows: Sequence[dict[str, Any]], columns: Columns) -> str:
    """Rows as Markdown; a column is key -> (heading, format), and what is missing or NaN is a dash."""
    lines = ["| " + " | ".join(heading for heading, _ in columns.values()) + " |"]
    lines.append("|---" * len(columns) + "|")
    for row in rows:
        cells = []
        for key, (_, shown) in columns.items():
            value = row.get(key)
            if value is None or (isinstance(value, float) and np.isnan(value)):
                cells.append("-")
            else:
                cells.append(shown(value) if callable(shown) else format(value, shown))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _ratio(value: float) -> str:
    return f"{value:.6f}" if value < 1.1 else f"{value:.2f}"


_COMMON: Columns = {
    "solver": ("solver", ""),
    "milliseconds": ("ms a fragment", ".1f"),
    "iterations": ("iterations", ".0f"),
    "energy": ("energy [1]", ".5g"),
    "ratio_to_best": ("to the best", _ratio),
    "largest_ratio": ("at worst", _ratio),
    "gradient": ("largest gradient", ".3g"),
}
_RATE: Columns = {
    "frames_per_second": ("new frames/s", ".3g"),
    "fragments": ("fragments", ""),
    "converged": ("of them converged", ""),
}


def markdown(result: dict[str, Any]) -> str:
    """All tables."""
    c, j, effort = result["cartesian"], result["joint"], result["effort"]
    joint_columns = {**_COMMON, "violation_deg": ("limits violated by deg", ".2f"), **_RATE}
    settings_columns: Columns = {
        "settings": ("settings", ""),
        "frames_per_second": ("frames/s", ".0f"),
        "iterations_per_fragment": ("iterations a fragment", ".1f"),
        "converged": ("converged", ""),
        "fragments": ("of fragments", ""),
        "median_gradient": ("median gradient", ".2g"),
        "largest_gradient": ("largest gradient", ".2g"),
        "build_seconds": ("build s", ".1f"),
    }
    lengths: Columns = {name: (name, ".1f") for name in result["by_length"][0]}
    lengths |= {name: (name, "") for name in ("N", "paper")}
    durations: Columns = {
        "recording_seconds": ("recording s", ""),
        "seconds": ("solved in s", ".2f"),
        "seconds_per_second": ("s per s", ".3f"),
        "resident_growth_mb": ("resident memory grew by MB", ".1f"),
    }
    sensors: Columns = {"sensors": ("sensors", ""), "us": ("us a new frame", ".0f")}
    sensors |= {name: settings_columns[name] for name in ("iterations_per_fragment", "converged", "fragments")}
    builds = [{"how": name, "s": value} for name, value in result["build_seconds"].items()]
    filled = {
        "command": result["command"],
        "N": N,
        "threads": result["machine"]["threads"],
        "processor": result["machine"]["processor"],
        "cartesian": table(c["rows"], {**_COMMON, **_RATE}),
        "runs": effort["runs"],
        "cartesian_share": 100 * c["ceres_share_in_python"],
        "frames": effort["frames"],
        "joint_share": 100 * j["ceres_share_in_python"],
        **j["degrees_of_freedom"],
        "without_limits": table(j["without_limits"], joint_columns),
        "with_limits": table(j["with_limits"], joint_columns),
        "agreement": "\n".join(_agreement_lines(j["agreement"])),
        "by_length": table(result["by_length"], lengths),
        "by_settings": table(result["by_settings"], settings_columns),
        "by_sensors": table(result["by_sensors"], sensors),
        "builds": table(builds, _BUILDS),
        "by_duration": table(result["by_duration"], durations),
    }
    return _TEXT.format(**filled)


_TEXT = """# Solvers side by side

`{command}`: demo recording, N = {N}, 8 sensors, from SF2, one core (OMP_NUM_THREADS={threads}) of
{processor}.
Medians over fragments, of gradients and violations the largest. Every answer is scored by the package's
own energy and gradient; "to the best" compares it with the lowest energy that a solver of the same table
found for that fragment. Solvers that take seconds were given fewer fragments. `solvers.png` shows one
fragment.

## Cartesian, energy as printed

{cartesian}

Gradient in 1/m. Ceres has a block of parameters a frame and a sparse Cholesky of single entries;
{cartesian_share:.0f} % of its time are residuals and Jacobians called back in Python.

## Joint space, without limits ({per_frame} degrees of freedom a frame, {per_fragment} a fragment)

{without_limits}

Gradient in 1/m and 1/rad. L-BFGS gets the package's value and gradient through an `autograd.Function`,
on tangent coordinates of the start; SciPy and Ceres get whitened residuals with the robust losses in
them, on the same coordinates. {joint_share:.0f} % of Ceres' time are residuals and Jacobians called back
in Python. Real time is the solver as shipped, and once more with a tight tolerance.

## Joint space, with limits

{with_limits}

The gradient is the Lagrangian's. The peers know no limits.

## IPOPT against real time, joint space with limits

{agreement}

## Fragment length

{by_length}

New frames per second, from SF2's output to blended output (joint, IPOPT: of a few solves).
Cartesian: the energy as printed; joint: the default settings (IPOPT: with sigma given).

## Settings

{by_settings}

Median of at most {runs} runs over {frames} frames; gradients, in 1/m and 1/rad, are those at which the
fragments stopped (with limits the Lagrangian's); build: until the first fragments are solved, in a
process that may have built parts of it for rows above.

## Number of sensors

{by_sensors}

From SF2's output, of the whole recording, to blended output; those of the recording, in its order.

## Building the problem

{builds}

In a process of its own, imports apart.

## Length of the recording

{by_duration}

The demo to and fro, streamed block by block.
"""


def _agreement_lines(found: dict[str, Any]) -> list[str]:
    lines = [
        f"Of {found['fragments']} fragments both certify the same minimum in {found['same_minimum']}"
        f" (joints within {BASIN_MM:g} mm): largest relative difference of the energy"
        f" {found['largest_relative_energy_difference'] or 0:.1e}, largest distance of a joint"
        f" {found['largest_distance_mm'] or 0:.4f} mm."
    ]
    for kind, heading in (
        ("different_minima", "Both certify, different minima"),
        ("not_certified_by_both", "Not certified by both"),
    ):
        rows = [
            {
                "first": r["first_frame"],
                "mm": r["distance_mm"],
                **{f"{s}_{what}": r[s][what] for s in ("real_time", "ipopt") for what in ("energy", "violation_deg")},
                **{f"{s}_ok": "yes" if r[f"{s}_converged"] else "no" for s in ("real_time", "ipopt")},
            }
            for r in found[kind]
        ]
        if rows:
            lines += ["", f"{heading}:", "", table(rows, _BASINS)]
    return lines


_BUILDS: Columns = {"how": ("joint space", ""), "s": ("s to the first fragment", ".1f")}
_BASINS: Columns = {
    "first": ("first frame", ""),
    "real_time_energy": ("real time: energy", ".4f"),
    "ipopt_energy": ("IPOPT: energy", ".4f"),
    "mm": ("apart mm", ".2f"),
    "real_time_violation_deg": ("real time: limits violated by deg", ".3f"),
    "ipopt_violation_deg": ("IPOPT: by deg", ".3f"),
    "real_time_ok": ("real time certifies", ""),
    "ipopt_ok": ("IPOPT certifies", ""),
}


def figure(result: dict[str, Any], path: Path) -> None:
    """Energy against time of the typical fragment in both spaces."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawn, axes = pyplot.subplots(1, 2, figsize=(13, 5), layout="constrained")
    titles = {"cartesian": "Cartesian, energy as printed", "joint": "joint space, without limits"}
    for axis, (space, title) in zip(axes, titles.items(), strict=True):
        curves = result[space]["curves"]
        lowest = min(energy for points in curves.values() for _, energy in points)
        for name, points in curves.items():
            seconds, energy = np.array(points).T
            above = np.maximum(energy / lowest - 1, LEAST_EXCESS)
            axis.plot(np.maximum(seconds, LEAST_SECONDS), above, marker=".", label=name)
        axis.set(xscale="log", yscale="log", xlabel="time [s]")
        axis.set_ylabel("energy above the lowest found, as a share of it [1]")
        axis.set_title(f"{title}, {N} frames from {result[space]['typical_first_frame']}")
        axis.grid(visible=True, alpha=0.3)
    drawn.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=6)  # has all of them
    drawn.savefig(path, dpi=130)
    pyplot.close(drawn)
