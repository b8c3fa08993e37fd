"""Heel strikes and toe offs from the feet's path relative to the pelvis.

A heel strikes when it is furthest ahead of the pelvis, a toe leaves when it is furthest behind, along the
direction in which the pelvis faces (Zeni et al., Gait & Posture 27, 2008). Neither the floor's height nor
the speed of walking enters, so a treadmill, a drifting height or a scaled skeleton do no harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, AngleTable, angle_table
from rtof_kin.clinical.range_of_motion import smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
CUTOFF_HZ = 7.0
"""Low-pass of the feet's path."""
HEADING_CUTOFF_HZ = 0.5
"""Low-pass of the direction the pelvis faces: its turning within a step is no change of direction."""
LEAST_SWING = 0.10
"""The heel must come this far, m, out of the extremes around it: nobody steps shorter."""
LEAST_STRIDE = 0.4
"""Two strikes of one foot are at least so many seconds apart."""
LEAST_RATE_HZ = 5.0
"""Of the motion: with two frames in a swing stride times are right to 1 %; with fewer nothing is."""


@dataclass(frozen=True)
class FootEvents:
    """Events of one foot."""

    strikes: Array
    """(n,) seconds at which the heel strikes."""
    offs: Array
    """(m,) seconds at which the toe leaves the floor."""
    heel: Array
    """(T, 3) m, path of the heel in world (of the ankle, where the foot's turn was mostly not seen)."""


@dataclass(frozen=True)
class GaitEvents:
    """Events of both feet; a foot that cannot be told is missing."""

    times: Array
    """(T,) seconds of the recording."""
    feet: dict[str, FootEvents]
    """'right' and 'left', as far as they were seen."""
    forward: Array
    """(T, 3) horizontal unit vector in which the pelvis faces, without its turning within a step; NaN
    where that is not known, or the rate is too low for events."""
    notes: tuple[str, ...]
    """What could not be told, and why."""


def gait_events(poses: PoseSequence, skeleton: SkeletonModel) -> GaitEvents:
    """Heel strikes and toe offs of both feet.

    Args:
        poses: of the skeleton's joints, in world. skeleton: says where heels and toes are.

    Returns:
        The events, the first and the last quarter of a stride possibly left out: an extremum at the
        edge of what was seen is none. None at a rate below `LEAST_RATE_HZ`, as a note says.

    Raises:
        UnknownNameError, ShapeError: the poses are of another skeleton.
    """
    skeleton.check_joints(poses.names)
    table = angle_table(skeleton.table)
    if round(poses.rate_hz, 6) < LEAST_RATE_HZ:
        note = f"{poses.rate_hz:.3g} Hz is too low a rate for gait events; record {LEAST_RATE_HZ:g} Hz"
        return GaitEvents(poses.times, {}, np.full((len(poses), 3), np.nan), (note,))
    notes: list[str] = []
    (pelvis,) = skeleton.index(table.segments["pelvis"])
    forward = _forward(poses, pelvis)
    p_pelvis = poses.p_world_joint[:, pelvis]
    feet = {}
    for side in SIDES:
        heel, toe = _heel_and_toe(poses, skeleton, table, side, notes)
        if not np.isfinite(heel).any():
            notes.append(f"{side} foot: never seen, so it has no events and no strides")
            continue
        ahead = [np.sum((point - p_pelvis) * forward, axis=-1) for point in (heel, toe)]
        strikes = _extrema(poses.times, ahead[0], poses.rate_hz)
        offs = _extrema(poses.times, -ahead[1], poses.rate_hz)
        feet[side] = FootEvents(strikes, offs, heel)
        if not strikes.size:
            notes.append(
                f"{side} foot: no heel strike in {poses.times[-1] - poses.times[0]:.1f} s; it never "
                f"swings by {LEAST_SWING:g} m against the pelvis, or for less than a step"
            )
    return GaitEvents(poses.times, feet, forward, tuple(notes))


def _forward(poses: PoseSequence, pelvis: int) -> Array:
    """(T, 3) where the pelvis faces, low-passed; NaN where it is not known."""
    R = poses.R_world_bone[:, pelvis]
    angle = so3.heading(R)
    out = np.full((len(poses), 3), np.nan)
    for start, stop in signals.runs(np.isfinite(angle)):
        slow = _slow(np.unwrap(angle[start:stop]), poses.rate_hz)
        out[start:stop] = np.stack([np.cos(slow), np.sin(slow), np.zeros_like(slow)], axis=-1)
    return out


def _slow(angle: Array, rate_hz: float) -> Array:
    """The direction without its swing; the mean where the stretch is too short to tell the two apart."""
    if len(angle) < 2 * rate_hz / HEADING_CUTOFF_HZ:
        trend = np.polynomial.Polynomial.fit(np.arange(len(angle)), angle, min(1, len(angle) - 1))
        return np.asarray(trend(np.arange(len(angle))))
    return signals.low_pass(angle, rate_hz, HEADING_CUTOFF_HZ)


def _heel_and_toe(
    poses: PoseSequence, skeleton: SkeletonModel, table: AngleTable, side: str, notes: list[str]
) -> tuple[Array, Array]:
    """Paths (T, 3) of heel and toe, NaN while the foot's place or turn was not seen; both the ankle's,
    NaN while that was not seen, where the turn was for less than half of that time.
    """
    (foot,) = skeleton.index(table.segments[f"{side} foot"])
    seen = poses.position_observed[:, foot]
    turned = seen & poses.orientation_observed[:, foot]
    unseen = int(seen.sum() - turned.sum())
    if unseen > turned.sum():
        often = f" in {100 * unseen / seen.sum():.0f} % of the frames" if turned.any() else ""
        notes.append(f"{side} foot: nobody saw it turn{often}, so its events are those of the ankle")
        ankle = np.where(seen[:, None], poses.p_world_joint[:, foot], np.nan)
        return ankle, ankle
    if unseen:
        notes.append(
            f"{side} foot: nobody saw it turn for {unseen / poses.rate_hz:.2g} s, where it has no events"
        )
    landmarks = list(skeleton.landmarks)
    points = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    wanted = [points[:, landmarks.index(table.segments[f"{side} {word}"])] for word in ("heel", "toe")]
    heel, toe = (np.where(turned[:, None], point, np.nan) for point in wanted)
    return heel, toe


def _extrema(times: Array, ahead: Array, rate_hz: float) -> Array:
    """Seconds of the maxima of a path (T,), to a fraction of a frame; none across gaps or at edges."""
    found = []
    for start, stop in signals.runs(np.isfinite(ahead)):
        stretch = smoothed(ahead[start:stop], rate_hz, CUTOFF_HZ)
        distance = max(1, round(LEAST_STRIDE * rate_hz))
        peaks, _ = find_peaks(stretch, distance=distance, prominence=LEAST_SWING)
        for peak in peaks:
            before, at, after = stretch[peak - 1 : peak + 2]
            curvature = before - 2 * at + after
            shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
            found.append(float(np.interp(start + peak + shift, np.arange(len(times)), times)))
    return np.array(found)
