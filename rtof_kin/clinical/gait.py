"""Gait cycles: cadence, stride length, stance share, symmetry, and angles over the cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.gait_events import GaitEvents
from rtof_kin.clinical.gait_recognition import STANCE, UNSTEADY, GaitVerdict, progression, recognise_gait, stride_shape
from rtof_kin.clinical.strides import LONGEST_STRIDE, Stride, find_strides
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

PHASES: Final = np.linspace(0.0, 1.0, 101)
"""Samples of a cycle, share of the time from heel strike to heel strike."""
MEASURES: Final = ("stride_time", "cadence", "stride_length", "speed", "stance_share")
"""Fields of `Stride` that are averaged and compared between the sides."""
Summary = dict[str, dict[str, tuple[float, float, int]]]


@dataclass(frozen=True)
class GaitAnalysis:
    """Strides of a recording and their spatiotemporal parameters."""

    events: GaitEvents
    strides: tuple[Stride, ...]
    """Of both feet, by their start."""
    summary: Summary
    """Side -> measure of `MEASURES` -> (mean, standard deviation, n); the deviation is NaN for n = 1."""
    symmetry: dict[str, float]
    """Measure -> (right - left) / mean of both; 0 is symmetric. Empty if a side has no stride."""
    notes: tuple[str, ...]
    verdict: GaitVerdict

    @property
    def counted(self) -> tuple[Stride, ...]:
        """Strides of which measures and curves are: those of walking if it is gait, else all."""
        return self.verdict.walking if self.is_gait else self.strides

    @property
    def rests_on(self) -> str:
        """What the measures rest on: '1 stride, of the right side alone', '5 strides, 3 right and 2 left'."""
        counts = {side: int(own["stride_time"][2]) for side, own in self.summary.items()}
        total = sum(counts.values())
        text = f"{total} stride" + ("s" if total != 1 else "")
        if len(counts) == 1:
            return f"{text}, of the {next(iter(counts))} side alone"
        return f"{text}, {' and '.join(f'{n} {side}' for side, n in counts.items())}" if counts else text

    @property
    def is_gait(self) -> bool:
        """Whether the strides are those of walking (`recognise_gait`); measures of others mean little."""
        return self.verdict.is_gait

    @property
    def why_not(self) -> str:
        """One sentence on why the motion is no gait; '' if it is."""
        return self.verdict.why_not


@dataclass(frozen=True)
class CycleCurves:
    """One angle over the gait cycles of one side."""

    name: str
    side: str
    curves: Array
    """(n, 101) radians at `PHASES`, one row for each stride with a complete curve."""

    @property
    def mean(self) -> Array:
        """(101,) radians."""
        return np.asarray(self.curves.mean(axis=0))

    @property
    def sd(self) -> Array:
        """(101,) radians, between strides; NaN for a single one."""
        if len(self.curves) < 2:
            return np.full(len(PHASES), np.nan)
        return np.asarray(self.curves.std(axis=0, ddof=1))


def analyse_gait(events: GaitEvents, angles: ClinicalAngles | None = None) -> GaitAnalysis:
    """Find strides and compute their parameters by side, and the symmetry of the sides.

    Args:
        angles: of the same motion; strides with unreliable knee flexion are excluded, with a note.
    """
    found = [stride for side in events.feet for stride in find_strides(side, events)]
    strides = sorted((s for s in found if _trusted(s, angles)), key=lambda stride: stride.start)
    summary: Summary = {}
    notes = list(events.notes)
    if len(strides) < len(found):
        notes.append(f"{len(found) - len(strides)} of {len(found)} strides are excluded: unreliable knee flexion")
    verdict = recognise_gait(strides, events)
    if found and not strides:
        verdict = replace(verdict, why_not="No stride has a reliable knee flexion throughout.")
    counted = verdict.walking if verdict.is_gait else strides
    for side in SIDES:
        own = [stride for stride in counted if stride.side == side]
        if own:
            summary[side] = {name: _statistics(own, name) for name in MEASURES}
        strikes = events.feet[side].strikes.size if side in events.feet else 0
        if len(own) == 1:
            notes.append(f"{side}: a single complete stride, so no standard deviation")
        elif not own and strikes:
            notes.append(
                f"{side}: {strikes} heel strike(s), but no two with a toe off and a strike of the other foot "
                f"between them within {LONGEST_STRIDE:g} s: no stride"
            )
        notes += _warnings(side, own)
    symmetry = {}
    if len(summary) < 2:
        notes.append("symmetry needs a complete stride of each side")
    else:
        for name in MEASURES:
            right, left = (summary[side][name][0] for side in SIDES)
            symmetry[name] = 2 * (right - left) / (right + left) if right + left > 0 else float("nan")
    found_gait = GaitAnalysis(events, tuple(strides), summary, symmetry, tuple(notes), verdict)
    if verdict.is_gait and verdict.too_few:
        first = f"all measures rest on {found_gait.rests_on}: they may not represent usual walking"
        return replace(found_gait, notes=(first, *notes))
    return found_gait


def _trusted(stride: Stride, angles: ClinicalAngles | None) -> bool:
    """Whether all values of the knee's flexion during a stride are reliable."""
    if angles is None:
        return True
    knee, own = angles.names.index(f"{stride.side}_knee_flexion"), stride.frames(angles.times)
    inside = (angles.times[own] >= stride.start) & (angles.times[own] <= stride.stop)
    known = np.isfinite(angles.values[own, knee])
    reliable = known if angles.trusted is None else known & angles.trusted[own, knee]
    return bool((reliable | ~known)[inside].all())


def _warnings(side: str, strides: list[Stride]) -> list[str]:
    """Sentences on strides that are not those of steady walking."""
    notes = []
    if len(strides) > 2:
        mean, spread, _ = _statistics(strides, "stride_time")
        if spread > UNSTEADY * mean:
            notes.append(
                f"{side}: stride times are {mean:.2f} +- {spread:.2f} s, which is not steady walking; means "
                "and curves combine different movements"
            )
    if strides and np.median([stride.stance_share for stride in strides]) < STANCE[0]:
        notes.append(
            f"{side}: stance takes less than {100 * STANCE[0]:.0f} % of the stride: running, or not gait; "
            "event detection assumes walking"
        )
    return notes


def _statistics(strides: list[Stride], name: str) -> tuple[float, float, int]:
    values = np.array([getattr(stride, name) for stride in strides])
    spread = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    return float(values.mean()), spread, len(values)


def cycle_curves(angles: ClinicalAngles, gait: GaitAnalysis) -> tuple[CycleCurves, ...]:
    """Sample each angle over the cycles of its own side; those of the trunk over the cycles of both.

    Headings are from the direction of progression, which turns evenly in a stride with a turn. Angles without
    a stride in which they are known and reliable throughout are omitted.
    """
    times, max_gap = angles.times, 1.5 / angles.rate_hz
    sampled: dict[str, list[Array]] = {side: [] for side in SIDES}
    headings = [row.about_vertical for row in angles.rows]
    for s in gait.counted:
        own, at = s.frames(times), s.start + PHASES * s.stride_time
        values = angles.trusted_values[own]
        values[:, headings] = _from_progression(values[:, headings], times[own], s, gait.events)
        sampled[s.side].append(signals.interpolate(times[own], values, at, max_gap))
    out = []
    for a, row in enumerate(angles.rows):
        for side in [side for side in SIDES if row.name.startswith(f"{side}_")] or SIDES:
            curves = [curves[:, a] for curves in sampled[side]]
            if known := [curve for curve in curves if np.isfinite(curve).all()]:
                out.append(CycleCurves(row.name, side, np.array(known)))
    return tuple(out)


def _from_progression(values: Array, times: Array, stride: Stride, events: GaitEvents) -> Array:
    """Headings (T', n), rad, at times of a stride, from the direction in which the person walks."""
    turn = stride_shape(stride, events).turn
    phase = (times - stride.start) / stride.stride_time
    ahead = progression(stride, events) + np.nan_to_num(turn) * (phase - 0.5)
    return np.asarray((values - ahead[:, None] + np.pi) % (2 * np.pi) - np.pi)
