"""Recordings as streams: the samples that have arrived at each tick, with what goes wrong on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.live.replay import Faults, RecordingReplay, ReplayClock
from rtof_kin.live.samples import Sample
from rtof_kin.recording.recording import Recording

Interval = tuple[float, float]
"""Begin and end, s."""
NO_FAULTS = Faults()
_KNOWN = 1.0
"""[s] of the video that a setup keeps; a recording cannot be without any stream."""
_TOGETHER = 1e-6
"""[s] by which a sample may be newer than a tick."""


def setup_of(recording: Recording) -> Recording:
    """What an estimator may know before: neither truth nor samples, but a second of video."""
    video = recording.video
    first = video[: int(np.searchsorted(video.times, video.times[0] + _KNOWN))]
    return replace(recording, keypoints=first, imus=None, truth=None)


def replayed(recording: Recording, faults: Faults = NO_FAULTS) -> tuple[RecordingReplay, Callable[[float], None]]:
    """A replay whose time passes by hand, and what sets it, s of the recording."""
    streams = [stream for stream in (recording.keypoints, recording.imus) if stream is not None]
    first, passed = min(float(stream.times[0]) for stream in streams), 0.0

    def now() -> float:
        return passed

    def reach(time: float) -> None:
        nonlocal passed
        passed = max(time - first + _TOGETHER, 0.0)

    clock = ReplayClock(now=now)
    replay = RecordingReplay.of_recording(recording, clock, faults=faults)
    clock.now(replay)
    return replay, reach


def portions(
    recording: Recording, ticks: Sequence[float] | Array, faults: Faults = NO_FAULTS
) -> Iterator[tuple[float, list[Sample]]]:
    """Each tick, s, with the samples that have arrived since the one before.

    Args:
        recording: with a video, sensors or both. ticks: rising. faults: on the way.
    """
    replay, reach = replayed(recording, faults)
    replay.start()
    for tick in ticks:
        reach(float(tick))
        yield float(tick), replay.poll()


def frozen(recording: Recording, intervals: Sequence[Interval]) -> Recording:
    """The recording of a camera that freezes: in each interval all frames show its first one."""
    video = recording.video
    shown = np.arange(len(video))
    for start, stop in intervals:
        inside = (video.times >= start) & (video.times < stop)
        shown[inside] = np.flatnonzero(inside)[:1]
    uv, sure = video.uv_px[shown], video.confidence[shown]
    return replace(recording, keypoints=replace(video, uv_px=uv, confidence=sure))
