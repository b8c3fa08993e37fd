"""Faults of a video and of its detections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.accuracy.windows import MIDDLE_HALF_SECOND, MIDDLE_SECOND, SECOND_AFTER_HALF, bounds, inside
from rtof_kin.recording.recording import Recording

LEFT_LEG = ("LeftUpLeg", "LeftLeg", "LeftFoot")
LEFT_LIMBS = ("LeftArm", "LeftForeArm", "LeftHand", *LEFT_LEG)
LEGS = (*LEFT_LEG, *(name.replace("Left", "Right") for name in LEFT_LEG))
LIMBS = (*LEFT_LIMBS, *(name.replace("Left", "Right") for name in LEFT_LIMBS))


def _with_keypoints(recording: Recording, **changes: Any) -> Recording:
    return replace(recording, keypoints=replace(recording.video, **changes))


def with_outliers(recording: Recording, rng: Generator) -> Recording:
    """A tenth of all landmarks, drawn one by one, displaced by 80 px in any direction."""
    keypoints = recording.video
    hit = rng.random(keypoints.confidence.shape) < 0.1
    angle = rng.uniform(0, 2 * np.pi, hit.shape)
    shift = 80.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) * hit[..., None]
    return _with_keypoints(recording, uv_px=keypoints.uv_px + shift)


def with_unseen(recording: Recording, rng: Generator, names: Sequence[str] | None = None) -> Recording:
    """Some landmarks, or the whole person, unseen for the middle second."""
    keypoints = recording.video
    hidden = np.isin(keypoints.names, keypoints.names if names is None else names)
    hidden = inside(keypoints.times, keypoints.times, MIDDLE_SECOND)[:, None] & hidden
    return _with_keypoints(
        recording,
        uv_px=np.where(hidden[..., None], np.nan, keypoints.uv_px),
        confidence=np.where(hidden, 0.0, keypoints.confidence),
    )


def with_sides_exchanged(recording: Recording, rng: Generator, left: Sequence[str] | None = None) -> Recording:
    """The landmarks of the left side, or some of them, exchanged with the right's for half a second."""
    keypoints = recording.video
    source = list(range(len(keypoints.names)))
    for i, name in enumerate(keypoints.names):
        if name.startswith("Left") and (left is None or name in left):
            j = keypoints.names.index(name.replace("Left", "Right", 1))
            source[i], source[j] = j, i
    during = inside(keypoints.times, keypoints.times, MIDDLE_HALF_SECOND)
    uv, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
    uv[during], confidence[during] = uv[during][:, source], confidence[during][:, source]
    return _with_keypoints(recording, uv_px=uv, confidence=confidence)


def with_somebody_else(recording: Recording, rng: Generator) -> Recording:
    """Somebody else's landmarks for half a second: another posture of the motion, three quarters as
    large, a body's height to the side."""
    keypoints = recording.video
    during = np.flatnonzero(inside(keypoints.times, keypoints.times, MIDDLE_HALF_SECOND))
    other = (during + len(keypoints) // 2) % len(keypoints)
    uv, root = keypoints.uv_px.copy(), keypoints.names.index("Hips")
    height = float(np.nanmedian(np.ptp(uv[:, :, 1], axis=1)))
    side = np.array([rng.choice([-1.0, 1.0]) * height, 0.0])
    theirs = uv[other] - uv[other, root][:, None]
    uv[during] = uv[during, root][:, None] + side + 0.75 * theirs
    return _with_keypoints(recording, uv_px=uv)


def with_lost_frames(recording: Recording, rng: Generator) -> Recording:
    """The frames of the middle half second missing, the others stamped rightly but for 1 ms of jitter."""
    keypoints = recording.video
    kept = ~inside(keypoints.times, keypoints.times, MIDDLE_HALF_SECOND)
    times = keypoints.times + 1e-3 * rng.standard_normal(len(keypoints)).clip(-2, 2)
    times[[0, -1]] = keypoints.times[[0, -1]]
    return _with_keypoints(
        recording, times=times[kept], uv_px=keypoints.uv_px[kept], confidence=keypoints.confidence[kept]
    )


def with_late_video(recording: Recording, rng: Generator, delay: float) -> Recording:
    """A video that shows what was `delay` s before its time stamps, in whole frames.

    Truth and sensors keep their clock; frames that would show what was before the start are left out.
    """
    keypoints = recording.video
    late = round(delay / float(np.median(np.diff(keypoints.times))))
    shown = keypoints[: len(keypoints) - late]
    return replace(recording, keypoints=replace(shown, times=keypoints.times[late:]))


def with_jumping_clock(recording: Recording, rng: Generator) -> Recording:
    """Time stamps that jump ahead by 0.1 s halfway and stay: from there on the video is late."""
    keypoints = recording.video
    halfway, _ = bounds(keypoints.times, SECOND_AFTER_HALF)
    times = keypoints.times + np.where(keypoints.times >= halfway, 0.1, 0.0)
    kept = slice(0, int(np.searchsorted(times, keypoints.times[-1] + 1e-9)))
    return replace(recording, keypoints=replace(keypoints[kept], times=times[kept]))
