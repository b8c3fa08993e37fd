"""Recordings as streams: the samples that have arrived at each tick, with what goes wrong on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.live.replay import Faults, RecordingReplay
from rtof_kin.live.replay_clock import ReplayClock
from rtof_kin.live.samples import Sample
from rtof_kin.recording.recording import Recording

Interval = tuple[float, float]
"""Begin and end, s."""
NO_FAULTS = Faults()
_KNOWN = 1.0
"""[s] of the streams that a setup keeps; a recording cannot be without any."""
_TOGETHER = 1e-6
"""[s] by which a sample may be newer than a tick."""


def setup_of(recording: Recording) -> Recording:
    """What an estimator may know before: a recording without its truth and but a second of its streams."""
    video, imus = recording.video, recording.imus
    until = video.times[0] + _KNOWN
    if imus is not None:
        count = int(np.searchsorted(imus.times, until))
        R, f = imus.R_inertial_sensor[:count], imus.f_sensor[:count]
        imus = replace(imus, times=imus.times[:count], R_inertial_sensor=R, f_sensor=f)
    first = video[: int(np.searchsorted(video.times, until))]
    return replace(recording, keypoints=first, imus=imus, truth=None)


def replayed(
    recording: Recording, faults: Faults = NO_FAULTS
) -> tuple[RecordingReplay, Callable[[float], None]]:
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
