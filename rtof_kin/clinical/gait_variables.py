"""The nine variables of the gait scores over the strides of a motion.

Headings of pelvis and foot are relative to the **direction of progression** of each stride: that of the way of the
pelvis from heel strike to heel strike, or, on a treadmill, against the way of the heel in mid stance. Foot progression
is the rotation of the foot in the sequence of the pelvis (Baker 2001), the heading of its lateral axis: with a flat
foot that of its long axis, which has none where the toes point down at toe off. Obliquity and rotation of the pelvis
have the sign of the side whose cycle it is. Only straight strides of walking count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_table import SIDES, angle_table, foot_table
from rtof_kin.clinical.angles import angles_and_paths, relative_to_standing
from rtof_kin.clinical.comparison_samples import repeats_of
from rtof_kin.clinical.gait import GaitAnalysis, analyse_gait, progression, stride_shape
from rtof_kin.clinical.gait_events import Stride, gait_events
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.gait_reference import NAMES, PERCENT, SHAPE

STRAIGHT: Final = np.radians(20.0)  # [rad] largest change of the pelvis's heading within a counted stride
_ANGLES: Final = (
    ("pelvis_tilt", 1, False),
    ("pelvis_list", -1, False),
    ("pelvis_rotation", 1, True),
    ("{side}_hip_flexion", 1, False),
    ("{side}_hip_adduction", 1, False),
    ("{side}_hip_internal_rotation", 1, False),
    ("{side}_knee_flexion", 1, False),
    ("{side}_ankle_dorsiflexion", 1, False),
    ("{side}_foot_rotation", 1, True),
)
"""Angle of each variable, its sign in a right cycle, and whether it is a heading."""
_NEEDS: Final = {
    "hip_adduction": "a sensor on the pelvis, or a camera that sees both hips",
    "hip_rotation": "a sensor on the thigh",
    "ankle_dorsiflexion": "sensors on shank and foot",
    "foot_progression": "a sensor on the foot",
}


@dataclass(frozen=True)
class GaitCycles:
    """The nine variables over n strides, and what they are of."""

    sides: tuple[str, ...]  #: n sides, by the start of the stride
    curves: Array  #: (n, 9, 51) rad, in the order of `VARIABLES`; NaN as a whole where a curve is not complete
    sigma: Array | None  #: (n, 9, 51) rad, stated standard deviations; None if the motion has no bands
    speeds: Array  #: (n,) m/s; NaN on a treadmill
    why_not: str  #: One sentence on why the motion has no strides that count; '' if it has
    notes: tuple[str, ...] = ()

    def complete(self, side: str) -> Mask:
        """Return a mask (n, 9) of the curves of one side that are known."""
        known = np.isfinite(self.curves).all(axis=2)
        own = np.array([one == side for one in self.sides], dtype=np.bool_)
        return np.asarray(known & own[:, None])

    def missing(self, side: str) -> dict[str, str]:
        """Return the variables without a complete curve of one side, and what they need."""
        seen = self.complete(side)
        return {
            name: _NEEDS.get(name, "to be observed and reliable throughout a stride")
            for v, name in enumerate(NAMES)
            if not seen[:, v].any()
        }

    @property
    def speed(self) -> float:
        """Mean walking speed, m/s; NaN if unknown."""
        known = self.speeds[np.isfinite(self.speeds)]
        return float(known.mean()) if len(known) else float("nan")


def joined_cycles(parts: Sequence[GaitCycles]) -> GaitCycles:
    """Return the strides of several motions of one person."""
    sigma = [part.sigma for part in parts if part.sigma is not None]
    return GaitCycles(
        tuple(side for part in parts for side in part.sides),
        np.concatenate([part.curves for part in parts]),
        np.concatenate(sigma) if len(sigma) == len(parts) else None,
        np.concatenate([part.speeds for part in parts]),
        "" if any(not part.why_not for part in parts) else parts[0].why_not,
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def gait_cycles(motion: Motion | MotionSource, *, from_standing: bool = False, few: bool = False) -> GaitCycles:
    """Return the nine variables over the strides of a motion; none if it is no gait, with the reason.
    `InvalidInputError`: no quiet standing, but `from_standing` is set.

    Args:
        motion: reconstructed; read in blocks.
        from_standing: whether angles are relative to the person's quiet standing.
        few: whether a pass with one stride counts, as one of several of a person.
    """
    source = MotionSource.of(motion)
    tables = angle_table(source.skeleton.table), foot_table(source.skeleton.table)
    (angles, feet), paths = angles_and_paths(source, *tables, standing=from_standing)
    if from_standing:
        angles = relative_to_standing(angles, paths)
    gait = analyse_gait(gait_events(paths), angles)
    strides, why_not, notes = _counted(gait, few)
    curves = np.full((len(strides), *SHAPE), np.nan)
    sigma = None if angles.sigma is None else np.full(curves.shape, np.nan)
    for side in SIDES:
        own = [k for k, stride in enumerate(strides) if stride.side == side]
        spans = [(strides[k].start, strides[k].stop) for k in own]
        ahead = np.array([progression(strides[k], gait.events) for k in own])[:, None]
        mirror = 1 if side == "right" else -1
        for v, (name, sign, is_heading) in enumerate(_ANGLES if own else ()):
            angle = (feet if "foot" in name else angles).select([name.format(side=side)])
            found = repeats_of(angle, spans, PERCENT / 100)
            rows = found.values * (sign * (mirror if name in ("pelvis_list", "pelvis_rotation") else 1))
            if is_heading:
                rows = rows - mirror * ahead
                rows = rows - 2 * np.pi * np.round(rows.mean(axis=1, keepdims=True) / (2 * np.pi))
            curves[own, v] = np.where(np.isfinite(rows).all(axis=1, keepdims=True), rows, np.nan)
            if sigma is not None and found.sigma is not None:
                sigma[own, v] = found.sigma
    speeds = np.array([np.nan if gait.verdict.on_the_spot else stride.speed for stride in strides])
    return GaitCycles(tuple(s.side for s in strides), curves, sigma, speeds, why_not, notes)


def _counted(gait: GaitAnalysis, few: bool) -> tuple[list[Stride], str, tuple[str, ...]]:
    """Straight strides of walking; why there are none; notes."""
    why_not = gait.why_not or gait.verdict.too_few
    if why_not and not (few and why_not == gait.verdict.too_few and gait.verdict.walking):
        return [], why_not, ()
    walking = gait.verdict.walking
    straight = [s for s in walking if abs(stride_shape(s, gait.events).turn) <= STRAIGHT]
    if not straight:
        turn = f"{np.degrees(STRAIGHT):.0f} deg"
        return [], f"The person turns by more than {turn} in every stride: walk straight ahead.", ()
    notes = []
    if left_out := len(walking) - len(straight):
        notes.append(f"{left_out} of {len(walking)} strides are left out, in which the person turns")
    if gait.verdict.on_the_spot:
        notes.append("on a treadmill: the direction of progression is that of the belt")
    return straight, "", tuple(notes)
