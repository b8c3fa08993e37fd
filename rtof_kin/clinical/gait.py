"""Gait cycles: cadence, stride length, stance share, symmetry, and angles over the cycle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.gait_events import GaitEvents
from rtof_kin.core import signals

Array = NDArray[np.float64]
LONGEST_STRIDE = 2.5
"""Two strikes further apart, s, have a pause or a gap between them."""
UNSTEADY = 0.15
"""Stride times that spread by more than this share of their mean are noted."""
LEAST_STANCE = 0.55
"""A median stance share below this is noted: walking has a double support."""
PHASES = np.linspace(0.0, 1.0, 101)
"""Where curves of a cycle are sampled, share of the cycle from heel strike to heel strike."""
MEASURES = ("stride_time", "cadence", "stride_length", "speed", "stance_share")
"""Fields of `Stride` that are averaged and compared between the sides."""


@dataclass(frozen=True)
class Stride:
    """From a heel strike to the next of the same foot."""

    side: str
    start: float
    """Seconds of the first strike."""
    toe_off: float
    """Seconds."""
    stop: float
    """Seconds of the next strike."""
    stride_length: float
    """Horizontal distance of the heel between the two strikes, m; 0 on a treadmill."""

    @property
    def stride_time(self) -> float:
        """Seconds."""
        return self.stop - self.start

    @property
    def cadence(self) -> float:
        """Steps a minute: two steps in a stride."""
        return 120.0 / self.stride_time

    @property
    def speed(self) -> float:
        """m/s."""
        return self.stride_length / self.stride_time

    @property
    def stance_share(self) -> float:
        """Share of the stride during which the foot is on the floor."""
        return (self.toe_off - self.start) / self.stride_time


@dataclass(frozen=True)
class GaitAnalysis:
    """Strides of a recording and their measures."""

    events: GaitEvents
    strides: tuple[Stride, ...]
    """Of both feet, by their start."""
    summary: dict[str, dict[str, tuple[float, float, int]]]
    """Side -> measure of `MEASURES` -> (mean, standard deviation, n); the deviation is NaN for n = 1."""
    symmetry: dict[str, float]
    """Measure -> (right - left) / mean of both; 0 is symmetric. Empty with one side alone."""
    notes: tuple[str, ...]
    """What could not be told, and why."""


@dataclass(frozen=True)
class CycleCurves:
    """One angle over the gait cycle of one side."""

    name: str
    side: str
    curves: Array
    """(n, 101) radians at `PHASES`, one row for each stride that has the angle throughout."""

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
    """Strides between the events, their measures by side, and how alike the sides are.

    Args:
        angles: of the same motion; a stride in which a value of its knee's flexion is not trusted is left
            out, with a note.
    """
    found = [stride for side in events.feet for stride in _strides(side, events)]
    strides = sorted((s for s in found if _trusted(s, angles)), key=lambda stride: stride.start)
    summary = {}
    notes = list(events.notes)
    if len(strides) < len(found):
        notes.append(
            f"{len(found) - len(strides)} of {len(found)} strides are left out: their knee's flexion is "
            "not trusted throughout"
        )
    for side in SIDES:
        own = [stride for stride in strides if stride.side == side]
        if own:
            summary[side] = {name: _statistics(own, name) for name in MEASURES}
        if len(own) == 1:
            notes.append(f"{side}: a single complete stride, so no spread between strides")
        elif not own and side in events.feet and events.feet[side].strikes.size:
            notes.append(
                f"{side}: {events.feet[side].strikes.size} heel strike(s), but no two with a toe off "
                f"and a strike of the other foot between them within {LONGEST_STRIDE:g} s: no stride"
            )
        notes += _doubts(side, own)
    if len(summary) < 2:
        notes.append("symmetry needs a complete stride of either side")
    return GaitAnalysis(events, tuple(strides), summary, _symmetry(summary), tuple(notes))


def _trusted(stride: Stride, angles: ClinicalAngles | None) -> bool:
    """Whether every value of the knee's flexion during a stride is trusted."""
    if angles is None:
        return True
    knee = angles.select([f"{stride.side}_knee_flexion"])
    inside = (knee.times >= stride.start) & (knee.times <= stride.stop)
    return bool((np.isfinite(knee.trusted_values) | ~knee.known)[inside].all())


def _symmetry(summary: dict[str, dict[str, tuple[float, float, int]]]) -> dict[str, float]:
    out = {}
    for name in MEASURES if len(summary) == 2 else ():
        right, left = (summary[side][name][0] for side in SIDES)
        out[name] = 2 * (right - left) / (right + left) if right + left > 0 else float("nan")
    return out


def _strides(side: str, events: GaitEvents) -> list[Stride]:
    """Pairs of strikes with one toe off, one strike of the other foot (if that was seen) and no gap."""
    foot, times = events.feet[side], events.times
    others = [other.strikes for name, other in events.feet.items() if name != side]
    out = []
    for start, stop in zip(foot.strikes[:-1], foot.strikes[1:], strict=True):
        (offs,) = _between([foot.offs], start, stop)
        alternates = all(len(strikes) == 1 for strikes in _between(others, start, stop))
        seen = np.isfinite(foot.heel[(times >= start) & (times <= stop)]).all()
        if len(offs) != 1 or not alternates or not seen or stop - start > LONGEST_STRIDE:
            continue
        ends = signals.interpolate(times, foot.heel, [start, stop])
        length = float(np.linalg.norm((ends[1] - ends[0])[:2]))
        out.append(Stride(side, float(start), float(offs[0]), float(stop), length))
    return out


def _between(events: list[Array], start: float, stop: float) -> list[Array]:
    return [instants[(instants > start) & (instants < stop)] for instants in events]


def _doubts(side: str, strides: list[Stride]) -> list[str]:
    """Why strides may be none of steady walking; nothing where they may."""
    doubts = []
    if len(strides) > 2:
        mean, spread, _ = _statistics(strides, "stride_time")
        if spread > UNSTEADY * mean:
            doubts.append(
                f"{side}: strides take {mean:.2f} +- {spread:.2f} s, which is no steady walking; means "
                "and curves are of unlike movements"
            )
    if strides and np.median([stride.stance_share for stride in strides]) < LEAST_STANCE:
        doubts.append(
            f"{side}: stance takes less than {100 * LEAST_STANCE:.0f} % of the stride: running, or no "
            "gait; events are told by a rule for walking"
        )
    return doubts


def _statistics(strides: list[Stride], name: str) -> tuple[float, float, int]:
    values = np.array([getattr(stride, name) for stride in strides])
    spread = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    return float(values.mean()), spread, len(values)


def cycle_curves(angles: ClinicalAngles, gait: GaitAnalysis) -> tuple[CycleCurves, ...]:
    """Every angle over the cycles of its own side; those of the trunk over the cycles of both.

    An angle without a stride in which it is known and trusted throughout is left out.
    """
    out = []
    for row in angles.rows:
        own = tuple(side for side in SIDES if row.name.startswith(f"{side}_")) or SIDES
        for side in own:
            strides = [stride for stride in gait.strides if stride.side == side]
            curves = [_curve(angles, row.name, stride) for stride in strides]
            known = [curve for curve in curves if np.isfinite(curve).all()]
            if known:
                out.append(CycleCurves(row.name, side, np.array(known)))
    return tuple(out)


def _curve(angles: ClinicalAngles, name: str, stride: Stride) -> Array:
    at = stride.start + PHASES * stride.stride_time
    values = angles.select([name]).trusted_values[:, 0]
    return signals.interpolate(angles.times, values, at, max_gap=1.5 / angles.rate_hz)
