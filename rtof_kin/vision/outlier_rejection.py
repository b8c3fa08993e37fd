"""Correction of keypoints with left and right exchanged, and rejection of another person's keypoints.

Both are found from the continuity of the points: at the beginning of an exchange the points are far from their
prediction, and near it with sides exchanged; another person's points are far away. An interval is corrected only if
its end is found too, since one end does not determine which side of it was right, and soon: the end of one exchange
and the beginning of the next, with the other ends missed, look alike. Of what is corrected on simulated detections, 80
of 84 intervals came nearer to those without exchanges (`tests/vision`); 63 % of the exchanges are found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import KeypointSequence, layout_and_point

_LONGEST_EXCHANGE = 0.5  # [s] that is corrected, ten times the usual length; longer ones are only reported
_LONGEST_ABSENCE = 2.0  # [s] of another person's points that are left out
_PAST, _FRAMES_OF_PAST, _FEWEST_FRAMES = 0.15, 5, 3  # [s] and frames of a prediction
_APART, _NEARER = 0.08, 0.35  # [sizes] least error of a point, and its ratio with sides exchanged
_REACH, _REACH_RATE = 0.25, 5.0  # [sizes] largest step, and its growth per s
_FEWEST, _FEWEST_PAIRS = 4, 2  # points that identify a person, pairs that show an exchange
_LONGEST_BLINK = 0.75  # [s] without a person from which that is a fault
_LOWER = ("Leg", "Foot", "Toe", "Heel", "Hip", "Knee")


def reject_keypoint_outliers(
    keypoints: KeypointSequence, *, sides: bool = True, person: bool = True
) -> tuple[KeypointSequence, tuple[StreamFault, ...]]:
    """Exchange swapped sides back and set another person's keypoints to NaN; return the keypoints, unchanged without
    faults, and the faults. The landmarks decide; the detector's own points are treated as they are. Names of sides
    begin with ``Left`` and ``Right``, or ``L`` and ``R``.
    """
    found: list[StreamFault] = []
    landmarks, every = side_pairs(keypoints.landmarks.names), side_pairs(keypoints.names)
    for group, pairs in landmarks.items() if sides else ():
        uv, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
        columns, other = every[group].ravel(), every[group][:, ::-1].ravel()
        exchanges = list(_exchanged(keypoints.landmarks, pairs))
        for first, last, closed in exchanges:
            kind = FaultKind.SIDES if closed else FaultKind.SIDES_IN_DOUBT
            times = float(keypoints.times[first]), float(keypoints.times[last])
            found.append(StreamFault(kind, f"keypoints of {group}", *times))
            if closed:
                span = slice(first, last + 1)
                uv[span, columns], confidence[span, columns] = uv[span, other], confidence[span, other]
        if any(closed for _, _, closed in exchanges):
            keypoints = replace(keypoints, uv_px=uv, confidence=confidence)
    if person:
        keypoints, faults = _without_other_people(keypoints)
        found += faults
    return keypoints, tuple(sorted(found, key=lambda fault: fault.start))


def gaps(keypoints: KeypointSequence) -> Iterator[StreamFault]:
    """Yield intervals in which nobody is seen, within the video. keypoints: T frames, not necessarily evenly spaced."""
    seen = keypoints.times[keypoints.seen.sum(axis=1) >= _FEWEST]
    edges = np.array([keypoints.times[0], *seen, keypoints.times[-1]])
    for i in np.flatnonzero(np.diff(edges) > _LONGEST_BLINK):
        yield StreamFault(FaultKind.UNSEEN, "the person", float(edges[i]), float(edges[i + 1]))


def side_pairs(names: tuple[str, ...]) -> dict[str, Index]:
    """Return the columns (n, 2) of left and right points of the legs, and of arms and head."""
    groups: dict[str, list[tuple[int, int]]] = {"legs": [], "arms and head": []}
    apart = [layout_and_point(name) for name in names]
    for i, (layout, name) in enumerate(apart):
        for left, right in (("Left", "Right"), ("L", "R")):
            other = layout, right + name.removeprefix(left)
            if name.startswith(left) and other in apart:
                group = "legs" if any(part in name for part in _LOWER) else "arms and head"
                groups[group].append((i, apart.index(other)))
                break
    return {group: np.array(pairs) for group, pairs in groups.items() if len(pairs) >= _FEWEST_PAIRS}


def _on_lines(since: Array, past: Array) -> Array:
    """Points (..., n, 2, 2) by linear regression over past ones (F, ..., n, 2, 2), at times `since` (F, ...)
    later, which are negative; NaN where there are too few.
    """
    known = np.isfinite(past).all(axis=-1, keepdims=True)
    past, count, t = np.where(known, past, 0.0), known.sum(axis=0), since[..., None, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = (t * known).sum(axis=0) / count
        off = (t - middle) * known
        slope = (off * past).sum(axis=0) / (off**2).sum(axis=0)
        line = past.sum(axis=0) / count - slope * middle
    return np.where(count < _FEWEST_FRAMES, np.nan, line)


def _exchanged(keypoints: KeypointSequence, pairs: Index) -> Iterator[tuple[int, int, bool]]:
    """Generate first and last frame of each interval with sides exchanged, and whether its end was found."""
    sides, size = keypoints.uv_px[:, pairs], _size(keypoints)
    whole = np.isfinite(sides).all(axis=(2, 3)).sum(axis=1)
    frames = np.flatnonzero(whole >= _FEWEST_PAIRS)
    number, times, sides = frames.tolist(), keypoints.times[frames], sides[frames]
    sudden = _crossed(sides, _expected(times, sides, np.arange(len(frames)), 0), size)
    first, begin, straight = None, 0, 0  # of an exchange; of the frames that predict; after the last exchange
    for k, now in enumerate(times.tolist()):
        if first is not None and (now - times[first] > _LONGEST_EXCHANGE or now - times[k - 1] > _PAST):
            yield number[first], number[k - 1], False
            first, begin, straight = None, k, k
        if first is not None:
            sides[k] = sides[k][:, ::-1]
        at, crossed = np.array([k]), sudden[k]
        if first is not None or k - straight < _FRAMES_OF_PAST:
            crossed = _crossed(sides[at], _expected(times, sides, at, begin), size)[0]
        if crossed:
            sides[k] = sides[k][:, ::-1]
            if first is None:
                first = k
            else:
                yield number[first], number[k - 1], True
                first, straight = None, k
    if first is not None:
        yield number[first], number[-1], False


def _expected(times: Array, sides: Array, at: Index, begin: int) -> Array:
    """Return the points of frames `at` (m,) by linear regression over the frames before, from number `begin` on; NaN
    for those with too few positions. times: (K,). sides: (K, n, 2, 2).
    """
    before = at - np.arange(_FRAMES_OF_PAST, 0, -1)[:, None]
    there, newest, past = before >= begin, np.maximum(before[-1], 0), np.maximum(before, 0)
    there &= (times[newest] - times[past] <= _PAST) & (times[at] - times[newest] <= _PAST)
    return _on_lines(times[past] - times[at], np.where(there[..., None, None, None], sides[past], np.nan))


def _crossed(now: Array, expected: Array, size: float) -> Mask:
    """Return whether half of the pairs (..., n, 2, 2), NaN if missing, are nearer to their prediction if they
    are exchanged.
    """
    off = np.linalg.norm(now - expected, axis=-1).mean(axis=-1) / size
    off_crossed = np.linalg.norm(now[..., ::-1, :] - expected, axis=-1).mean(axis=-1) / size
    for_it = np.sum((off > _APART) & (off_crossed < _NEARER * off), axis=-1)
    against = np.sum((off_crossed > _APART) & (off < _NEARER * off_crossed), axis=-1)
    enough = np.maximum(_FEWEST_PAIRS, (np.isfinite(off).sum(axis=-1) + 1) // 2)
    return np.asarray((for_it >= enough) & (for_it > 2 * against))


def _without_other_people(keypoints: KeypointSequence) -> tuple[KeypointSequence, list[StreamFault]]:
    landmarks = keypoints.landmarks
    times, frames = keypoints.times, np.flatnonzero(landmarks.seen.sum(axis=1) >= _FEWEST)
    size = _size(landmarks)
    jumps = [ab for ab in pairwise(frames.tolist()) if _step(landmarks, *ab, size) > 1.0]
    faults, gone = [], np.zeros(len(times), dtype=bool)
    for i, (before, first) in enumerate(jumps):
        if gone[before]:
            continue
        returns = (
            last
            for last, after in jumps[i + 1 :]
            if times[after] - times[first] <= _LONGEST_ABSENCE and _step(landmarks, before, after, size) < 1.0
        )
        back = next(returns, None)
        if back is not None:
            gone[first : back + 1] = True
        kind = FaultKind.JUMP if back is None else FaultKind.SOMEBODY_ELSE
        stop = first if back is None else back
        faults.append(StreamFault(kind, "keypoints", float(times[first]), float(times[stop])))
    if gone.any():
        keypoints = replace(keypoints, uv_px=np.where(gone[:, None, None], np.nan, keypoints.uv_px))
    return keypoints, faults


def _step(keypoints: KeypointSequence, a: int, b: int, size: float) -> float:
    """Return the median distance of the points of two frames relative to the largest possible one."""
    off = np.linalg.norm(keypoints.uv_px[b] - keypoints.uv_px[a], axis=-1)
    both = np.isfinite(off)
    if both.sum() < _FEWEST:
        return 0.0
    reach = _REACH + _REACH_RATE * abs(float(keypoints.times[b] - keypoints.times[a]))
    return float(np.median(off[both])) / size / reach


def _size(keypoints: KeypointSequence) -> float:
    """Return the median of twice the RMS radius of the points, px: half a standing person's height."""
    uv = keypoints.uv_px[keypoints.seen.sum(axis=1) >= _FEWEST]
    if len(uv) == 0:
        return 1.0
    centre = np.nanmean(uv, axis=1, keepdims=True)
    radius = np.sqrt(np.nanmean(((uv - centre) ** 2).sum(axis=-1), axis=1))
    return max(2 * float(np.median(radius)), 1.0)
