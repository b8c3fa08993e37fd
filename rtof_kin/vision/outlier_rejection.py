"""Keypoints that exchange left and right, or jump to somebody else: found by how points go on.

A detector that takes a person's left for the right does so from one frame to the next and for a while;
so does one that takes another person. Both are seen at their beginning and at their end: points are
not where they were expected, and with the sides exchanged they are; or they are far away, and back later.
Only what is seen at both ends is mended: an end alone does not say which of the two was right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.stream_faults import FaultKind, StreamFault

Array = NDArray[np.float64]
LONGEST = 2.0
"""s for which sides or people may be exchanged; what is longer is in doubt."""
_PAST, _FRAMES_OF_PAST, _FEWEST_FRAMES = 0.15, 5, 3
"""s and frames before one from which it is expected where points will be, and in how many of them a point
must have been seen for that."""
_APART, _NEARER = 0.08, 0.5
"""In a person's size: the least by which a point must be off; and to what share of that an exchange of
sides must bring it."""
_REACH, _REACH_RATE = 0.25, 5.0
"""In a person's size: how far a person may come from one frame to the next, and how that grows per s."""
_FEWEST = 4
"""Points that tell who somebody is."""
_FEWEST_PAIRS = 2
"""Pairs of points that tell whether sides are exchanged."""
_LOWER = ("Leg", "Foot", "Toe", "Heel", "Hip", "Knee")


def reject_keypoint_outliers(keypoints: KeypointSequence) -> tuple[KeypointSequence, tuple[StreamFault, ...]]:
    """Keypoints with sides exchanged back and without somebody else's, and what was found.

    What nothing is wrong with comes back as it is.

    Args:
        keypoints: at any times; sides by their names, ``Left`` and ``Right`` or ``L`` and ``R`` in front.
    """
    found: list[StreamFault] = []
    for group, pairs in side_pairs(keypoints.names).items():
        keypoints, faults = _with_sides_mended(keypoints, group, pairs)
        found += faults
    keypoints, faults = _without_somebody_else(keypoints)
    return keypoints, tuple(sorted([*found, *faults], key=lambda fault: fault.start))


# --- sides ---------------------------------------------------------------------------------------


def side_pairs(names: tuple[str, ...]) -> dict[str, NDArray[np.intp]]:
    """Columns (n, 2) of left and right points of the legs, and of the rest."""
    groups: dict[str, list[tuple[int, int]]] = {"legs": [], "arms and head": []}
    for i, name in enumerate(names):
        for left, right in (("Left", "Right"), ("L", "R")):
            other = right + name.removeprefix(left)
            if name.startswith(left) and other in names:
                group = "legs" if any(part in name for part in _LOWER) else "arms and head"
                groups[group].append((i, names.index(other)))
                break
    return {group: np.array(pairs) for group, pairs in groups.items() if len(pairs) >= _FEWEST_PAIRS}


@dataclass
class _Past:
    """Where points were in the last frames in which they were seen."""

    times: list[float] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)

    def add(self, time: float, points: Array) -> None:
        keep = [i for i, t in enumerate(self.times) if time - t <= _PAST][1 - _FRAMES_OF_PAST :]
        self.times = [*(self.times[i] for i in keep), time]
        self.points = [*(self.points[i] for i in keep), points]

    def expected(self, time: float) -> Array | None:
        """The points at a time by straight lines through the past, NaN of those that were seldom seen;
        None where there is too little of it.
        """
        if len(self.times) < _FEWEST_FRAMES or time - self.times[-1] > _PAST:
            return None
        past = np.stack(self.points)
        known = np.isfinite(past).all(axis=-1, keepdims=True)
        past, count = np.where(known, past, 0.0), known.sum(axis=0)
        t = np.reshape(np.array(self.times) - time, (-1, 1, 1, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = (t * known).sum(axis=0) / count
            off = (t - middle) * known
            slope = (off * past).sum(axis=0) / (off**2).sum(axis=0)
            line = past.sum(axis=0) / count - slope * middle
        return np.where(count < _FEWEST_FRAMES, np.nan, line)


def _with_sides_mended(
    keypoints: KeypointSequence, group: str, pairs: NDArray[np.intp]
) -> tuple[KeypointSequence, list[StreamFault]]:
    times = keypoints.times
    spans, faults = [], []
    for first, last, closed in _exchanged(keypoints, pairs):
        kind = FaultKind.SIDES if closed else FaultKind.SIDES_IN_DOUBT
        faults.append(StreamFault(kind, f"keypoints of {group}", float(times[first]), float(times[last])))
        spans += [slice(first, last + 1)] if closed else []
    if not spans:
        return keypoints, faults
    uv, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
    columns, other = pairs.ravel(), pairs[:, ::-1].ravel()
    for span in spans:
        uv[span, columns], confidence[span, columns] = uv[span, other], confidence[span, other]
    return replace(keypoints, uv_px=uv, confidence=confidence), faults


def _exchanged(keypoints: KeypointSequence, pairs: NDArray[np.intp]) -> Iterator[tuple[int, int, bool]]:
    """First and last frame of each stretch with sides exchanged, and whether its end was seen too."""
    sides, size = keypoints.uv_px[:, pairs], _size(keypoints)
    past, prepared, last = _Past(), None, 0
    whole = np.isfinite(sides).all(axis=(2, 3)).sum(axis=1)
    for t in np.flatnonzero(whole >= _FEWEST_PAIRS):
        time = keypoints.times[t]
        if prepared is not None and (
            time - keypoints.times[prepared] > LONGEST or time - keypoints.times[last] > _PAST
        ):
            yield prepared, last, False
            prepared, past = None, _Past()
        now = sides[t] if prepared is None else sides[t][:, ::-1]
        if _crossed(now, past.expected(time), size):
            now = now[:, ::-1]
            if prepared is None:
                prepared = int(t)
            else:
                yield prepared, last, True
                prepared = None
        past.add(time, now)
        last = int(t)
    if prepared is not None:
        yield prepared, last, False


def _crossed(now: Array, expected: Array | None, size: float) -> bool:
    """Whether pairs of points (n, 2, 2) are where their other sides were expected; those that were not
    seen, NaN, have no say.
    """
    if expected is None:
        return False
    off = np.linalg.norm(now - expected, axis=-1).mean(axis=1) / size
    off_crossed = np.linalg.norm(now[:, ::-1] - expected, axis=-1).mean(axis=1) / size
    for_it = (off > _APART) & (off_crossed < _NEARER * off)
    against = (off_crossed > _APART) & (off < _NEARER * off_crossed)
    return bool(for_it.sum() >= _FEWEST_PAIRS and for_it.sum() > 2 * against.sum())


# --- people --------------------------------------------------------------------------------------


def _without_somebody_else(keypoints: KeypointSequence) -> tuple[KeypointSequence, list[StreamFault]]:
    times, frames = keypoints.times, np.flatnonzero(keypoints.seen.sum(axis=1) >= _FEWEST)
    size = _size(keypoints)
    jumps = [ab for ab in pairwise(frames.tolist()) if _step(keypoints, *ab, size) > 1.0]
    faults, gone = [], np.zeros(len(times), dtype=bool)
    for i, (before, first) in enumerate(jumps):
        if gone[before]:
            continue
        back = next(
            (
                last for last, after in jumps[i + 1 :]
                if times[after] - times[first] <= LONGEST
                and _step(keypoints, before, after, size) < 1.0
            ), None,
        )  # fmt: skip
        stop = first if back is None else back
        kind = FaultKind.JUMP if back is None else FaultKind.SOMEBODY_ELSE
        faults.append(StreamFault(kind, "keypoints", float(times[first]), float(times[stop])))
        if back is not None:
            gone[first : back + 1] = True
    if not gone.any():
        return keypoints, faults
    uv = np.where(gone[:, None, None], np.nan, keypoints.uv_px)
    return replace(keypoints, uv_px=uv), faults


def _step(keypoints: KeypointSequence, a: int, b: int, size: float) -> float:
    """How far the points of two frames are apart, as a share of the furthest that a person comes."""
    off = np.linalg.norm(keypoints.uv_px[b] - keypoints.uv_px[a], axis=-1)
    both = np.isfinite(off)
    if both.sum() < _FEWEST:
        return 0.0
    reach = _REACH + _REACH_RATE * abs(float(keypoints.times[b] - keypoints.times[a]))
    return float(np.median(off[both])) / size / reach


def _size(keypoints: KeypointSequence) -> float:
    """The person's size in px: twice the RMS radius of the points in a usual frame, half as tall as
    somebody who stands; 1 where nobody is seen.
    """
    uv = keypoints.uv_px[keypoints.seen.sum(axis=1) >= _FEWEST]
    if len(uv) == 0:
        return 1.0
    centre = np.nanmean(uv, axis=1, keepdims=True)
    radius = np.sqrt(np.nanmean(((uv - centre) ** 2).sum(axis=-1), axis=1))
    return max(2 * float(np.median(radius)), 1.0)
