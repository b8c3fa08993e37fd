"""Strides: pairs of heel strikes of one foot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.clinical.gait_events import GaitEvents
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

STRAIGHTENED: Final = np.radians(90.0)  # [rad] largest turn within a stride that is taken out of its length
LONGEST_STRIDE: Final = 2.5  # [s] between two strikes; longer ones contain a pause or a gap


@dataclass(frozen=True)
class Stride:
    """A heel strike to the next of the same foot."""

    side: str
    start: float
    """[s] first strike."""
    toe_off: float
    stop: float
    """[s] next strike."""
    stride_length: float
    """[m] horizontal way of the heel between the strikes, straightened in turns; 0 on a treadmill."""

    @property
    def stride_time(self) -> float:
        """Seconds."""
        return self.stop - self.start

    @property
    def cadence(self) -> float:
        """Steps per minute; a stride has two steps."""
        return 120.0 / self.stride_time

    @property
    def speed(self) -> float:
        """m/s."""
        return self.stride_length / self.stride_time

    @property
    def stance_share(self) -> float:
        """Stance time divided by stride time."""
        return (self.toe_off - self.start) / self.stride_time

    def frames(self, times: Array) -> slice:
        """Return the samples of the stride and one beyond either end.

        Args:
            times: (T,) s.
        """
        first, last = np.searchsorted(times, [self.start, self.stop])
        return slice(max(int(first) - 1, 0), int(last) + 1)


def find_strides(side: str, events: GaitEvents) -> list[Stride]:
    """Return pairs of strikes with one toe off, one strike of the other foot (if observed) and no gap."""
    foot, times = events.feet[side], events.times
    others = [other.strikes for name, other in events.feet.items() if name != side]
    out = []
    for start, stop in zip(foot.strikes[:-1], foot.strikes[1:], strict=True):
        offs, *strikes = (_between(t, start, stop) for t in (foot.offs, *others))
        alternates = all(len(own) == 1 for own in strikes)
        seen = np.isfinite(foot.heel[signals.within(times, start, stop)]).all()
        if len(offs) == 1 and alternates and seen and stop - start <= LONGEST_STRIDE:
            stride = Stride(side, float(start), float(offs[0]), float(stop), float("nan"))
            out.append(replace(stride, stride_length=_length(stride, foot.heel, events)))
    return out


def _length(stride: Stride, heel: Array, events: GaitEvents) -> float:
    """Length of a stride, m: the way of the heel as if the path of the pelvis were straight.

    In a turn the outer foot goes further than the inner one, which is no asymmetry of the person. The pelvis
    counts by the arc of its way instead of the chord, and the heel by its place beside the pelvis in the
    frame of the heading at each strike. Without a turn this is the distance between the strikes.
    """
    own, at = stride.frames(events.times), [stride.start, stride.stop]
    times = events.times[own]
    ends, hips, forward = (
        signals.interpolate(times, path[own], at)[:, :2] for path in (heel, events.pelvis, events.forward)
    )
    (x, y), (u, v) = forward
    half = float(np.arctan2(x * v - y * u, x * u + y * v)) / 2
    if not abs(half) <= STRAIGHTENED / 2 or not np.isfinite(hips).all():
        return float(np.linalg.norm(ends[1] - ends[0]))
    arc = (hips[1] - hips[0]) / np.sinc(half / np.pi)
    before, after = (_turned(ends[k] - hips[k], angle) for k, angle in ((0, half), (1, -half)))
    return float(np.linalg.norm(arc + after - before))


def _turned(p: Array, angle: float) -> Array:
    """A point (2,) turned counterclockwise by an angle, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * p[0] - s * p[1], s * p[0] + c * p[1]])


def _between(times: Array, start: float, stop: float) -> Array:
    """Those of increasing times that lie in an open interval."""
    return times[np.searchsorted(times, start, side="right") : np.searchsorted(times, stop)]
