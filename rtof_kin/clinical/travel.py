"""Way and turning of a person: where the pelvis goes, and how far it turns about the vertical.

Positions and headings of every frame have errors and sway. A change counts once it exceeds a threshold
(`LEAST_WAY`, `LEAST_TURN`), so that a person who stands has no way and no turns. A turn has a standard
deviation: that of the heading at both ends, as for a range, and, where the pelvis moves on throughout, the
difference from the turn of its path, which sees the same turn. Only turns beyond their 95 % band count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.gait import GaitVerdict, share_of_time
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance

CUTOFF_HZ: Final = 1.0  # low-pass of the path, which removes jitter and most of the sway within a step
LEAST_WAY: Final = 0.15  # [m] shortest way that counts
LEAST_TURN: Final = np.radians(30.0)  # [rad] smallest turn that counts; the pelvis rotates less in walking
LEAST_SPEED: Final = 0.3  # [m/s] from which on the path has a direction
STRAIGHT: Final = 0.7  # least displacement of a straight way, share of the path
DRIFT: Final = "no camera saw the pelvis: its way is integrated from sensors and drifts"


@dataclass(frozen=True)
class Travel:
    """Way and turning of the pelvis; NaN where it was never observed."""

    path_length: float
    """[m] length of its horizontal path, low-passed, without what is shorter than `LEAST_WAY`; straight across gaps."""
    displacement: float
    """[m] distance from the first to the last point of that path, never longer; 0 if below `LEAST_WAY`."""
    direction: float  #: [rad] heading of that displacement from world x, counterclockwise; NaN if it is 0
    relative_direction: float
    """[rad] the same from the mean direction in which the pelvis faces: 0 forward, pi/2 to the left, pi
    backward; NaN also if it turned by more than a right angle in between."""
    turned_left: float  #: [rad] sum of all turns to the left that are beyond their 95 % band
    turned_right: float  #: [rad] the same to the right, positive
    walking_share: float  #: Share of the recording within strides of walking (`GaitVerdict.walking`)
    observed_share: float  #: Share of the recording in which the position of the pelvis was observed
    notes: tuple[str, ...]
    turned_left_sigma: float = float("nan")
    """[rad] standard deviation of `turned_left`; NaN if the motion has no confidence, 0 without a turn."""
    turned_right_sigma: float = float("nan")  #: [rad] standard deviation of `turned_right`
    unsure_turns: bool = False  #: Whether turns were left out that are within their 95 % band

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
        return f"{path}, {self.turns}" if self.turns else path

    @property
    def turns(self) -> str:
        """Turns in words: 'turning 87 \u00b1 30\u00b0 left', 'without turns', or '' if that is not known."""
        said = []
        for side in ("left", "right"):
            turn, sigma = (float(np.degrees(getattr(self, f"turned_{side}{kind}"))) for kind in ("", "_sigma"))
            if turn > 0 and np.isfinite(sigma):
                said.append(f"{turn:.0f} \u00b1 {BAND_95 * sigma:.0f}\u00b0 {side}")
            elif turn > 0:
                said.append(f"about {turn:.0f}\u00b0 {side}")
        if said:
            return f"turning {' and '.join(said)}"
        return "" if self.unsure_turns or np.isnan(self.turned_left) else "without turns"


@dataclass(frozen=True)
class _Turns:
    """Turns of a heading, one after the other."""

    angles: Array  #: (n,) rad, positive to the left
    sigma: Array  #: (n,) rad, NaN without stated errors of the heading
    against_path: Array  #: (n,) rad, difference from the turn of the path; 0 where it has none

    @property
    def certain(self) -> Mask:
        """(n,) whether a turn is beyond its 95 % band."""
        error = np.hypot(np.nan_to_num(self.sigma), self.against_path)
        return np.asarray(np.abs(self.angles) > BAND_95 * error)

    def sum(self, sign: int) -> tuple[float, float]:
        """Return the sum of the certain turns to one side and its standard deviation, rad; sign: 1 for the left, -1 for
        the right.
        """
        own = self.certain & (sign * self.angles > 0)
        both = np.hypot(self.sigma[own], self.against_path[own])
        return float(np.abs(self.angles[own]).sum()), float(np.sqrt(np.sum(both**2)))


def travel(paths: BodyPaths, verdict: GaitVerdict, heading_sigma: Array | None = None) -> Travel:
    """Return way and turning of a person; paths: of a motion in world, z up; heading_sigma: (T,) rad, standard
    deviation of the heading of the pelvis; None if unknown.
    """
    pelvis, masks, nan = paths.joint("pelvis"), paths.masks, float("nan")
    seen: Mask = masks.position_observed[:, pelvis]
    heading = np.where(masks.valid[:, pelvis], paths.heading, np.nan)
    path = signals.low_pass_known(
        paths.times, np.where(seen[:, None], paths.points["pelvis"][:, :2], np.nan), CUTOFF_HZ
    )
    sigma = np.full(len(paths), np.nan) if heading_sigma is None else heading_sigma
    turns = _turns(paths.times, heading, sigma, path)
    known = path[seen]
    way = known[-1] - known[0] if len(known) else np.full(2, nan)
    displacement = float(np.linalg.norm(way))
    displacement = 0.0 if displacement < LEAST_WAY else displacement
    direction = float(np.arctan2(way[1], way[0])) if displacement > 0 else nan
    (left, left_sigma), (right, right_sigma) = ((nan, nan) if turns is None else turns.sum(sign) for sign in (1, -1))
    return Travel(
        max(_path_length(known), displacement),
        displacement,
        direction,
        _relative(direction, heading, turns),
        left,
        right,
        share_of_time(verdict.walking, paths.times),
        float(seen.mean()),
        _notes(masks.provenance[:, pelvis], seen),
        left_sigma,
        right_sigma,
        turns is not None and not bool(turns.certain.all()),
    )


def _turns(times: Array, heading: Array, sigma: Array, path: Array) -> _Turns | None:
    """Turns of a heading (T,), rad, with their errors; None if it was never observed; times: (T,) s; heading, sigma:
    (T,) rad; path: (T, 2) m, low-passed.
    """
    found = []
    moves = np.gradient(path, times, axis=0) if len(times) > 1 else np.full(path.shape, np.nan)
    moving = np.linalg.norm(moves, axis=1) > LEAST_SPEED
    runs = signals.runs(np.isfinite(heading))
    for start, stop in runs:
        own = np.unwrap(heading[start:stop])[:, None]
        smooth = signals.low_pass_known(times[start:stop], own, CUTOFF_HZ)[:, 0]
        points = _turning_points(smooth, LEAST_TURN)
        for first, last in pairwise(points):
            turn, frames = smooth[last] - smooth[first], slice(start + first, start + last + 1)
            against = 0.0
            if moving[frames].all():
                along = np.unwrap(np.arctan2(moves[frames, 1], moves[frames, 0]))
                against = turn - (along[-1] - along[0])
            found.append((turn, np.hypot(*sigma[[start + first, start + last]]), against))
    return _Turns(*np.reshape(found, (-1, 3)).T) if runs else None


def _turning_points(values: Array, least: float) -> list[int]:
    """Indices of the extrema of a signal between which it changes by some least value."""
    points: list[int] = []
    rising, low, high = 0, 0, 0
    for i, value in enumerate(values.tolist()):
        low, high = i if value < values[low] else low, i if value > values[high] else high
        if rising >= 0 and values[high] - value >= least:  # the signal has turned downwards
            points.append(high)
            rising, low = -1, i
        elif rising <= 0 and value - values[low] >= least:
            points.append(low)
            rising, high = 1, i
    return [*points, high if rising > 0 else low] if points else []


def _path_length(path: Array) -> float:
    """Length of a path (N, 2), m, from a point to the next that is `LEAST_WAY` away; NaN if unobserved."""
    if not (points := path.tolist()):
        return float("nan")
    anchor, way = points[0], 0.0
    for point in points:
        if (step := math.dist(point, anchor)) >= LEAST_WAY:
            way, anchor = way + step, point
    return way + math.dist(points[-1], anchor) if way else 0.0


def _relative(direction: float, heading: Array, turns: _Turns | None) -> float:
    """Direction of the way from the mean heading, rad in (-pi, pi]; NaN after a turn of a right angle."""
    if np.isnan(direction) or turns is None or np.abs(np.cumsum(turns.angles)).max(initial=0) > np.pi / 2:
        return float("nan")
    facing = np.angle(np.nanmean(np.exp(1j * heading)))
    return float(np.angle(np.exp(1j * (direction - facing))))


def _notes(provenance: NDArray[np.uint8], seen: Mask) -> tuple[str, ...]:
    """Sentences on gaps and drift of the pelvis, from (T,) its provenance and whether it was observed."""
    if not seen.any():
        return ("the pelvis was never observed",)
    notes = []
    if np.all(provenance[seen] == Provenance.IMU):
        notes.append(DRIFT)
    if not seen.all():
        share = 100 * float(1 - seen.mean())
        notes.append(f"the pelvis was not observed for {share:.0f} % of the time, which is crossed straight")
    return tuple(notes)
