"""Tracking of one of several people through a video.

People are linked from frame to frame by the positions of their points, in units of their size, with a
constant-velocity prediction; a link that another person fits nearly as well is marked ambiguous. Then one
person is chosen: large, central and present most of the time, or the one asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.vision.detections import NO_IDENTITY, Detections, Person

Ints = NDArray[np.int64]
NOBODY = -1
_LONGEST_GAP = 1.0  # [s] after which a person is at first treated as a new one
_BRIEFEST = 0.25  # [s] seen, below which somebody elsewhere after a gap is a false detection, not the person
_REACH, _REACH_RATE, _FURTHEST = 0.25, 2.0, 1.5  # [sizes], [sizes/s], [sizes] from the predicted position
_RESIZED = 1.8  # [-] largest change of size over a gap
_AMBIGUOUS = 2.0  # [-] distance of the next best person relative to the linked one
_SMALLEST_SIZE_PX = 1.0
_FEW_POINTS = 3


@dataclass(frozen=True)
class PersonTrack:
    """Index of the tracked person in each frame."""

    person: Ints  #: (T,) index among the people of the frame, -1 where lost
    ambiguous: Mask  #: (T,) frames in which another person fits nearly as well
    people: int  #: Number of people in the video
    reason: str  #: How the person was chosen

    @property
    def lost(self) -> Mask:
        """(T,) frames without the person."""
        return np.asarray(self.person == NOBODY)

    def of(self, detections: Detections, frames: slice = slice(None)) -> tuple[Array, Array]:
        """Return the person's points (T, K, 2), px, and confidence (T, K) in some frames; NaN and 0 where lost."""
        at, lost = (np.arange(len(self.person))[frames], np.maximum(self.person[frames], 0)), self.lost[frames]
        uv, confidence = detections.uv_px[at], detections.confidence[at]
        uv[lost], confidence[lost] = np.nan, 0.0
        return uv, confidence

    def in_space(self, detections: Detections) -> Array | None:
        """Return the person's points in space (T, K, 3), m, NaN where lost; None where the detector gave none."""
        if detections.p_model is None:
            return None
        p = detections.p_model[np.arange(len(self.person)), np.maximum(self.person, 0)]
        return np.where(self.lost[:, None, None], np.nan, p)


class _Measures:
    """Centre (T, P, 2), size (T, P) and identity of every person in every frame."""

    def __init__(self, detections: Detections):
        self.uv = uv = detections.uv_px
        self.present = detections.present
        self.centre: Array = np.empty((*uv.shape[:2], 2))
        self.size: Array = np.empty(uv.shape[:2])
        """Twice the RMS radius, px: about half a standing person's height."""
        for frames in blocks_of(len(uv)):
            seen = np.isfinite(uv[frames]).all(axis=-1)
            filled, count = np.where(np.isnan(uv[frames]), 0.0, uv[frames]), np.maximum(seen.sum(axis=-1), 1)
            self.centre[frames] = filled.sum(axis=2) / count[..., None]
            square = np.where(seen, ((filled - self.centre[frames, :, None]) ** 2).sum(axis=-1), 0.0)
            self.size[frames] = np.maximum(2 * np.sqrt(square.sum(axis=-1) / count), _SMALLEST_SIZE_PX)
        self.confidence: Array = detections.confidence.sum(axis=-1)
        none = np.full(self.present.shape, NO_IDENTITY)
        self.identity: Ints = none if detections.identity is None else detections.identity
        self.identified = bool((self.identity[self.present] != NO_IDENTITY).all())


def _median(values: Array) -> Array:
    """Return that of a few values (n, ...) without NaN: the same as NumPy's in a fifth of its time."""
    ordered, n = np.sort(values, axis=0), len(values)
    return np.asarray((ordered[(n - 1) // 2] + ordered[n // 2]) / 2)


@dataclass(eq=False)
class _Trail:
    """A person without gaps longer than `_LONGEST_GAP`."""

    frames: list[int] = field(default_factory=list)
    people: list[int] = field(default_factory=list)
    unsure: list[int] = field(default_factory=list)  # frames with an ambiguous link
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (K, 2) px, in the last frame
    size: float = 0.0
    velocity: Array = field(default_factory=lambda: np.zeros(2))  # px/s
    seen_at: float = 0.0
    identity: int = NO_IDENTITY

    def extend(self, measures: _Measures, t: int, person: int, now: float) -> None:
        """Append person number `person` of frame `t`, at time `now`, s."""
        points, size = measures.uv[t, person], float(measures.size[t, person])
        if self.frames and not measures.identified:  # else the velocity is not looked at
            moved = points - self.points
            both = np.isfinite(moved).all(axis=-1)
            if both.sum() >= _FEW_POINTS:
                step = _median(moved[both]) / max(now - self.seen_at, 1e-3)
                self.velocity = 0.7 * self.velocity + 0.3 * step
        self.size = self.size + 0.3 * (size - self.size) if self.frames else size
        self.points, self.seen_at = points, now
        self.frames.append(t)
        self.people.append(person)
        if measures.identity[t, person] != NO_IDENTITY:
            self.identity = int(measures.identity[t, person])

    def forget(self) -> None:
        """Keep the last frame alone."""
        self.frames, self.people = self.frames[-1:], self.people[-1:]

    def distance(self, measures: _Measures, t: int, person: int, now: float) -> float:
        """Return the distance of a person from the prediction, in sizes; inf beyond the reach."""
        identity = measures.identity[t, person]
        if NO_IDENTITY not in (identity, self.identity):
            return 0.0 if identity == self.identity else np.inf
        gap, size = now - self.seen_at, measures.size[t, person]
        if not 1 / _RESIZED < size / self.size < _RESIZED and gap > 0:
            return np.inf
        expected = self.points + self.velocity * min(gap, 0.2)
        far = np.linalg.norm(measures.uv[t, person] - expected, axis=-1)
        both = np.isfinite(far)
        if both.sum() >= _FEW_POINTS:
            distance = float(_median(far[both]))
        else:
            distance = float(np.linalg.norm(measures.centre[t, person] - np.nanmean(expected, axis=0)))
        distance /= max(size, self.size)
        return distance if distance < min(_REACH + _REACH_RATE * gap, _FURTHEST) else np.inf


def track_person(
    detections: Detections,
    times: Array,
    person: int | None = None,
    frame: int | None = None,
    image_px: tuple[float, float] | None = None,
) -> PersonTrack:
    """Track one person. `InvalidInputError`: there is no such person in that frame.

    Args:
        times: (T,) s. person: index among the people of `frame`; None: the largest, most central and most often seen.
        frame: frame of `person`; None: the first with people.
        image_px: width and height of the image; None: the centre is that of all people.
    """
    present = detections.present
    if person is None and present.shape[1] == 1:
        track = np.where(present[:, 0], 0, NOBODY)
        return PersonTrack(track, np.zeros(len(track), dtype=np.bool_), 1, "the only person")
    measures = _Measures(detections)
    trails = _trails(measures, times)
    if person is None:
        weight = [_prominence(trail, measures, image_px) for trail in trails]
        chosen = trails[int(np.argmax(weight))]
        reason = f"of {len(trails)} people the largest, most in the middle and most often seen"
    else:
        where = int(np.argmax(present.any(axis=1))) if frame is None else frame
        own = [trail for trail in trails if (where, person) in zip(trail.frames, trail.people, strict=True)]
        if not own:
            known = (np.flatnonzero(present[where]) + 1).tolist() if 0 <= where < len(present) else []
            problem = f"there is no such person; of {len(present)} frames, that one has {known or 'none'}"
            raise InvalidInputError(
                f"person {person + 1} in frame {where}: {problem} (people count from 1, frames from 0)"
            )
        chosen, reason = own[0], f"asked for: person {person + 1} in frame {where}"
    parts = _continued(chosen, trails, measures, times)
    return _track(parts, len(trails) - len(parts) + 1, times, reason)


def track_people(
    detections: Detections, times: Array, image_px: tuple[float, float] | None = None
) -> tuple[tuple[PersonTrack, float], ...]:
    """Track everyone, the most prominent first, at times (T,), s, each with a weight: the sum over frames of size times
    confidence, less off the centre of the image, as for `track_person`.
    """
    measures = _Measures(detections)
    left = _trails(measures, times)
    weights = {id(trail): _prominence(trail, measures, image_px) for trail in left}
    people = []
    while left:
        chosen = max(left, key=lambda trail: weights[id(trail)])
        parts = _continued(chosen, left, measures, times)
        track = _track(parts, len(left) - len(parts) + 1, times, "one of those in the video")
        people.append((track, sum(weights[id(part)] for part in parts)))
        left = [trail for trail in left if trail not in parts]
    return tuple(sorted(people, key=lambda person: -person[1]))


def _trails(measures: _Measures, times: Array) -> list[_Trail]:
    """Link the people of all frames."""
    finished: list[_Trail] = []
    current: list[_Trail] = []
    for t, now in enumerate(times.tolist()):
        people = np.flatnonzero(measures.present[t]).tolist()
        finished += [trail for trail in current if now - trail.seen_at > _LONGEST_GAP]
        current = [trail for trail in current if now - trail.seen_at <= _LONGEST_GAP]
        _link(current, measures, t, people, now)
    return finished + current


def _link(trails: list[_Trail], measures: _Measures, t: int, people: list[int], now: float) -> None:
    """Assign the people of a frame to trails with the least total distance; the others begin trails of their own."""
    if len(trails) == len(people) == 1 and np.isfinite(trails[0].distance(measures, t, people[0], now)):
        trails[0].extend(measures, t, people[0], now)
        return
    far = np.reshape(
        [trail.distance(measures, t, p, now) for trail in trails for p in people], (len(trails), len(people))
    )
    rows, columns = scipy.optimize.linear_sum_assignment(np.where(np.isfinite(far), far, 1e6))
    new = dict.fromkeys(people)
    for row, column in zip(rows, columns, strict=True):
        if not np.isfinite(far[row, column]):
            continue
        others = np.concatenate([np.delete(far[row], column), np.delete(far[:, column], row)])
        if np.any(others < _AMBIGUOUS * max(far[row, column], 0.05)):
            trails[row].unsure.append(t)
        trails[row].extend(measures, t, people[column], now)
        del new[people[column]]
    for person in new:
        trails.append(_Trail())
        trails[-1].extend(measures, t, person, now)


def _prominence(trail: _Trail, measures: _Measures, image_px: tuple[float, float] | None) -> float:
    """Return the sum over frames of size times confidence, less off the centre."""
    at = (np.array(trail.frames), np.array(trail.people))
    if image_px is not None:
        middle, width = image_px[0] / 2, image_px[0]
    else:
        u = measures.centre[measures.present][:, 0]
        middle, width = float(np.median(u)), float(np.ptp(u)) + 1.0
    off = np.abs(measures.centre[at][:, 0] - middle) / max(width / 2, 1.0)
    return float((measures.size[at] * measures.confidence[at] / (1 + off)).sum())


def _continued(chosen: _Trail, trails: list[_Trail], measures: _Measures, times: Array) -> list[_Trail]:
    """Return the chosen trail and its likeliest continuations after and before it, no mere flashes."""
    parts = [chosen]
    least = _BRIEFEST / max(float(np.median(np.diff(times))), 1e-6) if len(times) > 1 else 0
    trails = [trail for trail in trails if len(trail.frames) > least]
    for forward in (True, False):
        edge = chosen
        while costs := {i: _cost(edge, t, forward, measures, times) for i, t in enumerate(trails)}:
            best = min(costs, key=lambda i: costs[i])
            if not np.isfinite(costs[best]):
                break
            edge = trails[best]
            parts.append(edge)
    return parts


def _track(parts: list[_Trail], people: int, times: Array, reason: str) -> PersonTrack:
    """Return the track of one person from trails, the chosen one first."""
    person = np.full(len(times), NOBODY, dtype=np.int64)
    ambiguous = np.zeros(len(times), dtype=np.bool_)
    for part in parts:
        person[part.frames] = part.people
        ambiguous[part.unsure] = True
        if part is not parts[0]:
            ambiguous[part.frames[0]] = True
    return PersonTrack(person, ambiguous, people, reason)


def _cost(edge: _Trail, other: _Trail, forward: bool, measures: _Measures, times: Array) -> float:
    """Return gap [s] plus distance [sizes] to a later (or earlier) trail; inf if of another person."""
    i, j = (-1, 0) if forward else (0, -1)
    end, start = (edge.frames[i], edge.people[i]), (other.frames[j], other.people[j])
    later = start[0] > end[0] if forward else start[0] < end[0]
    other_identity = NO_IDENTITY not in (edge.identity, other.identity) and edge.identity != other.identity
    if not later or other_identity:
        return np.inf
    if not 1 / _RESIZED < measures.size[start] / measures.size[end] < _RESIZED:
        return np.inf
    way = np.linalg.norm(measures.centre[start] - measures.centre[end])
    return float(abs(times[start[0]] - times[end[0]]) + way / measures.size[end])


class PersonFollower:
    """Follows one person frame by frame, without those to come.

    The largest and most central person is chosen, and kept until nobody like that was seen for a second.
    """

    def __init__(self, image_px: tuple[float, float]):
        self._image_px = image_px
        self._trails: list[_Trail] = []
        self._chosen: _Trail | None = None
        self.chosen = 0  #: How often a person was chosen
        self.ambiguous = 0  #: Number of frames in which another person fitted nearly as well

    def follow(self, people: Sequence[Person], time: float) -> int | None:
        """Return the index of the person among those of the next frame, at a later time, s; None where not seen."""
        self._trails = [trail for trail in self._trails if time - trail.seen_at <= _LONGEST_GAP]
        if self._chosen not in self._trails:
            self._chosen = None
        if not people:
            return None
        measures = _Measures(Detections.of_frames({0: people}))
        measures.identified = False  # those of later frames may not be
        _link(self._trails, measures, 0, np.flatnonzero(measures.present[0]).tolist(), time)
        now = [trail for trail in self._trails if trail.seen_at == time]
        for trail in now:
            trail.forget()
        if self._chosen is None and now:
            self._chosen = max(now, key=lambda trail: _prominence(trail, measures, self._image_px))
            self.chosen += 1
        if self._chosen is None or self._chosen not in now:
            return None
        self.ambiguous += bool(self._chosen.unsure)
        self._chosen.unsure.clear()
        return self._chosen.people[0]
