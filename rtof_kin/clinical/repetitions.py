"""Repetitions of squats and of rises from a seat: depth and tempo, from the height of the pelvis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, get_args

import numpy as np
import scipy

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.clinical.range_of_motion import smoothed
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Repeated
from rtof_kin.core.errors import UnknownNameError

Interval = tuple[float, float]
KINDS: Final[tuple[Repeated, ...]] = get_args(Repeated)
CUTOFF_HZ: Final = 3.0  # low-pass of the pelvis height
LEAST_DROP: Final = 0.15  # smallest descent of the pelvis, share of the leg's length
AT_REST: Final = 0.05  # a movement lasts from 5 % to 95 % of its way, which excludes sway and settling


@dataclass(frozen=True)
class Repetition:
    """One descent and ascent; for sit-to-stand the ascent, and the descent if it was recorded."""

    descent: Interval | None  #: [s] start and stop; None if the recording begins below
    ascent: Interval | None  #: [s] start and stop; None if the recording ends below
    depth: float  #: [m] descent of the pelvis, relative to the higher of its two ends
    depth_share: float  #: Depth as a share of the leg's length (thigh and shank)
    knee_flexion: dict[str, float]  #: Side -> largest knee flexion, rad; NaN if unobserved

    @property
    def descent_time(self) -> float:
        """Seconds; NaN if there is none."""
        return self.descent[1] - self.descent[0] if self.descent else float("nan")

    @property
    def ascent_time(self) -> float:
        """Seconds; NaN if there is none."""
        return self.ascent[1] - self.ascent[0] if self.ascent else float("nan")

    @property
    def bottom_time(self) -> float:
        """Seconds at the bottom or on the seat; NaN if either end was not recorded."""
        return self.ascent[0] - self.descent[1] if self.ascent and self.descent else float("nan")


@dataclass(frozen=True)
class RepetitionAnalysis:
    """All repetitions of a recording."""

    kind: Repeated
    repetitions: tuple[Repetition, ...]
    notes: tuple[str, ...]

    @property
    def total_time(self) -> float:
        """Seconds from the start of the first to the end of the last, e.g. of five sit-to-stands; NaN without any."""
        if not self.repetitions:
            return float("nan")
        first, last = self.repetitions[0], self.repetitions[-1]
        start = first.descent if self.kind == "squat" else first.ascent
        return last.ascent[1] - start[0] if start and last.ascent else float("nan")


def find_repetitions(paths: BodyPaths, angles: ClinicalAngles, kind: Repeated) -> RepetitionAnalysis:
    """Find squats (standing - down - standing), or rises from a seat to standing.

    The height of the pelvis is measured from the ankles, or in world if no ankle is observed.
    `UnknownNameError`: another kind.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of repetition", [kind], list(KINDS))
    notes: list[str] = []
    height = _pelvis_height(paths, notes)
    lengths, segments = paths.skeleton.bone_lengths, paths.table.segments
    leg = sum(lengths[segments[f"{side} {word}"]] for side in SIDES for word in ("shank", "foot")) / 2
    marked = [one.span for one in paths.corrections if one.kind == "repetition" and one.what == kind]
    dips = [_marked(span, paths.times, height, kind, leg) for span in sorted(marked)] or [
        dip
        for start, stop in signals.runs(np.isfinite(height))
        for dip in _dips(paths.times[start:stop], height[start:stop], paths.rate_hz, leg)
    ]
    knees, found = angles.select([f"{side}_knee_flexion" for side in SIDES]), []
    for dip in dips:
        if dip.ascent is not None and (kind == "sit_to_stand" or dip.descent is not None):
            moments = [moment for way in (dip.descent, dip.ascent) if way for moment in way]
            own = knees.trusted_values[signals.within(knees.times, min(moments), max(moments))]
            found.append(replace(dip, knee_flexion=dict(zip(SIDES, map(_largest, own.T), strict=True))))
    if len(found) < len(dips):
        notes.append(f"{len(dips) - len(found)} movement(s) cut by a gap or an end are not counted")
    if not dips:
        notes.append(
            f"no {kind.replace('_', ' ')}: the pelvis never sinks by {100 * LEAST_DROP:.0f} % of the "
            f"leg's length ({LEAST_DROP * leg:.2f} m)"
        )
    return RepetitionAnalysis(kind, tuple(found), tuple(notes))


def _pelvis_height(paths: BodyPaths, notes: list[str]) -> Array:
    """(T,) m above the mean of the observed ankles; NaN where unknown."""
    seen_at = paths.masks.position_observed
    pelvis, *ankles = (
        np.where(seen_at[:, paths.joint(term)], paths.points[term][:, 2], np.nan)
        for term in ("pelvis", *(f"{side} foot" for side in SIDES))
    )
    seen = [ankle for ankle in ankles if np.isfinite(ankle).any()]
    if not seen:
        notes.append("no ankle was observed: the height of the pelvis is that in world, and drifts with it")
        return np.asarray(pelvis)
    if len(seen) == 1:
        notes.append("one ankle was never observed: the height of the pelvis is relative to the other")
    return np.asarray(pelvis - np.mean(seen, axis=0))


def _dips(times: Array, height: Array, rate_hz: float, leg: float) -> list[Repetition]:
    """Minima of the pelvis height with their descent and ascent; knee flexion still empty."""
    height = smoothed(height, rate_hz, CUTOFF_HZ)
    least = LEAST_DROP * leg
    # A recording may begin or end below: its outside counts as standing.
    outside = [height.max() + 1]
    bottoms = scipy.signal.find_peaks(-np.concatenate([outside, height, outside]), prominence=least)[0] - 1
    out = []
    for k, bottom in enumerate(bottoms):
        first = bottoms[k - 1] if k else 0
        last = bottoms[k + 1] if k + 1 < len(bottoms) else len(height) - 1
        before, after = slice(first, bottom + 1), slice(bottom, last + 1)
        down = _rise(times[before][::-1], height[before][::-1], least)
        up = _rise(times[after], height[after], least)
        if down or up:
            depth = float(max(height[before].max(), height[after].max()) - height[bottom])
            out.append(Repetition(down[::-1] if down else None, up, depth, depth / leg, {}))
    return out


def _marked(span: Interval, times: Array, height: Array, kind: Repeated, leg: float) -> Repetition:
    """Return a repetition that was marked by hand, down to the lowest pelvis between its ends; a rise is up only."""
    own = signals.within(times, *span)
    inside = height[own]
    if kind == "sit_to_stand" or not np.isfinite(inside).any():
        down, up = None, span
    else:
        bottom = float(times[own][np.nanargmin(inside)])
        down, up = (span[0], bottom), (bottom, span[1])
    depth = float(np.nanmax(inside) - np.nanmin(inside)) if np.isfinite(inside).any() else float("nan")
    return Repetition(down, up, depth, depth / leg, {})


def _rise(times: Array, height: Array, least: float) -> Interval | None:
    """Seconds at which a rise from the first sample leaves the bottom and reaches the top, or None."""
    rise = height.max() - height[0]
    if rise < least:
        return None
    reached = int(np.argmax(height >= height[0] + (1 - AT_REST) * rise))
    left = int(np.flatnonzero(height[: reached + 1] <= height[0] + AT_REST * rise)[-1])
    return float(times[left]), float(times[reached])


def _largest(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
