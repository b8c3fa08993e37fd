"""Curves of chosen clinical angles below the scene, with a cursor at the time that is shown.

Every frame is a dot, so that a gap of unobserved angles stays a gap.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.view.blocks import BlockCache
from rtof_kin.view.legend import curves_html

WHOLE_S: Final = 300.0  #: [s] Longest motion whose angles are computed at once, as by `analyse`
_PART_S: Final = 60.0
_MARGIN_S: Final = 8.0  # [s] before and after a part, so that a window of it is whole
WINDOW: Final = 5.0  #: [s] shown before and after the cursor
COLOURS: Final = ((0, 114, 178), (213, 94, 0), (0, 158, 115))  #: RGB of the curves (Okabe and Ito, 2008)
_NONE: Final = "none"
_FIRST: Final = ("right_knee_flexion", "left_knee_flexion")  # Angles that are shown at the start
_LEAST_SPAN: Final = 10.0  # [deg] of the vertical axis
_EMPTY: Final = (0.0, 10.0)  # [deg] Range of the vertical axis of no curve
_AXES: Final = (
    {"label": "time [s]", "labelSize": 16, "size": 32},
    {"label": "angle [deg]", "labelSize": 18, "size": 44},
)
_WIDEST_BAND: Final = 30.0  # [deg] Half width of a band up to which it fits the vertical axis
_PER_CURVE: Final = 3  # Series of a curve: value, lower and upper limit of the 95 % band


class AngleBlocks(BlockCache[ClinicalAngles]):
    """Angles by name, computed for the whole motion or for parts of it.

    Of a hinge of the model the other two angles are constant, which shows only while it moves: of a motion in
    parts they are left out.

    Attributes:
        names: of the angles. labels: the same with spaces. in_parts: whether the motion is too long to be
            computed at once.
    """

    def __init__(self, motion: MotionReader):
        table = angle_table(motion.skeleton.table)
        self.names = tuple(row.name for row in table.rows)
        self.labels = tuple(row.label for row in table.rows)
        constant = [3 * number + k for number, joint in enumerate(table.joints) if joint.hinge for k in (1, 2)]
        self.in_parts = motion.times[-1] - motion.times[0] > WHOLE_S

        def compute(start: int, stop: int) -> ClinicalAngles:
            if not self.in_parts:
                return clinical_angles(motion.read(start, stop))
            margin = int(_MARGIN_S * motion.rate_hz)
            found = clinical_angles(motion.read(max(start - margin, 0), min(stop + margin, len(motion))))
            values = found.values.copy()
            values[:, constant] = np.nan
            return replace(found, values=values)

        size = int(_PART_S * motion.rate_hz) if self.in_parts else len(motion)
        super().__init__(len(motion), compute, max(size, 1))


class Curves:
    """Panel with up to three curves."""

    def __init__(self, server: Any, angles: AngleBlocks):
        self._angles, self.changed = angles, True
        gui = server.gui
        self._shown_limits = _EMPTY
        panel = gui.add_panel()
        with panel.add_tab("joint angles"):
            self._legend = gui.add_html("")
            empty = tuple(np.full(2, np.nan) for _ in range(1 + _PER_CURVE * len(COLOURS)))
            self._plot = gui.add_uplot(
                (np.array([0.0, 1.0]), *empty),
                _series(),
                scales=_scales(_EMPTY),
                axes=_AXES,
                legend={"show": False},
                height=150,
                padding=(6, 14, 0, 0),
            )
        options = (_NONE, *angles.labels)
        first = [angles.labels[angles.names.index(name)] for name in _FIRST if name in angles.names]
        self._choices = []
        with panel.add_tab("choose"):
            for number in range(len(COLOURS)):
                initial = first[number] if number < len(first) else _NONE
                choice = gui.add_dropdown(f"curve {number + 1}", options, initial_value=initial)
                choice.on_update(lambda _: self._choose())
                self._choices.append(choice)
        panel.float(x=15, y=-15, width=480)
        self._choose()

    @property
    def chosen(self) -> tuple[str | None, ...]:
        """Names of the chosen angles; None where there is none."""
        names = dict(zip(self._angles.labels, self._angles.names, strict=True))
        return tuple(names.get(choice.value) for choice in self._choices)

    def show(self, frame: int, time: float, seconds: float = 0.0) -> bool:
        """Show the curves around a time; return False while they are computed. `time`: of it, s. `RtofError`: the
        motion cannot be read.
        """
        if all(name is None for name in self.chosen):
            none = np.full(2, np.nan)
            series = [none] * (_PER_CURVE * len(COLOURS))
            self._plot.data = _data(np.array([time - WINDOW, time + WINDOW]), series, time, _EMPTY)
            return True
        part = self._angles.at(frame, seconds)
        if part is None:
            return False
        found = part[0]
        bands: list[Array] = []
        for name in self.chosen:
            column = None if name is None else self._angles.names.index(name)
            values = half = np.full(len(found), np.nan)
            if column is not None:
                values = np.degrees(found.values[:, column])
                if found.sigma is not None:
                    half = BAND_95 * np.degrees(found.sigma[:, column])
            bands += [values, values - half, values + half]
        limits = _limits(np.array(bands).reshape(len(self._choices), _PER_CURVE, -1))
        near = slice(*np.searchsorted(found.times, [time - WINDOW, time + WINDOW]).tolist())
        if limits != self._shown_limits:  # then viser draws the plot anew
            self._shown_limits, self._plot.scales = limits, _scales(limits)
        self._plot.data = _data(found.times[near], [band[near] for band in bands], time, limits)
        return True

    def _choose(self) -> None:
        self.changed = True
        self._legend.content = curves_html(
            [(COLOURS[i], c.value) for i, c in enumerate(self._choices) if c.value != _NONE], self._angles.in_parts
        )


def _scales(limits: tuple[float, float]) -> dict[str, Any]:
    return {"x": {"time": False}, "y": {"range": limits}}


def _limits(curves: Array) -> tuple[float, float]:
    """Return the range of the vertical axis, deg, for curves (C, 3, n) of a whole part of the motion: all
    values, and their bands where these are narrow.
    """
    values = curves[:, :1]
    shown = np.clip(curves, values - _WIDEST_BAND, values + _WIDEST_BAND)
    known = shown[np.isfinite(shown)]
    low, high = (float(known.min()), float(known.max())) if len(known) else _EMPTY
    pad = max(0.05 * (high - low), (_LEAST_SPAN - (high - low)) / 2)
    return float(np.floor((low - pad) / 5) * 5), float(np.ceil((high + pad) / 5) * 5)


def _data(times: Array, series: list[Array], now: float, limits: tuple[float, float]) -> tuple[Array, ...]:
    """Return the columns of the plot: times, series and the cursor, a vertical line at `now`."""
    place = int(np.searchsorted(times, now))
    x = np.insert(times, [place, place], [now, now])
    cursor = np.full(len(x), np.nan)
    cursor[place : place + 2] = limits
    return (x, *(np.insert(column, [place, place], np.nan) for column in series), cursor)


def _series() -> tuple[dict[str, Any], ...]:
    clear = "rgba(0,0,0,0)"
    out: list[dict[str, Any]] = [{"label": "time [s]"}]
    for colour in COLOURS:
        for opacity, size in ((1.0, 3.0), (0.35, 2.0), (0.35, 2.0)):
            dot = f"rgba({colour[0]},{colour[1]},{colour[2]},{opacity})"
            points = {"show": True, "size": size, "width": 0, "fill": dot, "stroke": dot, "space": 0}
            out.append({"label": "", "stroke": clear, "width": 0, "points": points})
    out.append({"label": "now", "stroke": "rgb(40,40,48)", "width": 1.5, "points": {"show": False}})
    return tuple(out)
