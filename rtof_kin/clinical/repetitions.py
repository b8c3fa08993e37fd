"""Repetitions of squats and of standing up from a seat: depth and tempo, from the pelvis' height."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, AngleTable, angle_table
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.range_of_motion import smoothed
from rtof_kin.core import signals
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
Kind = Literal["squat", "sit_to_stand"]
KINDS: tuple[Kind, ...] = ("squat", "sit_to_stand")
CUTOFF_HZ = 3.0
"""Low-pass of the pelvis' height."""
LEAST_DROP = 0.15
"""The pelvis sinks by at least this share of the leg's length in a repetition."""
AT_REST = 0.05
"""A movement lasts from 5 % to 95 % of its way: sway and settling on a seat are no part of it."""


@dataclass(frozen=True)
class Repetition:
    """One time down and up; of sitting, from the seat up and, if it was seen, how one came to sit."""

    descent: tuple[float, float] | None
    """Seconds of start and stop; None where the recording began below."""
    ascent: tuple[float, float] | None
    """Seconds of start and stop; None where the recording ended below."""
    depth: float
    """How far the pelvis sank, m, against the higher of the two ends that were seen."""
    depth_share: float
    """The same as a share of the leg's length (thigh and shank)."""
    knee_flexion: dict[str, float]
    """Side -> largest knee flexion, rad; NaN where nobody saw that knee."""

    @property
    def descent_time(self) -> float:
        """Seconds; NaN where there is none."""
        return self.descent[1] - self.descent[0] if self.descent else float("nan")

    @property
    def ascent_time(self) -> float:
        """Seconds; NaN where there is none."""
        return self.ascent[1] - self.ascent[0] if self.ascent else float("nan")

    @property
    def bottom_time(self) -> float:
        """Seconds at the bottom or on the seat; NaN where either end was not seen."""
        return self.ascent[0] - self.descent[1] if self.ascent and self.descent else float("nan")


@dataclass(frozen=True)
class RepetitionAnalysis:
    """All repetitions of a recording."""

    kind: Kind
    repetitions: tuple[Repetition, ...]
    notes: tuple[str, ...]
    """What could not be told, and why."""

    @property
    def total_time(self) -> float:
        """Seconds from the start of the first to the end of the last (of five times sit-to-stand, the
        figure of that test); NaN without any.
        """
        starts = [r.descent if self.kind == "squat" else r.ascent for r in self.repetitions]
        stops = [r.ascent for r in self.repetitions]
        if not starts or starts[0] is None or stops[-1] is None:
            return float("nan")
        return stops[-1][1] - starts[0][0]


def find_repetitions(
    poses: PoseSequence, skeleton: SkeletonModel, angles: ClinicalAngles, kind: Kind
) -> RepetitionAnalysis:
    """Squats (standing - down - standing), or rises from a seat to standing.

    The pelvis' height is measured over the ankles, so neither the floor nor the distance from the
    camera enters; over the world's origin where no ankle was seen.

    Args:
        poses: of the skeleton's joints. angles: the clinical angles of the same motion, for the knees.
        kind: 'squat' or 'sit_to_stand'.

    Raises:
        UnknownNameError: another kind.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of repetition", [kind], list(KINDS))
    skeleton.check_joints(poses.names)
    table = angle_table(skeleton.table)
    notes: list[str] = []
    height = _pelvis_height(poses, skeleton, table, notes)
    leg = _leg_length(skeleton, table)
    dips = [
        dip
        for start, stop in signals.runs(np.isfinite(height))
        for dip in _dips(poses.times[start:stop], height[start:stop], poses.rate_hz, leg)
    ]
    found = [
        replace(dip, knee_flexion=_knee_flexion(dip, angles))
        for dip in dips
        if dip.ascent is not None and (kind == "sit_to_stand" or dip.descent is not None)
    ]
    if len(found) < len(dips):
        notes.append(f"{len(dips) - len(found)} movement(s) cut by a gap or an end are not counted")
    if not dips:
        notes.append(
            f"no {kind.replace('_', ' ')}: the pelvis never sinks by {100 * LEAST_DROP:.0f} % of the "
            f"leg's length ({LEAST_DROP * leg:.2f} m)"
        )
    return RepetitionAnalysis(kind, tuple(found), tuple(notes))


def _pelvis_height(
    poses: PoseSequence, skeleton: SkeletonModel, table: AngleTable, notes: list[str]
) -> Array:
    """(T,) m over the mean of the ankles that were seen all the time; NaN where not known."""
    height = np.where(poses.position_observed, poses.p_world_joint[..., 2], np.nan)
    words = ("pelvis", *(f"{side} foot" for side in SIDES))
    pelvis, *ankles = height[:, skeleton.index(*(table.segments[word] for word in words))].T
    seen = [ankle for ankle in ankles if np.isfinite(ankle).any()]
    if len(seen) < 2:
        notes.append(
            "one ankle was never seen: the pelvis' height is over the other"
            if seen
            else "no ankle was seen: the pelvis' height is the world's, and drifts with it"
        )
    return np.asarray(pelvis - np.mean(seen, axis=0)) if seen else pelvis


def _leg_length(skeleton: SkeletonModel, table: AngleTable) -> float:
    """Thigh and shank, m, mean of both sides."""
    ends = [table.segments[f"{side} {word}"] for side in SIDES for word in ("shank", "foot")]
    return sum(skeleton.bone_lengths[end] for end in ends) / 2


def _dips(times: Array, height: Array, rate_hz: float, leg: float) -> list[Repetition]:
    """Every time the pelvis is low, with the ways down and up that were seen; knees still empty."""
    height = smoothed(height, rate_hz, CUTOFF_HZ)
    least = LEAST_DROP * leg
    # A recording may begin or end below: there the wall outside counts as standing.
    walled = np.concatenate([[height.max() + 1], height, [height.max() + 1]])
    bottoms = find_peaks(-walled, prominence=least)[0] - 1
    out = []
    for k, bottom in enumerate(bottoms):
        first = bottoms[k - 1] if k else 0
        last = bottoms[k + 1] if k + 1 < len(bottoms) else len(height) - 1
        down = _way(times[first : bottom + 1][::-1], height[first : bottom + 1][::-1], least)
        up = _way(times[bottom : last + 1], height[bottom : last + 1], least)
        if down is None and up is None:
            continue
        top = max(height[first : bottom + 1].max(), height[bottom : last + 1].max())
        depth = float(top - height[bottom])
        out.append(Repetition(down[::-1] if down else None, up, depth, depth / leg, {}))
    return out


def _way(times: Array, height: Array, least: float) -> tuple[float, float] | None:
    """Seconds at which a way up from the first sample leaves the bottom and reaches the top, or None."""
    top = int(np.argmax(height))
    rise = height[top] - height[0]
    if rise < least:
        return None
    reached = int(np.argmax(height >= height[0] + (1 - AT_REST) * rise))
    left = int(np.flatnonzero(height[: reached + 1] <= height[0] + AT_REST * rise)[-1])
    return float(times[left]), float(times[reached])


def _knee_flexion(dip: Repetition, angles: ClinicalAngles) -> dict[str, float]:
    """Largest trusted flexion of either knee, rad, between the first and the last moment; NaN if none."""
    moments = [moment for way in (dip.descent, dip.ascent) if way for moment in way]
    inside = (angles.times >= min(moments)) & (angles.times <= max(moments))
    knees = {}
    for side in SIDES:
        flexion = angles.select([f"{side}_knee_flexion"]).trusted_values[inside, 0]
        knees[side] = float(np.nanmax(flexion)) if np.isfinite(flexion).any() else float("nan")
    return knees
