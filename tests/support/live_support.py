"""Scripted live sources, a sink and an estimator without mathematics."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import SourceError
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, OnlineEstimate, Sample
from rtof_kin.live.session import LiveSession
from rtof_kin.recording.recording import Recording


@cache
def demo() -> Recording:
    """A recording of eight sensors and one camera, 24 s at 60 Hz."""
    return Recording.load(model_path("demo"))


def imu_samples(seconds: float, recording: Recording | None = None) -> list[Sample]:
    """The first samples of all sensors, in the order of time."""
    imus = (recording or demo()).imus
    assert imus is not None
    return [
        ImuSample(name, float(t), imus.R_inertial_sensor[i, s], imus.f_sensor[i, s])
        for i, t in enumerate(imus.times)
        for s, name in enumerate(imus.names)
        if t < seconds
    ]


def frame_samples(seconds: float, recording: Recording | None = None) -> list[Sample]:
    """The first frames of the video."""
    video = (recording or demo()).video
    return [
        FrameSample(float(t), video.uv_px[i], video.confidence[i]) for i, t in enumerate(video.times) if t < seconds
    ]


def name_of(sample: Sample) -> str:
    """Name of the sensor, or of the video."""
    return VIDEO if isinstance(sample, FrameSample) else sample.sensor


class FakeSource:
    """Gives samples at scripted arrivals; `now` is set by `drive`."""

    def __init__(
        self,
        name: str,
        arrivals: Iterable[tuple[float, Sample]],
        clock: Clock = Clock.COMMON,
        landmarks: Sequence[str] = (),
    ):
        self.name, self.clock, self.landmarks = name, clock, tuple(landmarks)
        self._waiting = deque(sorted(arrivals, key=lambda pair: pair[0]))
        self.sensors = tuple(dict.fromkeys(name_of(s) for _, s in self._waiting if isinstance(s, ImuSample)))
        self.now = 0.0
        self.starts, self.closes = 0, 0
        self.failures: list[Exception] = []  # raised by the next polls
        self.refusals: list[Exception] = []  # raised by the next starts
        self.silent = False

    @property
    def finished(self) -> bool:
        return not self._waiting and not self.silent

    def start(self) -> None:
        self.starts += 1
        if self.refusals:
            raise self.refusals.pop(0)

    def poll(self) -> list[Sample]:
        if self.failures:
            raise self.failures.pop(0)
        arrived = []
        while self._waiting and self._waiting[0][0] <= self.now:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    def notices(self) -> list[str]:
        return []

    def close(self) -> None:
        self.closes += 1


class FakeEstimator:
    """Returns the first pose of the demo at 60 Hz, for the frames up to the time asked for."""

    def __init__(self) -> None:
        self.pushed: list[Sample] = []
        self.dropped: Mapping[str, int] = {}
        self.hurried = 0
        self.times: list[float] = []
        truth = demo().truth
        assert truth is not None
        self._pose = truth[:1]
        self._next: float | None = None

    def push(self, sample: Sample) -> None:
        self.pushed.append(sample)

    def advance(self, time: float | None = None, *, hurry: bool = False) -> list[OnlineEstimate]:
        assert time is not None
        if self._next is None:
            self._next = time
        out = []
        while self._next <= time + 1e-9:
            out.append(self._estimate(self._next))
            self._next += 1 / 60
        return out

    def finish(self) -> list[OnlineEstimate]:
        return []

    def _estimate(self, time: float) -> OnlineEstimate:
        self.times.append(time)
        poses: PoseSequence = replace(self._pose, times=np.array([time]))
        return OnlineEstimate(poses, 0.0, 1e-4)


class FakeSink:
    """Keeps what it is given; raises `failure` where there is one."""

    def __init__(self) -> None:
        self.estimates: list[OnlineEstimate] = []
        self.told: list[str] = []
        self.closes = 0
        self.failure: Exception | None = None

    def send(self, estimate: OnlineEstimate) -> None:
        if self.failure is not None:
            raise self.failure
        self.estimates.append(estimate)

    def tell(self, sentence: str) -> None:
        self.told.append(sentence)

    def close(self) -> None:
        self.closes += 1


@dataclass(frozen=True)
class Told:
    """A sentence, and when it was told."""

    time: float
    sentence: str


def drive(
    session: LiveSession, sources: Sequence[FakeSource], stop: float, start: float = 0.0, step: float = 1 / 60
) -> list[Told]:
    """Step through a session without waiting; return what is told and when, s of arrivals."""
    told: list[Told] = []
    for now in np.arange(start, stop, step):
        for source in sources:
            source.now = float(now)
        before = len(session.sentences)
        session.step(float(now))
        told += [Told(float(now), text) for text in session.sentences[before:]]
    return told


def first(told: Sequence[Told], *words: str) -> float:
    """When a sentence with all of these words was told first; infinite where it never was."""
    return min((t.time for t in told if all(word in t.sentence for word in words)), default=float("inf"))


def count(told: Sequence[Told], *words: str) -> int:
    """How many sentences have all of these words."""
    return sum(all(word in t.sentence for word in words) for t in told)


def shaken(samples: Iterable[Sample], jitter: float, loss: float, seed: int) -> list[tuple[float, Sample]]:
    """Arrivals late by up to `jitter`, s, of which a share is lost."""
    rng = np.random.default_rng(seed)
    kept = [sample for sample in samples if rng.random() >= loss]
    delays: NDArray[np.float64] = rng.uniform(0, jitter, len(kept)) if jitter else np.zeros(len(kept))
    return [(sample.time + float(delay), sample) for sample, delay in zip(kept, delays, strict=True)]


UNPLUGGED = SourceError("unplugged")
