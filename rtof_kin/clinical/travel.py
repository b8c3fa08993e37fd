"""Way and turning of a person: where the pelvis goes, and how far it turns about the vertical.

Positions and headings of every frame have errors and sway. A change counts once it exceeds a threshold
(`LEAST_WAY`, `LEAST_TURN`), so that a person who stands has no way and no turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.gait_recognition import GaitVerdict
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.poses import Provenance

CUTOFF_HZ: Final = 1.0  # low-pass of the path, which removes jitter and most of the sway within a step
LEAST_WAY: Final = 0.15  # [m] shortest way that counts
LEAST_TURN: Final = np.radians(30.0)  # [rad] smallest turn that counts; the pelvis rotates less in walking
STRAIGHT: Final = 0.7  # least displacement of a straight way, share of the path
DRIFT: Final = "no camera saw the pelvis: its way is integrated from sensors and drifts"


@dataclass(frozen=True)
class Travel:
    """Way and turning of the pelvis; NaN where it was never observed."""

    path_length: float
    """[m] length of its horizontal path, without what is shorter than `LEAST_WAY`."""
    displacement: float
    """[m] horizontal distance from its first to its last observed position."""
    direction: float
    """[rad] heading of that displacement from world x, counterclockwise; NaN if it is below `LEAST_WAY`."""
    relative_direction: float
    """[rad] the same from the mean direction in which the pelvis faces: 0 forward, pi/2 to the left, pi
    backward; NaN also if it turned by more than a right angle in between."""
    turned_left: float
    """[rad] sum of all turns to the left."""
    turned_right: float
    """[rad] sum of all turns to the right, positive."""
    walking_share: float
    """Share of the recording within strides of walking (`GaitVerdict.walking`)."""
    observed_share: float
    """Share of the recording in which the position of the pelvis was observed."""
    notes: tuple[str, ...]

    @property
    def way(self) -> str:
        """Direction of the displacement in words, from where the pelvis faces; '' if there is none."""
        if np.isnan(self.relative_direction):
            return ""
        names = ("forward", "to the left", "backward", "to the right")
        return names[round(self.relative_direction / (np.pi / 2)) % 4]

    @property
    def text(self) -> str:
        """Path and turns in words, e.g. '3.9 m forward, without turns'."""
        if np.isnan(self.path_length):
            return "the way of the pelvis was not observed"
        path = "staying in place"
        if self.path_length:
            about = "about " if DRIFT in self.notes else ""
            straight = self.displacement >= STRAIGHT * self.path_length
            to = self.way if straight else f"in all, ending {self.displacement:.1f} m from the start"
            path = f"{about}{self.path_length:.1f} m {to}".rstrip()
        turns = [
            f"{np.degrees(turn):.0f}° {side}"
            for side, turn in (("left", self.turned_left), ("right", self.turned_right))
            if turn > 0
        ]
        return f"{path}, turning {' and '.join(turns)}" if turns else f"{path}, without turns"


def travel(paths: BodyPaths, verdict: GaitVerdict) -> Travel:
    """Return way and turning of a person.

    Args:
        paths: of a motion in world, z up. verdict: of its gait.
    """
    pelvis, masks = paths.joint("pelvis"), paths.masks
    seen: Mask = masks.position_observed[:, pelvis]
    heading = np.where(masks.valid[:, pelvis], paths.heading, np.nan)
    turns = _turns(paths.times, heading)
    path = np.where(seen[:, None], paths.points["pelvis"][:, :2], np.nan)
    known = np.flatnonzero(seen)
    way = path[known[-1]] - path[known[0]] if len(known) else np.full(2, np.nan)
    displacement = float(np.linalg.norm(way))
    direction = float(np.arctan2(way[1], way[0])) if displacement >= LEAST_WAY else float("nan")
    return Travel(
        _path_length(paths.times, path), displacement, direction, _relative(direction, heading, turns),
        float(turns[~(turns < 0)].sum()), float(-turns[~(turns > 0)].sum()),
        _walking_share(paths.times, verdict), float(seen.mean()),
        _notes(masks.provenance[:, pelvis], seen),
    )  # fmt: skip


def _turns(times: Array, heading: Array) -> Array:
    """Turns of a heading (T,), rad, one after the other, positive to the left; NaN if never observed."""
    found = []
    for start, stop in signals.runs(np.isfinite(heading)):
        own = np.unwrap(heading[start:stop])[:, None]
        smooth = signals.low_pass_known(times[start:stop], own, CUTOFF_HZ)[:, 0]
        found.append(np.diff(_turning_points(smooth, LEAST_TURN)))
    return np.concatenate(found) if found else np.full(1, np.nan)


def _turning_points(values: Array, least: float) -> list[float]:
    """Extrema of a signal between which it changes by some least value."""
    points: list[float] = []
    rising, low, high = 0, values[0], values[0]
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if rising >= 0 and high - value >= least:  # the signal has turned downwards
            points.append(high)
            rising, low = -1, value
        elif rising <= 0 and value - low >= least:
            points.append(low)
            rising, high = 1, value
    return [*points, high if rising > 0 else low] if points else []


def _path_length(times: Array, path: Array) -> float:
    """Length of a path (T, 2), m, from a point to the next that is `LEAST_WAY` away; NaN if unobserved."""
    runs = signals.runs(np.isfinite(path).all(axis=1))
    smooth = signals.low_pass_known(times, path, CUTOFF_HZ)
    length = 0.0 if runs else float("nan")
    for start, stop in runs:
        points = smooth[start:stop].tolist()
        anchor, way = points[0], 0.0
        for point in points:
            if (step := math.dist(point, anchor)) >= LEAST_WAY:
                way, anchor = way + step, point
        length += way + math.dist(points[-1], anchor) if way else 0.0
    return length


def _relative(direction: float, heading: Array, turns: Array) -> float:
    """Direction of the way from the mean heading, rad in (-pi, pi]; NaN after a turn of a right angle."""
    if (
        np.isnan(direction)
        or not np.isfinite(heading).any()
        or np.abs(np.cumsum(turns)).max(initial=0) > np.pi / 2
    ):
        return float("nan")
    facing = np.angle(np.nanmean(np.exp(1j * heading)))
    return float(np.angle(np.exp(1j * (direction - facing))))


def _walking_share(times: Array, verdict: GaitVerdict) -> float:
    inside = np.zeros(len(times), dtype=np.bool_)
    for stride in verdict.walking:
        inside[signals.within(times, stride.start, stride.stop)] = True
    return float(inside.mean())


def _notes(provenance: NDArray[np.uint8], seen: Mask) -> tuple[str, ...]:
    """Sentences on gaps and drift of the pelvis, from (T,) its provenance and whether it was observed."""
    if not seen.any():
        return ("the pelvis was never observed",)
    notes = []
    if np.all(provenance[seen] == Provenance.IMU):
        notes.append(DRIFT)
    if not seen.all():
        share = 100 * float(1 - seen.mean())
        notes.append(f"the pelvis was not observed for {share:.0f} % of the time, in which no way counts")
    return tuple(notes)
