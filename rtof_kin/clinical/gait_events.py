"""Heel strikes and toe offs from the path of the feet relative to the pelvis.

Heel strike is when the heel is furthest ahead of the pelvis, toe off when the toe is furthest behind, along
the direction in which the pelvis faces (Zeni et al., Gait & Posture 27, 2008). Neither the height of the
floor nor the walking speed enters, so it also applies on a treadmill and under drift in height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.clinical.range_of_motion import smoothed
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.data.corrections import corrected_events

CUTOFF_HZ: Final = 7.0  # low-pass of the feet's path
HEADING_CUTOFF_HZ: Final = 0.5  # low-pass of the pelvis heading, which removes its rotation within a step
LEAST_SWING: Final = 0.10  # [m] smallest prominence of an extremum of the heel's path
LEAST_STRIDE: Final = 0.4  # [s] shortest time between two strikes of one foot
LEAST_RATE_HZ: Final = 5.0  #: Lowest sampling rate: with two frames in a swing, stride times are accurate to 1 %


@dataclass(frozen=True)
class FootEvents:
    """Events of one foot."""

    strikes: Array  #: (n,) seconds of the heel strikes
    offs: Array  #: (m,) seconds of the toe offs
    heel: Array  #: (T, 3) m, path of the heel in world (of the ankle if the foot's orientation is mostly unobserved)
    by_ankle: bool = False  #: Whether the ankle gives both events; its stance is 4 % of the stride shorter


@dataclass(frozen=True)
class GaitEvents:
    """Events of both feet."""

    times: Array  #: (T,) seconds of the recording
    feet: dict[str, FootEvents]  #: 'right' and 'left', if observed
    notes: tuple[str, ...]
    pelvis: Array  #: (T, 3) m, path of the pelvis in world; NaN where unobserved
    forward: Array  #: (T, 3) low-passed horizontal unit vector in which the pelvis faces; NaN where unknown


def gait_events(paths: BodyPaths) -> GaitEvents:
    """Detect heel strikes and toe offs of both feet.

    Returns:
        The events. Those within a quarter of a stride of either end may be missing, because an extremum at
        an edge is not detected. There are none at a rate below `LEAST_RATE_HZ`.
    """
    rate_hz = paths.rate_hz
    if round(rate_hz, 6) < LEAST_RATE_HZ:
        note = f"{rate_hz:.3g} Hz is too low a rate for gait events; record {LEAST_RATE_HZ:g} Hz"
        nowhere = np.full((len(paths), 3), np.nan)
        return GaitEvents(paths.times, {}, (note,), nowhere, nowhere)
    notes: list[str] = []
    forward = _forward(paths.heading, rate_hz)
    p_pelvis = paths.points["pelvis"]
    feet = {}
    for side in SIDES:
        heel, toe = _heel_and_toe(paths, side, notes)
        if not np.isfinite(heel).any():
            notes.append(f"{side} foot: never observed, so it has no events and no strides")
            continue
        ahead = [np.sum((point - p_pelvis) * forward, axis=-1) for point in (heel, toe)]
        found = (_maxima(paths.times, way, rate_hz) for way in (ahead[0], -ahead[1]))
        strikes, offs = corrected_events(paths.corrections, side, *found)
        feet[side] = FootEvents(strikes, offs, heel, heel is toe)
        if not strikes.size:
            notes.append(
                f"{side} foot: no heel strike in {paths.times[-1] - paths.times[0]:.1f} s; no swing of "
                f"{LEAST_SWING:g} m relative to the pelvis, or less than a step"
            )
    return GaitEvents(paths.times, feet, tuple(notes), p_pelvis, forward)


def _forward(angle: Array, rate_hz: float) -> Array:
    """(T, 3) low-passed horizontal unit vector in which the pelvis faces; NaN where unknown."""
    out = np.full((len(angle), 3), np.nan)
    for start, stop in signals.runs(np.isfinite(angle)):
        own, frames = np.unwrap(angle[start:stop]), np.arange(stop - start)
        if len(own) < 2 * rate_hz / HEADING_CUTOFF_HZ:  # too short to filter
            slow = np.polynomial.Polynomial.fit(frames, own, min(1, len(own) - 1))(frames)
        else:
            slow = signals.low_pass(own, rate_hz, HEADING_CUTOFF_HZ)
        out[start:stop] = np.stack([np.cos(slow), np.sin(slow), np.zeros_like(slow)], axis=-1)
    return out


def _heel_and_toe(paths: BodyPaths, side: str, notes: list[str]) -> tuple[Array, Array]:
    """Paths (T, 3) of heel and toe, NaN where the foot's pose is unobserved; both those of the ankle if the
    foot's orientation is unobserved for more than half of the time.
    """
    foot = paths.joint(f"{side} foot")
    seen = paths.masks.position_observed[:, foot]
    turned = seen & paths.masks.orientation_observed[:, foot]
    unseen = int(seen.sum() - turned.sum())
    if unseen > turned.sum():
        often = f" in {100 * unseen / seen.sum():.0f} % of the frames" if turned.any() else ""
        notes.append(f"{side} foot: orientation unobserved{often}, so ankle positions give its events")
        ankle = np.where(seen[:, None], paths.points[f"{side} foot"], np.nan)
        return ankle, ankle
    if unseen:
        seconds = f"{unseen / paths.rate_hz:.2g} s"
        notes.append(f"{side} foot: orientation unobserved for {seconds}, where it has no events")
    heel, toe = (np.where(turned[:, None], paths.points[f"{side} {word}"], np.nan) for word in ("heel", "toe"))
    return heel, toe


def _maxima(times: Array, ahead: Array, rate_hz: float) -> Array:
    """Seconds of the maxima of a path (T,), with parabolic interpolation; none across gaps or at edges."""
    found = []
    for start, stop in signals.runs(np.isfinite(ahead)):
        stretch = smoothed(ahead[start:stop], rate_hz, CUTOFF_HZ)
        distance = max(1, round(LEAST_STRIDE * rate_hz))
        for peak in scipy.signal.find_peaks(stretch, distance=distance, prominence=LEAST_SWING)[0]:
            shift, at = signals.vertex(*stretch[peak - 1 : peak + 2]), start + peak
            found.append(float(np.interp(shift, [-1, 0, 1], times[at - 1 : at + 2])))
    return np.array(found)


STRAIGHTENED: Final = np.radians(90.0)  # [rad] largest turn within a stride that is taken out of its length
LONGEST_STRIDE: Final = 2.5  # [s] between two strikes; longer ones contain a pause or a gap


@dataclass(frozen=True)
class Stride:
    """A heel strike to the next of the same foot."""

    side: str
    start: float  #: [s] first strike
    toe_off: float
    stop: float  #: [s] next strike
    stride_length: float  #: [m] horizontal way of the heel between the strikes, straightened in turns; 0 on a treadmill

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
        """Return the samples of the stride at times (T,), s, and one beyond either end."""
        first, last = np.searchsorted(times, [self.start, self.stop])
        return slice(max(int(first) - 1, 0), int(last) + 1)


def find_strides(side: str, events: GaitEvents) -> list[Stride]:
    """Return pairs of strikes with one toe off, one strike of the other foot (if observed) and no gap."""
    foot, times = events.feet[side], events.times
    others = [other.strikes for name, other in events.feet.items() if name != side]
    out = []
    for start, stop in zip(foot.strikes[:-1], foot.strikes[1:], strict=True):
        offs, *strikes = (
            t[np.searchsorted(t, start, side="right") : np.searchsorted(t, stop)] for t in (foot.offs, *others)
        )
        alternates = all(len(own) == 1 for own in strikes)
        seen = np.isfinite(foot.heel[signals.within(times, start, stop)]).all()
        if len(offs) == 1 and alternates and seen and stop - start <= LONGEST_STRIDE:
            stride = Stride(side, float(start), float(offs[0]), float(stop), float("nan"))
            out.append(replace(stride, stride_length=_length(stride, foot.heel, events)))
    return out


def _length(stride: Stride, heel: Array, events: GaitEvents) -> float:
    """Length of a stride, m: the way of the heel as if the path of the pelvis were straight.

    In a turn the outer foot goes further than the inner one, which is no asymmetry of the person. The pelvis
    counts by the arc of its way instead of the chord, and the heel by its position beside the pelvis in the
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
    before, after = (
        np.array([np.cos(angle) * p[0] - np.sin(angle) * p[1], np.sin(angle) * p[0] + np.cos(angle) * p[1]])
        for p, angle in ((ends[0] - hips[0], half), (ends[1] - hips[1], -half))
    )
    return float(np.linalg.norm(arc + after - before))
