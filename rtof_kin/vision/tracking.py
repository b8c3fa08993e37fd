"""One of several people, followed through a video.

People are linked from frame to frame by where their points are, in units of their size, with the speed
they had; a link that another person could have taken as well is marked. Then one person is picked: the
one who is large, in the middle and there most of the time, or the one asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rtof_kin.core.errors import ShapeError
from rtof_kin.vision.detections import NO_IDENTITY, Detections

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
NOBODY = -1
LONGEST_GAP = 1.0
"""Seconds after which somebody who was not seen is a new person at first."""
REACH, REACH_RATE = 0.25, 2.0
"""How far from where they were expected somebody may be, in their own size, and how that grows per s."""
FURTHEST = 1.5
"""The most it grows to."""
RESIZED = 1.8
"""Nobody gets so many times larger or smaller over a gap."""
AMBIGUOUS = 2.0
"""A link is ambiguous where the next best is less than so many times as far."""
_SMALLEST_SIZE_PX = 1.0
_FEW_POINTS = 3


@dataclass(frozen=True)
class PersonTrack:
    """Which of the people in each frame is the one that was followed."""

    person: Ints
    """(T,) index among the people of the frame, -1 where the person was lost."""
    ambiguous: Mask
    """(T,) whether somebody else could have been taken for the person as well."""
    people: int
    """How many people were seen in all, as far as they could be told apart."""
    reason: str
    """A sentence: why this one."""

    @property
    def lost(self) -> Mask:
        """(T,) whether the person was not there."""
        return np.asarray(self.person == NOBODY)

    def of(self, detections: Detections) -> tuple[Array, Array]:
        """The person's points (T, K, 2), px, and confidence (T, K); NaN and 0 where lost."""
        frames, index = np.arange(len(self.person)), np.maximum(self.person, 0)
        uv = np.where(self.lost[:, None, None], np.nan, detections.uv_px[frames, index])
        return uv, np.where(self.lost[:, None], 0.0, detections.confidence[frames, index])


@dataclass
class _Trail:
    """Somebody as far as they could be followed."""

    frames: list[int] = field(default_factory=list)
    people: list[int] = field(default_factory=list)
    unsure: list[int] = field(default_factory=list)
    """Frames in which the link was ambiguous."""
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(K, 2) last place of each point, NaN where not seen in the last frame."""
    size: float = 0.0
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    """px per s."""
    seen_at: float = 0.0
    identity: int = NO_IDENTITY


def track_person(
    detections: Detections,
    times: Array,
    person: int | None = None,
    frame: int | None = None,
    image_px: tuple[float, float] | None = None,
) -> PersonTrack:
    """Follow one person.

    Args:
        detections: everybody. times: (T,) s.
        person: index among the people of `frame`; where not given, the one who is largest, most in the
            middle and most often seen.
        frame: in which `person` is that number; the first with anybody where not given.
        image_px: width and height, to know the middle; the middle of everybody where not given.

    Raises:
        ShapeError: there is nobody of that number in that frame.
    """
    present = detections.present
    if person is None and present.shape[1] == 1:
        track = np.where(present[:, 0], 0, NOBODY)
        return PersonTrack(track, np.zeros(len(track), dtype=np.bool_), 1, "nobody else was seen")
    measures = _Measures(detections)
    trails = _trails(measures, times)
    if person is None:
        weight = [_prominence(trail, measures, image_px) for trail in trails]
        chosen = trails[int(np.argmax(weight))]
        reason = f"of {len(trails)} people the largest, most in the middle and most often seen"
    else:
        chosen, where = _asked(trails, present, person, frame)
        reason = f"asked for: person {person} in frame {where}"
    return _joined(chosen, trails, measures, times, len(trails), reason)


class _Measures:
    """What is needed of every person in every frame."""

    def __init__(self, detections: Detections):
        self.uv = detections.uv_px
        self.present = detections.present
        self.identity = detections.identity
        filled = np.where(np.isnan(self.uv), 0.0, self.uv)
        seen = np.isfinite(self.uv).all(axis=-1)
        count = np.maximum(seen.sum(axis=-1), 1)
        self.seen = seen
        self.centre: Array = filled.sum(axis=2) / count[..., None]
        square = np.where(seen, ((filled - self.centre[:, :, None]) ** 2).sum(axis=-1), 0.0)
        self.size: Array = np.maximum(2 * np.sqrt(square.sum(axis=-1) / count), _SMALLEST_SIZE_PX)
        """(T, P) twice the RMS radius of a person's points, px: about half as tall as they are."""
        self.confidence: Array = detections.confidence.sum(axis=-1)

    def people(self, frame: int) -> list[int]:
        return [int(p) for p in np.flatnonzero(self.present[frame])]

    def known_as(self, frame: int, person: int) -> int:
        return NO_IDENTITY if self.identity is None else int(self.identity[frame, person])


def _trails(measures: _Measures, times: Array) -> list[_Trail]:
    """Everybody, as far as they can be followed without a gap longer than `LONGEST_GAP`."""
    finished: list[_Trail] = []
    open_trails: list[_Trail] = []
    for t, now in enumerate(times):
        people = measures.people(t)
        finished += [trail for trail in open_trails if now - trail.seen_at > LONGEST_GAP]
        open_trails = [trail for trail in open_trails if now - trail.seen_at <= LONGEST_GAP]
        taken = _link(open_trails, measures, t, people, float(now))
        for person in people:
            if person not in taken:
                open_trails.append(_Trail())
                _extend(open_trails[-1], measures, t, person, float(now))
    return finished + open_trails


def _link(trails: list[_Trail], measures: _Measures, t: int, people: list[int], now: float) -> set[int]:
    """Give each person of a frame to at most one trail, the nearest in sum; returns who was given."""
    if not trails or not people:
        return set()
    far = np.array([[_distance(trail, measures, t, p, now) for p in people] for trail in trails])
    allowed = np.isfinite(far)
    rows, columns = linear_sum_assignment(np.where(allowed, far, 1e6))
    taken = set()
    for row, column in zip(rows, columns, strict=True):
        if not allowed[row, column]:
            continue
        others = np.concatenate([np.delete(far[row], column), np.delete(far[:, column], row)])
        least = max(far[row, column], 0.05)
        if np.any(others < AMBIGUOUS * least):
            trails[row].unsure.append(t)
        _extend(trails[row], measures, t, people[column], now)
        taken.add(people[column])
    return taken


def _distance(trail: _Trail, measures: _Measures, t: int, person: int, now: float) -> float:
    """How far somebody is from where the trail leads, in their size; inf where it cannot be them."""
    identity = measures.known_as(t, person)
    if NO_IDENTITY not in (identity, trail.identity):
        return 0.0 if identity == trail.identity else np.inf
    gap, size = now - trail.seen_at, measures.size[t, person]
    if not 1 / RESIZED < size / trail.size < RESIZED and gap > 0:
        return np.inf
    expected = trail.points + trail.velocity * min(gap, 0.2)
    far = np.linalg.norm(measures.uv[t, person] - expected, axis=-1)
    both = np.isfinite(far)
    if both.sum() >= _FEW_POINTS:
        distance = float(np.median(far[both]))
    else:
        distance = float(np.linalg.norm(measures.centre[t, person] - np.nanmean(expected, axis=0)))
    distance /= max(size, trail.size)
    return distance if distance < min(REACH + REACH_RATE * gap, FURTHEST) else np.inf


def _extend(trail: _Trail, measures: _Measures, t: int, person: int, now: float) -> None:
    points = measures.uv[t, person]
    if trail.frames:
        moved = np.linalg.norm(points - trail.points, axis=-1)
        both = np.isfinite(moved)
        if both.sum() >= _FEW_POINTS:
            step = np.median((points - trail.points)[both], axis=0) / max(now - trail.seen_at, 1e-3)
            trail.velocity = 0.7 * trail.velocity + 0.3 * step
        trail.size += 0.3 * (measures.size[t, person] - trail.size)
    else:
        trail.size = float(measures.size[t, person])
    trail.points = points
    trail.frames.append(t)
    trail.people.append(person)
    trail.seen_at = now
    identity = measures.known_as(t, person)
    trail.identity = identity if identity != NO_IDENTITY else trail.identity


def _prominence(trail: _Trail, measures: _Measures, image_px: tuple[float, float] | None) -> float:
    """How much somebody is the subject of a video: size, points seen and middle, summed over frames."""
    at = (np.array(trail.frames), np.array(trail.people))
    everybody = measures.centre[measures.present]
    middle = np.array(image_px) / 2 if image_px is not None else np.median(everybody, axis=0)
    width = 2 * float(middle[0]) if image_px is not None else float(np.ptp(everybody[:, 0])) + 1.0
    off = np.abs(measures.centre[at][:, 0] - middle[0]) / max(width / 2, 1.0)
    return float((measures.size[at] * measures.confidence[at] / (1 + off)).sum())


def _asked(trails: Iterable[_Trail], present: Mask, person: int, frame: int | None) -> tuple[_Trail, int]:
    where = int(np.argmax(present.any(axis=1))) if frame is None else frame
    for trail in trails:
        if (where, person) in zip(trail.frames, trail.people, strict=True):
            return trail, where
    count = int(present[where].sum()) if 0 <= where < len(present) else 0
    known = ", ".join(map(str, np.flatnonzero(present[where]))) if count else "nobody"
    raise ShapeError(
        f"person {person} in frame {where}: there is no such person; of {len(present)} frames, counted "
        f"from 0, that one has {known}"
    )


def _joined(
    chosen: _Trail, trails: list[_Trail], measures: _Measures, times: Array, people: int, reason: str
) -> PersonTrack:
    """The trail chosen, and those before and after it that are most likely the same person's."""
    parts = [chosen]
    for forward in (True, False):
        edge = chosen
        while True:
            after = [t for t in trails if t.frames and _follows(edge, t, forward, measures)]
            if not after:
                break
            edge = min(after, key=lambda t: _jump(edge, t, forward, measures, times))
            parts.append(edge)
    person = np.full(len(times), NOBODY, dtype=np.int64)
    ambiguous = np.zeros(len(times), dtype=np.bool_)
    for part in parts:
        person[part.frames] = part.people
        ambiguous[part.unsure] = True
        if part is not chosen:  # nobody saw how the person got there
            ambiguous[part.frames[0]] = True
    return PersonTrack(person, ambiguous, people - len(parts) + 1, reason)


def _ends(edge: _Trail, other: _Trail, forward: bool) -> tuple[int, int, int, int]:
    """Frame and person at the end of one trail and at the start of the one that goes on, in time's order
    or against it.
    """
    i, j = (-1, 0) if forward else (0, -1)
    return edge.frames[i], edge.people[i], other.frames[j], other.people[j]


def _follows(edge: _Trail, other: _Trail, forward: bool, measures: _Measures) -> bool:
    """Whether a trail may be the same person's after (or before) a gap: later, and of about that size."""
    end, who, start, other_who = _ends(edge, other, forward)
    if (start <= end) if forward else (start >= end):
        return False
    if NO_IDENTITY not in (edge.identity, other.identity) and edge.identity != other.identity:
        return False
    return bool(1 / RESIZED < measures.size[start, other_who] / measures.size[end, who] < RESIZED)


def _jump(edge: _Trail, other: _Trail, forward: bool, measures: _Measures, times: Array) -> float:
    """How unlikely it is that a trail goes on as another: the time between and the way, in sizes."""
    end, who, start, other_who = _ends(edge, other, forward)
    way = np.linalg.norm(measures.centre[start, other_who] - measures.centre[end, who])
    return float(abs(times[start] - times[end]) + way / measures.size[end, who])
