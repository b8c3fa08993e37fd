"""Figures of a sensor study: loss without each sensor, and against the number of sensors."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from rtof_kin.reporting.angle_names import label, side_and_name
from rtof_kin.reporting.figures import save_figures
from rtof_kin.reporting.sensor_study.study import LEAST_SEEN, TOLERANCE, SensorStudy, omitted

_LARGEST: Final = 20.0  # [deg] end of the colour scale


def write_study_figures(study: SensorStudy, folder: str | Path) -> list[Path]:
    """Write both figures as PNG, and return their paths."""
    figures = {"sensors": worth_of_sensors(study), "number": error_by_number(study)}
    return save_figures(figures, folder)


def worth_of_sensors(study: SensorStudy) -> Figure:
    """Plot the RMS difference from the full set, deg, of each angle without each sensor alone.

    Differences beyond the tolerance are bold.
    """
    rows = list(study.shown)
    size = (4.0 + 0.85 * len(study.without), 2.3 + 0.28 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.subplots()
    difference = np.degrees(np.stack([found.difference for found in study.without], axis=1)[rows])
    lost = np.stack([found.seen for found in study.without], axis=1)[rows] < LEAST_SEEN
    seen = np.where(lost, np.nan, difference)
    image = ax.imshow(seen, cmap="YlOrRd", vmin=0, vmax=_LARGEST, aspect="auto")
    ax.imshow(np.where(lost, 0.0, np.nan), cmap=ListedColormap(["0.35"]), aspect="auto")
    for (i, j), value in np.ndenumerate(difference):
        text = "unobserved" if lost[i, j] else "" if np.isnan(value) else f"{value:.1f}"
        beyond = value > np.degrees(TOLERANCE)
        colour = "white" if lost[i, j] or value > 0.6 * _LARGEST else "black" if beyond else "0.45"
        weight = "bold" if beyond else "normal"
        ax.text(j, i, text, ha="center", va="center", fontsize=7, color=colour, weight=weight)
    names = [f"{label(study.angles[a])} ({np.degrees(study.moved[a]):.0f})" for a in rows]
    ax.set_yticks(range(len(rows)), names, fontsize=8)
    ax.set_ylabel("angle (its standard deviation in this recording [deg])")
    ax.set_xticks(range(len(study.places)), list(study.places.values()), rotation=30, ha="right", fontsize=8)
    ax.set_xlabel("the one sensor that is omitted")
    scale = "RMS difference from all sensors [deg]"
    figure.colorbar(image, ax=ax, label=scale, extend="max", shrink=0.6)
    limit = f"{np.degrees(TOLERANCE):.0f} deg"
    figure.suptitle(
        f"{study.recording}: how far each angle changes if one sensor is omitted\n"
        f"(a change, not an error; bold: beyond {limit})",
        fontsize=11,
    )
    return figure


def error_by_number(study: SensorStudy) -> Figure:
    """Plot the RMS of the angles against the number of sensors, one panel for each joint, and name the
    sensor that is removed at each step.
    """
    joints: dict[str, list[int]] = {}
    for a in study.shown:
        joint = side_and_name(study.angles[a])[1].partition("_")[0]
        joints.setdefault(joint, []).append(a)
    columns = min(3, len(joints))
    lines = -(-len(joints) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.4 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, sharex=True, squeeze=False).ravel()
    number = [len(found.sensors) for found in study.path]
    gone = [study.places[omitted(found, larger.sensors)] for larger, found in pairwise(study.path)]
    steps = [f"{n}\n{name.replace(' ', chr(10))}" for n, name in zip(number, ["", *gone], strict=True)]
    values = np.degrees(np.stack([study.measure(found) for found in study.path]))
    values[np.stack([found.seen for found in study.path]) < LEAST_SEEN] = np.nan
    for ax, (joint, own) in zip(panels, joints.items(), strict=False):
        for a in own:
            name = label(study.angles[a].replace(f"{joint}_", ""))
            ax.plot(
                number,
                values[:, a],
                marker="o",
                ms=3,
                lw=1.2,
                label=name,
                ls="--" if study.angles[a].startswith("left_") else "-",
            )
        ax.axhline(np.degrees(TOLERANCE), color="0.5", lw=0.8, ls=":")
        ax.set_title(joint, fontsize=9)
        ax.set_ylabel("RMS [deg]", fontsize=8)
        ax.set_ylim(bottom=0)
        ax.set_xlim(max(number) + 0.3, min(number) - 0.3)
        ax.set_xticks(number, steps, fontsize=7)
        ax.tick_params("x", labelbottom=True)
        ax.legend(fontsize=6, ncols=2 if len(own) > 6 else 1, framealpha=0.6)
        ax.grid(alpha=0.3)
    for ax in panels[len(joints) :]:
        ax.set_visible(False)
    for ax in panels[max(0, len(joints) - columns) : len(joints)]:
        ax.set_xlabel("number of sensors, and the one removed last", fontsize=8)
    what = "error against the truth" if study.has_truth else "difference from the full set (not an error)"
    figure.suptitle(
        f"{study.recording}: {what}; a line ends where the angle is unobserved\n"
        "(one order of removal: not all sets of the same size were tried, and others may be better)",
        fontsize=11,
    )
    return figure
