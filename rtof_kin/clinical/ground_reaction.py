"""Ground reaction force and centre of pressure from the motion, and what is not identifiable (docs/dynamics.md).

The wrench that a motion needs from outside (`JointTorques.wrench`) is what the floor exerts, where nothing else touches
the person. Its force F and the point of the floor about which it has no horizontal moment, the centre of pressure,
follow in single and in double support. How two feet share the force is not identifiable; both centres of pressure lie
inside the soles, and no foot pulls, so the share s of the right foot satisfies

::

    p = s p_right + (1 - s) p_left      p_right, p_left inside their soles

for the centre of pressure p of both: its extremes are vertices of a linear programme, solved in closed form, and the
interval stated is the widest over p and its 95 % band.

Contacts are those of gait events in strides of walking. Elsewhere a foot may bear load while its heel or its toe (its
ankle where its orientation was mostly unobserved) is low and slow; the floor is as high as the slow points usually are.
No other contact is seen: a seat, a rail or a wall bears load unnoticed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.body_dynamics import UNKNOWN
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.gait_events import CUTOFF_HZ
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.clinical.torques import JointTorques
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu import STANDARD_GRAVITY

HEIGHT: Final = 0.06  #: [m] over the floor at which a point of the sole may still touch it
SPEED: Final = 0.7  #: [m/s] of a point of the sole that may bear load
SLOW: Final = 0.3  #: [m/s] of points that tell how high the floor is
SHORTEST: Final = 0.05  #: [s] of a contact or its absence


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

    state: NDArray[np.uint8]  #: (T,) `Contact`
    floor: float  #: [m] height of the floor in world; NaN if no foot was ever slow
    by_ankle: tuple[str, ...]  #: Sides whose sole was not observed: there is no outline of it
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
    stands, swings = _phases(gait)
    stance = stands.all(axis=0) & ~swings.any(axis=0)
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


HALF_WIDTH: Final = 0.05  #: [m] of a sole, to either side of the line from heel to toe
BEYOND: Final = 0.02  #: [m] of a sole behind the heel's point and before the toe's
MISSED: Final = 0.3  #: Share of the body weight that cannot be an error in flight: some contact was missed
LEAST_FORCE: Final = 0.1
"""Share of the body weight below which there is no centre of pressure: it would be force over noise."""
OUTSIDE: Final = 0.03  #: [m] outside the soles at which a centre of pressure contradicts the contacts
MANY: Final = 10.0  #: [%] of the frames from which on a contradiction is noted
_FRICTION: Final = 0.9  #: Largest coefficient of friction between shoes and floors
_BLOCK: Final = 2000  #: Frames that are computed at a time


@dataclass(frozen=True)
class GroundReaction:
    """Force of the floor on the person; NaN where unknown, two sides in the order of `SIDES`."""

    times: Array  #: (T,) s
    weight_kg: float  #: Body mass, kg
    state: NDArray[np.uint8]  #: (T,) `Contact`
    force: Array  #: (T, 3) N, of all external contacts together, world axes
    force_sigma: Array  #: (T, 3) N, its standard deviations
    pressure: Array  #: (T, 2) m, centre of pressure of both feet together on the floor, world
    pressure_sigma: Array  #: (T, 2) m, its standard deviations relative to the feet
    outside: Array  #: (T,) m, distance of the centre of pressure from the soles on the floor; 0 inside
    vertical: Array  #: (T, 2, 2) N, lowest and highest vertical force on each foot; equal where one foot bears all
    floor: float  #: [m] height of the floor in world
    notes: tuple[str, ...]

    @property
    def body_weight(self) -> float:
        """Body weight, N."""
        return self.weight_kg * STANDARD_GRAVITY


def ground_reaction(torques: JointTorques, contacts: FootContacts, paths: BodyPaths) -> GroundReaction:
    """Return force and centre of pressure."""
    force = torques.wrench[:, :3]
    weight = torques.weight_kg * STANDARD_GRAVITY
    missed = (contacts.state == Contact.NONE) & (force[:, 2] > MISSED * weight)
    state = np.where(missed, Contact.NOT_KNOWN, contacts.state).astype(np.uint8)
    on_floor = np.isin(state, (Contact.RIGHT, Contact.LEFT, Contact.BOTH))
    loaded = (force[:, 2] > LEAST_FORCE * weight) & on_floor
    parts = []
    for own in blocks_of(len(force), _BLOCK):
        by_motion, by_masses = np.moveaxis(torques.wrench_covariances(own), 1, 0)
        unknown = np.isnan(by_motion).all(axis=(1, 2), keepdims=True)
        covariance = np.where(unknown, 0.0, by_motion) + by_masses
        pressure, spread = _pressure(torques.wrench[own], torques.reference[own], covariance, contacts.floor)
        pressure[~loaded[own]], spread[~loaded[own]] = np.nan, np.nan
        soles = np.stack([_sole(paths, side, own) for side in SIDES], axis=1)
        soles[:, [side in contacts.by_ankle for side in SIDES]] = np.nan
        outside = _outside(pressure, soles, state[own])
        vertical = _vertical(force[own, 2], pressure, spread, soles, state[own])
        parts.append((_deviations(covariance)[:, :3], pressure, _deviations(spread), outside, vertical))
    sigma, pressure, spread, outside, vertical = map(np.concatenate, zip(*parts, strict=True))
    known = torques.times, torques.weight_kg, state, force, sigma, pressure, spread, outside, vertical
    found = GroundReaction(*known, contacts.floor, ())
    return replace(found, notes=(*_notes(found, missed), *contacts.notes))


def _deviations(covariance: Array) -> Array:
    """Standard deviations (N, k) of covariances (N, k, k)."""
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))


def _pressure(wrench: Array, reference: Array, covariance: Array, floor: float) -> tuple[Array, Array]:
    """Centre of pressure (N, 2), m, and its covariance (N, 2, 2) relative to the reference."""
    force, moment = wrench[:, :3], wrench[:, 3:]
    height = reference[:, 2] - floor
    with np.errstate(divide="ignore", invalid="ignore"):
        per = 1 / force[:, 2]
        x = -(moment[:, 1] + height * force[:, 0]) * per
        y = (moment[:, 0] - height * force[:, 1]) * per
        J = np.zeros((len(force), 2, 6))
        J[:, 0, 0] = J[:, 1, 1] = -height * per
        J[:, 0, 2], J[:, 1, 2] = -x * per, -y * per
        J[:, 0, 4], J[:, 1, 3] = -per, per
        spread = J @ covariance @ np.swapaxes(J, -1, -2)
    return reference[:, :2] + np.stack([x, y], axis=1), np.asarray(spread)


def _sole(paths: BodyPaths, side: str, frames: slice) -> Array:
    """(N, 4, 2) m, corners of a sole on the floor, in order around it."""
    heel, toe = (paths.points[f"{side} {word}"][frames, :2] for word in ("heel", "toe"))
    way = toe - heel
    with np.errstate(invalid="ignore", divide="ignore"):
        along = way / np.linalg.norm(way, axis=1, keepdims=True)
    across = HALF_WIDTH * np.stack([-along[:, 1], along[:, 0]], axis=1)
    back, front = heel - BEYOND * along, toe + BEYOND * along
    return np.stack([back - across, front - across, front + across, back + across], axis=1)


def _outside(pressure: Array, soles: Array, state: NDArray[np.uint8]) -> Array:
    """(N,) m, distance of points (N, 2) from the convex hull of the soles (N, 2, 4, 2) on the floor."""
    out = np.full(len(pressure), np.nan)
    for contact, sides in {Contact.RIGHT: [0], Contact.LEFT: [1], Contact.BOTH: [0, 1]}.items():
        frames = np.flatnonzero((state == contact) & np.isfinite(pressure[:, 0]))
        frames = frames[np.isfinite(soles[frames][:, sides]).all(axis=(1, 2, 3))]
        corners = soles[frames][:, sides].reshape(len(frames), 4 * len(sides), 2)
        out[frames] = _hull_distance(pressure[frames], corners)
    return out


def _hull_distance(points: Array, corners: Array) -> Array:
    """Distances (n,) of points (n, 2) from the convex hulls of corners (n, k, 2).

    The hull's edges are among the segments between corners. A point is inside where no line through it has
    all corners on one side: the corners' directions leave no gap of half a turn.
    """
    if not len(points):
        return np.zeros(0)
    off = corners - points[:, None]
    direction = np.sort(np.arctan2(off[..., 1], off[..., 0]), axis=1)
    gaps = np.diff(direction, axis=1, append=direction[:, :1] + 2 * np.pi)
    inside = gaps.max(axis=1) <= np.pi
    i, j = np.array(list(combinations(range(corners.shape[1]), 2))).T
    a, edge = corners[:, i], corners[:, j] - corners[:, i]
    share = np.sum((points[:, None] - a) * edge, axis=-1) / np.maximum(np.sum(edge**2, axis=-1), 1e-12)
    nearest = a + np.clip(share, 0, 1)[..., None] * edge
    distance = np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)
    return np.asarray(np.where(inside, 0.0, distance))


def _vertical(force: Array, pressure: Array, covariance: Array, soles: Array, state: NDArray[np.uint8]) -> Array:
    """(N, 2, 2) N, lowest and highest vertical force on each foot."""
    out = np.full((len(force), 2, 2), np.nan)
    for side, contact in enumerate((Contact.RIGHT, Contact.LEFT)):
        alone = state == contact
        out[alone, side], out[alone, 1 - side] = force[alone, None], 0.0
    out[state == Contact.NONE] = 0.0
    both = np.flatnonzero((state == Contact.BOTH) & (force > 0))
    out[both] = np.stack([np.zeros(len(both)), force[both]], axis=1)[:, None]  # without soles
    seen = both[np.isfinite(pressure[both, 0]) & np.isfinite(soles[both]).all(axis=(1, 2, 3))]
    low, high = _shares(_band(pressure[seen], covariance[seen]), soles[seen])
    known = np.isfinite(low)
    F, low, high = force[seen][known], low[known], high[known]
    out[seen[known], 0] = np.stack([low * F, high * F], axis=1)
    out[seen[known], 1] = np.stack([(1 - high) * F, (1 - low) * F], axis=1)
    return out


def _band(pressure: Array, covariance: Array) -> Array:
    """(n, 5, 2) the centres of pressure and the ends of the axes of their 95 % ellipses."""
    sizes, axes = np.linalg.eigh(np.nan_to_num(covariance))
    ends = BAND_95 * np.swapaxes(axes, -1, -2) * np.sqrt(np.maximum(sizes, 0.0))[..., None]
    steps = np.concatenate([np.zeros((len(pressure), 1, 2)), ends, -ends], axis=1)
    return np.asarray(pressure[:, None] + steps)


def _shares(points: Array, soles: Array) -> tuple[Array, Array]:
    """Least and largest share (n,) of the right foot for any of the points (n, k, 2); NaN where none of them
    lies between the soles (n, 2, 4, 2).

    The extremes of a linear programme with three equations are at weights of at most three corners.
    """
    corners = soles.reshape(len(soles), 8, 2)
    right = np.arange(8) < 4
    low, high = np.full((2, len(points)), np.nan)
    for chosen in combinations(range(8), 3):
        index = list(chosen)
        A = np.concatenate([np.swapaxes(corners[:, index], 1, 2), np.ones((len(soles), 1, 3))], axis=1)
        usable = np.abs(np.linalg.det(A)) > 1e-9
        A[~usable] = np.eye(3)
        ones = np.ones((len(soles), 1, points.shape[1]))
        targets = np.concatenate([np.swapaxes(points, 1, 2), ones], axis=1)
        weights = np.linalg.solve(A, targets)
        feasible = usable[:, None] & (weights >= -1e-9).all(axis=1)
        share = np.where(feasible, np.clip(weights[:, right[index]].sum(axis=1), 0.0, 1.0), np.nan)
        low, high = np.fmin(low, np.fmin.reduce(share, axis=1)), np.fmax(high, np.fmax.reduce(share, axis=1))
    return low, high


def _notes(found: GroundReaction, missed: Mask) -> list[str]:
    """What is not identifiable, and what contradicts the contacts."""
    known = np.isfinite(found.force[:, 2])
    if not known.any():
        return ["no frame has a ground reaction force"]

    def percent(of: Mask) -> float:
        return 100 * float(np.mean(of))

    both, flight = found.state == Contact.BOTH, found.state == Contact.NONE
    notes = []
    if percent(both[known]) > 0:
        notes.append(
            f"in {percent(both[known]):.0f} % of the frames both feet are on the floor: their sum and its "
            "centre of pressure are given, the share of each is not identifiable; its interval is"
        )
    seen = np.isfinite(found.outside)
    far = found.outside[seen] > OUTSIDE
    if seen.any() and percent(far) > MANY:
        notes.append(
            f"in {percent(far):.0f} % of the frames the centre of pressure lies outside the soles, by up to "
            f"{100 * np.max(found.outside[seen]):.0f} cm, which cannot be: something else bears load "
            "(a seat, a rail, the hands), or contacts, masses or motion are wrong"
        )
    with np.errstate(invalid="ignore"):
        slides = np.hypot(found.force[:, 0], found.force[:, 1]) > _FRICTION * np.abs(found.force[:, 2])
        pulls = found.force[:, 2] < -LEAST_FORCE * found.body_weight
    stands = known & (found.state != Contact.NOT_KNOWN) & ~flight
    if stands.any() and percent((slides | pulls)[stands]) > MANY:
        notes.append(
            f"in {percent((slides | pulls)[stands]):.0f} % of the frames with a foot on the floor the force "
            "would make it slide or pull: contacts or motion are wrong there"
        )
    if missed.any():
        notes.append(
            f"in {percent(missed[known]):.0f} % of the frames the motion needs a force, but no foot seems "
            "to be on the floor: a contact was missed, or something else bears load"
        )
    if percent(flight[known]) > 0:
        residual = np.linalg.norm(found.force[known & flight], axis=1) / found.body_weight
        notes.append(
            f"without a foot on the floor the force should be zero, and is {np.sqrt(np.mean(residual**2)):.2f} body "
            "weights (root mean square): the error of the motion's acceleration"
        )
    if percent(((found.state == Contact.NOT_KNOWN) & ~missed)[known]) > 0:
        notes.append("where a foot is unobserved, it is not known which feet bear load")
    return notes
