"""Which foot is on the floor in each frame, by the motion alone.

In strides of walking the gait events say it. Elsewhere a foot may bear load while its heel or its toe is
low and slow; a foot whose orientation was mostly unobserved is judged by its ankle. The floor is as high as
the slow points usually are. No other contact is seen: a seat, a rail or a wall bears load unnoticed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.body_dynamics import UNKNOWN
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.gait_events import CUTOFF_HZ
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask

HEIGHT: Final = 0.06
"""[m] over the floor at which a point of the sole may still touch it."""
SPEED: Final = 0.7
"""[m/s] of a point of the sole that may bear load."""
SLOW: Final = 0.3
"""[m/s] of points that tell how high the floor is."""
SHORTEST: Final = 0.05
"""[s] of a contact or its absence."""


class Contact(IntEnum):
    """Feet that may bear load."""

    NOT_KNOWN = 0
    RIGHT = 1
    LEFT = 2
    BOTH = 3
    NONE = 4


STATUS: Final = {
    Contact.NOT_KNOWN: "not known",
    Contact.RIGHT: "right foot",
    Contact.LEFT: "left foot",
    Contact.BOTH: "two feet: split not identifiable",
    Contact.NONE: "no foot",
}
"""Each in words."""


@dataclass(frozen=True)
class FootContacts:
    """Contacts of the feet with a level floor."""

    state: NDArray[np.uint8]
    """(T,) `Contact`."""
    floor: float
    """[m] height of the floor in world; NaN if no foot was ever slow."""
    by_ankle: tuple[str, ...]
    """Sides whose sole was not observed: there is no outline of it."""
    notes: tuple[str, ...]

    @property
    def support(self) -> NDArray[np.int_]:
        """(T,) the foot that bears all load: 0 right, 1 left, `UNKNOWN` otherwise."""
        single = {Contact.RIGHT: 0, Contact.LEFT: 1}
        out = np.full(len(self.state), UNKNOWN)
        for contact, side in single.items():
            out[self.state == contact] = side
        return out


def foot_contacts(paths: BodyPaths, gait: GaitAnalysis) -> FootContacts:
    """Find the contacts of the feet."""
    T, notes = len(paths), []
    by_ankle = tuple(side for side in SIDES if _sole_unobserved(paths, side))
    soles = {side: _sole_points(paths, side, side in by_ankle) for side in SIDES}
    heights = _levels({side: _floor(own) for side, own in soles.items()}, by_ankle)
    by_sole = [heights[side] for side in SIDES if side not in by_ankle and np.isfinite(heights[side])]
    floor = by_sole[0] if by_sole else _below_ankles(paths, heights)
    touches = np.zeros((len(SIDES), T), dtype=np.bool_)
    unseen = np.zeros(T, dtype=np.bool_)
    for s, side in enumerate(SIDES):
        for points, speed in soles[side]:
            touches[s] |= (points[:, 2] < heights[side] + HEIGHT) & (speed < SPEED)
            unseen |= ~np.isfinite(points[:, 2])
        touches[s] = _without_short(touches[s], paths.rate_hz)
    state = np.select(
        [unseen, touches[0] & touches[1], touches[0], touches[1]],
        [Contact.NOT_KNOWN, Contact.BOTH, Contact.RIGHT, Contact.LEFT],
        Contact.NONE,
    ).astype(np.uint8)
    walked = single_support(gait)
    stance = both_stand(gait)
    state[(walked != UNKNOWN) & ~unseen] = (walked + 1)[(walked != UNKNOWN) & ~unseen]
    state[stance & ~unseen] = Contact.BOTH
    if by_ankle:
        notes.append(
            f"{' and '.join(by_ankle)} foot: orientation mostly unobserved; contacts are judged by the "
            "ankle, and whether a centre of pressure lies under the sole is not known"
        )
    return FootContacts(state, floor, by_ankle, tuple(notes))


def single_support(gait: GaitAnalysis) -> NDArray[np.int_]:
    """Return (T,) the foot that bears load while the other swings: 0 right, 1 left, `UNKNOWN` otherwise.

    It is unknown while both swing (running) and outside complete strides.
    """
    stands, swings = _phases(gait)
    out = np.full(stands.shape[1], UNKNOWN)
    for side in range(len(SIDES)):
        out[stands[side] & swings[1 - side]] = side
    return out


def both_stand(gait: GaitAnalysis) -> Mask:
    """Return (T,) frames in which both feet stand by their strides."""
    stands, swings = _phases(gait)
    return np.asarray(stands.all(axis=0) & ~swings.any(axis=0))


def _phases(gait: GaitAnalysis) -> tuple[Mask, Mask]:
    """(2, T) frames in which each foot stands, and swings, by its strides."""
    times = gait.events.times
    swings, stands = np.zeros((2, len(SIDES), len(times)), dtype=np.bool_)
    for stride in gait.strides:
        side = SIDES.index(stride.side)
        own = stride.frames(times)
        swings[side, own] |= (times[own] > stride.toe_off) & (times[own] < stride.stop)
        stands[side, own] |= (times[own] >= stride.start) & (times[own] <= stride.toe_off)
    return stands, swings


def _sole_unobserved(paths: BodyPaths, side: str) -> bool:
    """Whether the orientation of a foot is unobserved for more than half of the time."""
    masks, foot = paths.masks, paths.joint(f"{side} foot")
    if not masks.has_sources:
        return False
    seen = masks.position_observed[:, foot]
    return bool(2 * np.sum(seen & masks.orientation_observed[:, foot]) < np.sum(seen))


def _sole_points(paths: BodyPaths, side: str, by_ankle: bool) -> list[tuple[Array, Array]]:
    """Low-passed paths (T, 3) and speeds (T,) of heel and toe, or of the ankle."""
    out = []
    for word in ("foot",) if by_ankle else ("heel", "toe"):
        points = signals.low_pass_known(paths.times, paths.points[f"{side} {word}"], CUTOFF_HZ)
        speed = np.full(len(points), np.nan)
        for start, stop in signals.runs(np.isfinite(points).all(axis=1)):
            if stop - start > 1:
                rates = np.gradient(points[start:stop], paths.times[start:stop], axis=0)
                speed[start:stop] = np.linalg.norm(rates, axis=1)
        out.append((points, speed))
    return out


def _floor(points: list[tuple[Array, Array]]) -> float:
    """Usual height of the lowest of some points, each (T, 3) with its speed (T,), while it is slow, m."""
    heights = np.array([np.where(speed < SLOW, path[:, 2], np.inf) for path, speed in points]).min(axis=0)
    slow = heights[np.isfinite(heights)]
    return float(np.median(slow)) if len(slow) else float("nan")


def _levels(heights: dict[str, float], by_ankle: tuple[str, ...]) -> dict[str, float]:
    """Heights of the floor's points by side: feet of one kind stand on one level, unless one is raised."""
    out = {}
    for side in heights:
        alike = [h for s, h in heights.items() if (s in by_ankle) == (side in by_ankle) and np.isfinite(h)]
        low = [h for h in alike if h < min(alike) + HEIGHT]
        out[side] = float(np.mean(low)) if low else float("nan")
    return out


def _below_ankles(paths: BodyPaths, heights: dict[str, float]) -> float:
    """The floor under ankles at the height at which the skeleton's stand on it, m."""
    known = [height for height in heights.values() if np.isfinite(height)]
    heels = [paths.skeleton.landmarks[paths.table.segments[f"{side} heel"]][1][2] for side in SIDES]
    return float(np.mean(known) + np.mean(heels)) if known else float("nan")


def _without_short(mask: Mask, rate_hz: float) -> Mask:
    """A mask (T,) in which gaps and runs shorter than `SHORTEST` are gone."""
    out = mask.copy()
    for value in (False, True):
        for start, stop in signals.runs(out == value):
            if stop - start < SHORTEST * rate_hz and start > 0 and stop < len(out):
                out[start:stop] = not value
    return out
