"""Figures of an inspection: specific force, angular velocity and time steps of sensors; bone lengths."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from rtof_kin.core.array_types import Array
from rtof_kin.core.signals import runs
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial.laws import at_rest, rates_of_orientation
from rtof_kin.reporting.figures import ESTIMATE, TRUTH
from rtof_kin.reporting.inspection import Inspection

MOST: Final = 4
"""Largest number of sensors or bones that are plotted; those furthest beyond a limit come first."""


def picture(inspection: Inspection) -> Figure | None:
    """Plot the sensors or the bone lengths of a file; None if it has neither."""
    excess = {check.subject: 0.0 for check in inspection.checks}
    for check in inspection.failed:
        excess[check.subject] = max(excess[check.subject], check.value / check.limit)
    names = inspection.log.names if inspection.log is not None else inspection.bone_lengths
    worst = sorted(names, key=lambda name: -excess.get(name, 0.0))[:MOST]
    if inspection.log is not None:
        figure = _sensors(inspection.log.select(worst).streams)
    elif worst:
        figure = _bones({name: inspection.bone_lengths[name] for name in worst})
    else:
        return None
    count = len(inspection.failed)
    verdict = f"{count} of {len(inspection.checks)} checks fail" if count else "all checks pass"
    figure.suptitle(f"{inspection.path.name}: {inspection.title}; {verdict}")
    return figure


def _sensors(streams: tuple[SensorStream, ...]) -> Figure:
    rows = (_plot_force, _plot_angular_velocity, _plot_steps)
    figure = Figure(figsize=(max(4.5 * len(streams), 7), 8), layout="constrained")
    axes = figure.subplots(len(rows), len(streams), squeeze=False, sharex="col")
    for column, stream in zip(axes.T, streams, strict=True):
        for ax, plot in zip(column, rows, strict=True):
            plot(ax, stream)
            ax.grid(alpha=0.3)
        column[0].set_title(stream.name)
        column[-1].set_xlabel("time [s]")
    return figure


def _plot_force(ax: Any, stream: SensorStream) -> None:
    """Norm of the specific force; intervals at rest in grey."""
    ax.set_ylabel("specific force [m/s2]")
    if stream.f_sensor is None:
        _no_data(ax, "no accelerations")
        return
    for start, stop in runs(at_rest(stream)):
        ax.axvspan(stream.times[start], stream.times[stop - 1], color="0.85", zorder=0)
    size = np.linalg.norm(stream.f_sensor, axis=-1)
    ax.plot(stream.times, size, color=ESTIMATE, lw=0.8, label="measured (grey: at rest)")
    ax.axhline(STANDARD_GRAVITY, color=TRUTH, lw=1, label="9.81")
    ax.legend(loc="upper right", fontsize=8)


def _plot_angular_velocity(ax: Any, stream: SensorStream) -> None:
    """Angular speed of the gyroscope and of the orientation."""
    ax.set_ylabel("angular velocity [deg/s]")
    if stream.R_inertial_sensor is not None:
        times, w = rates_of_orientation(stream)
        speed = np.degrees(np.linalg.norm(w, axis=-1))
        ax.plot(times, speed, color=TRUTH, lw=1.2, label="of the orientation")
    if stream.w_sensor is not None:
        speed = np.degrees(np.linalg.norm(stream.w_sensor, axis=-1))
        ax.plot(stream.times, speed, color=ESTIMATE, lw=0.8, label="gyroscope")
    if ax.lines:
        ax.legend(loc="upper right", fontsize=8)
    else:
        _no_data(ax, "neither gyroscope nor orientation")


def _plot_steps(ax: Any, stream: SensorStream) -> None:
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


def _no_data(ax: Any, text: str) -> None:
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, color="0.4")
