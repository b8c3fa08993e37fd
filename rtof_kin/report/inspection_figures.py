"""Pictures of what an inspection found: where a sensor rests and what it reads, two speeds, steps of the
clock, lengths of bones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rtof_kin.core.signals import runs
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.laws import at_rest, rates_of_orientation
from rtof_kin.report.figures import ESTIMATE, TRUTH
from rtof_kin.report.inspection import Inspection

Array = NDArray[np.float64]
MOST = 4
"""So many sensors, or bones, are drawn: those furthest beyond a limit."""


def picture(inspection: Inspection) -> Figure | None:
    """What looks wrong, or where nothing does, what was looked at.

    Returns:
        A figure with a column for each of up to `MOST` sensors, or with the lengths of bones; None of a
        file that has neither.
    """
    excess = {check.subject: 0.0 for check in inspection.checks}
    for check in inspection.failed:
        excess[check.subject] = max(excess[check.subject], check.value / check.limit)

    def worst(names: list[str]) -> list[str]:
        return sorted(names, key=lambda name: -excess.get(name, 0.0))[:MOST]

    if inspection.log is not None:
        log = inspection.log.select(worst(list(inspection.log.names)))
        figure = _sensors(log.streams)
    elif inspection.bone_lengths:
        names = worst(list(inspection.bone_lengths))
        figure = _bones({name: inspection.bone_lengths[name] for name in names})
    else:
        return None
    count = len(inspection.failed)
    verdict = f"{count} of {len(inspection.checks)} checks do not hold" if count else "all checks hold"
    figure.suptitle(f"{inspection.path.name}: {inspection.title}; {verdict}")
    return figure


def _sensors(streams: tuple[SensorStream, ...]) -> Figure:
    rows: list[Callable[[Any, SensorStream], None]] = [_draw_force, _draw_turning, _draw_steps]
    figure = Figure(figsize=(max(4.5 * len(streams), 7), 8), layout="constrained")
    axes = figure.subplots(len(rows), len(streams), squeeze=False, sharex="col")
    for column, stream in zip(axes.T, streams, strict=True):
        for ax, draw in zip(column, rows, strict=True):
            draw(ax, stream)
            ax.grid(alpha=0.3)
        column[0].set_title(stream.name)
        column[-1].set_xlabel("time [s]")
    return figure


def _draw_force(ax: Any, stream: SensorStream) -> None:
    """Size of the specific force, where the sensor rests in grey."""
    ax.set_ylabel("specific force [m/s2]")
    if stream.f_sensor is None:
        return _nothing(ax, "no accelerations")
    for start, stop in runs(at_rest(stream)):
        ax.axvspan(stream.times[start], stream.times[stop - 1], color="0.85", zorder=0)
    size = np.linalg.norm(stream.f_sensor, axis=-1)
    ax.plot(stream.times, size, color=ESTIMATE, lw=0.8, label="measured (grey: at rest)")
    ax.axhline(STANDARD_GRAVITY, color=TRUTH, lw=1, label="9.81")
    ax.legend(loc="upper right", fontsize=8)


def _draw_turning(ax: Any, stream: SensorStream) -> None:
    """Speed of the gyroscope and of the orientation."""
    ax.set_ylabel("angular velocity [deg/s]")
    if stream.R_inertial_sensor is None and stream.w_sensor is None:
        return _nothing(ax, "neither gyroscope nor orientation")
    if stream.R_inertial_sensor is not None:
        times, w = rates_of_orientation(stream)
        label = "of the orientation"
        ax.plot(times, np.degrees(np.linalg.norm(w, axis=-1)), color=TRUTH, lw=1.2, label=label)
    if stream.w_sensor is not None:
        speed = np.degrees(np.linalg.norm(stream.w_sensor, axis=-1))
        ax.plot(stream.times, speed, color=ESTIMATE, lw=0.8, label="gyroscope")
    ax.legend(loc="upper right", fontsize=8)


def _draw_steps(ax: Any, stream: SensorStream) -> None:
    """Steps of the time stamps."""
    steps_ms = 1000 * np.diff(stream.times)
    ax.plot(stream.times[1:], steps_ms, ".", color=ESTIMATE, ms=3)
    ax.set_ylabel("step of time stamps [ms]")
    ax.set_ylim(0, 1.2 * float(steps_ms.max(initial=1.0)))


def _bones(lengths: dict[str, Array]) -> Figure:
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    ax = figure.subplots()
    for name, length in lengths.items():
        ax.plot(1000 * length, lw=1, label=f"{name}: spread {1000 * np.nanstd(length):.1f} mm")
    ax.set_xlabel("frame")
    ax.set_ylabel("length of the bone [mm]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    return figure


def _nothing(ax: Any, text: str) -> None:
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, color="0.4")
