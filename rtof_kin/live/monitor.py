"""`Monitor`: what each sensor and the camera are doing now, and every change of it as a sentence.

Times are of the session's clock. Its present is the newest time of any stream; where nothing comes at all,
it goes on with the clock of the arrivals.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Any, Final

import numpy as np

from rtof_kin.live.clock_map import VIDEO, Arrived
from rtof_kin.live.samples import FrameSample, OnlineEstimate

_SPAN: Final = 1.0  # [s] that is judged
_OUT_OF_ORDER: Final = 0.1  # [s] for which a missing sample may still come
_FEWEST, _SHORTEST = 8, 0.4  # samples, [s]
_EVEN, _MOSTLY_EVEN = 0.25, 0.8  # [periods] deviation of a step from whole ones; share of such steps
_HALVES = 0.1  # [-] share of steps of a part of the median that make this part the period
_CLEARLY, _ADAPTING = 0.75, 0.05  # [-] of the usual rate of a stream without a period; followed each time
_MOST: Final = 1024
_EVERY, _TURNS = 0.1, 3  # [s] between checks; of so many the last one renews the figures of the streams
_SILENT, _PERIODS = 0.5, 5.0  # [s] without a sample, or as many periods of a slow stream
_SAME, _SAME_ORIENTATION = 0.3, 2.0  # [s] of identical numbers; of orientations alone, which may be rounded
_NOBODY = 0.75  # [s]
_LOSS, _MISSING, _TOGETHER = 0.05, 4, 2  # [-] of a second's samples; so many, or fewer where all lose some
_LATE, _UNEVEN_FRAMES, _LATE_FRAMES = 0.015, 0.025, 0.5  # [s] of sensors; jitter and age of frames
_RECOVERED = 3.0  # [s] below half a limit
_GRACE = 0.1  # [s] without any sample, from which on the session's clock goes on by itself
_FRAMES = 60  # estimates that the figures of `Monitor.status` are of


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of a stream over its last second; 0 before there are any."""

    rate_hz: float = 0.0  #: Samples per second that came
    period: float = 0.0  #: [s] between samples where none is lost
    missing: int = 0  #: Samples that did not come in that second
    missing_hz: float = 0.0  #: Samples per second that did not come
    jitter: float = 0.0  #: [s] between the 5th and the 95th percentile of lateness
    age: float = 0.0  #: [s] median lateness: by how much a sample is older than the newest of any stream before it

    @property
    def loss(self) -> float:
        """Share of the samples that did not come, [-]."""
        return self.missing_hz / max(self.missing_hz + self.rate_hz, 1e-9)


def _period(steps: list[float]) -> tuple[float, bool]:
    """Return the step without lost samples and whether nearly all steps are whole multiples of it."""
    ordered = sorted(steps)
    median = ordered[len(ordered) // 2]
    for period in (median / 3, median / 2, median):
        shares = [step / period for step in steps]
        if period < median and sum(abs(s - 1) < _EVEN for s in shares) < _HALVES * len(steps):
            continue
        even = sum(abs(s - max(round(s), 1)) < _EVEN for s in shares)
        if even >= _MOSTLY_EVEN * len(steps):
            return period, True
    return median, False


class State(Enum):
    """What a stream is doing; of several that hold, the first one is shown."""

    WAITING = "waiting"  #: Nothing has come yet
    LOST = "lost"  #: Nothing comes any more
    FROZEN = "frozen"  #: It repeats the same numbers; a camera also where no frame comes any more
    EMPTY = "nobody seen"  #: The camera's frames have no landmark
    LOSSY = "lossy"  #: Some samples do not come
    LATE = "late"  #: Samples come late or out of order
    OK = "ok"


@dataclass(frozen=True)
class Change:
    """One stream, or several at once, begin or cease to be in a state."""

    time: float  #: [s] since the first sample
    streams: tuple[str, ...]  #: Sensors, or `VIDEO`
    state: State  #: That begins or ends
    begins: bool  #: Whether it begins
    sentence: str  #: Streams, state and figures


@dataclass(frozen=True)
class StreamSummary:
    """Samples of one stream in the whole session."""

    received: int  #: With a usable time
    lost: int  #: That did not come, by the stream's own rate
    late: int  #: More than 15 ms older than the newest one of any stream before
    repeated: int  #: That came while the stream was frozen
    too_late: int = 0  #: That came too late for the estimate
    left_out: int = 0  #: Not used for their numbers, because they repeated, or for their time


class _Stream:
    """One sensor, or the camera."""

    def __init__(self, name: str):
        self.name = name
        self.quality = Quality()
        self._samples: deque[tuple[float, float]] = deque(maxlen=_MOST)  # time and lateness of the last ones, s
        self._usual_hz = 0.0
        self.heard = math.nan  # [s] on the session's clock, when the last sample came
        self.newest = self.same_since = self.seen = self.counted = math.nan
        self.numbers = b""
        self.oriented_only = False
        self.received = self.late = self.repeated = 0
        self.lost = 0.0
        self.since: dict[State, float] = {}
        self.good: dict[State, float] = {}
        self.sentence = ""

    @property
    def state(self) -> State:
        if self.received == 0:
            return State.WAITING
        return next((state for state in State if state in self.since), State.OK)

    def add(self, arrived: Arrived, age: float, heard: float) -> None:
        sample, time = arrived.sample, arrived.time
        self.received += 1
        self.late += age > _LATE
        self.heard = heard
        if self.received == 1:
            self.counted = time
        elif time - self.newest > self.silence:
            gap = (time - self.newest) / self.quality.period - 1 if self.quality.period else 0.0
            self.lost, self.counted = self.lost_so_far + gap, time
            self._samples.clear()
        self._samples.append((time, age))
        if time <= self.newest:
            return
        if isinstance(sample, FrameSample):
            numbers, seen = sample.uv_px.tobytes(), bool((sample.confidence > 0).any())
            self.seen = time if seen or self.received == 1 else self.seen
        else:
            numbers, seen = sample.R_inertial_sensor.tobytes() + sample.f_sensor.tobytes(), True
            self.oriented_only = math.isnan(sample.f_sensor[0])
        if numbers != self.numbers or not seen:
            self.numbers, self.same_since = numbers, time
        self.newest = time
        self.repeated += State.FROZEN in self.since

    @property
    def silence(self) -> float:
        """Seconds without a sample after which the stream is lost."""
        return max(_SILENT, _PERIODS * self.quality.period)

    def judge(self, now: float, overdue: bool, missing: int) -> dict[State, bool | None]:
        """Return which states hold; None where the last judgement stays."""
        if self.received == 0:
            return {State.WAITING: overdue}
        video, q = self.name == VIDEO, self.quality
        if now - self.heard > self.silence:
            return {State.FROZEN: True} if video else {State.LOST: True}
        uneven, late = (_UNEVEN_FRAMES, _LATE_FRAMES) if video else (_LATE, 10 * _LATE)
        lateness = max(q.jitter / uneven, q.age / late)
        same = _SAME_ORIENTATION if self.oriented_only else _SAME
        loss = min(q.loss / _LOSS, q.missing / missing)
        return {
            State.WAITING: False,
            State.LOST: False,
            State.FROZEN: self.newest - self.same_since > same,
            State.EMPTY: video and self.newest - self.seen > _NOBODY,
            State.LOSSY: self._limited(State.LOSSY, loss, now),
            State.LATE: self._limited(State.LATE, lateness, now),
        }

    def _limited(self, state: State, multiple: float, now: float) -> bool | None:
        """Return whether a figure, as a multiple of its limit, is above it, or below its half for long."""
        if multiple > 0.5:
            self.good.pop(state, None)
            return True if multiple >= 1 else None
        return False if now - self.good.setdefault(state, now) >= _RECOVERED else None

    def renew(self) -> None:
        """Renew the figures, where there are enough samples, and count what was lost since the last time."""
        if not self._samples:
            return
        newest = max(time for time, _ in self._samples)
        first, last = newest - _OUT_OF_ORDER - _SPAN, newest - _OUT_OF_ORDER
        while self._samples and self._samples[0][0] < first:
            self._samples.popleft()
        times = sorted({time for time, _ in self._samples if first <= time <= last})
        if len(times) < _FEWEST or times[-1] - times[0] < _SHORTEST:
            return
        span = times[-1] - times[0]
        period, even = _period([b - a for a, b in pairwise(times)])
        rate_hz = (len(times) - 1) / span
        if even:
            missing, self._usual_hz = max(0, round(span / period) + 1 - len(times)), 1 / period
        else:  # stamps of arrival, in bursts: only against what was usual
            usual_hz = self._usual_hz or rate_hz
            few = rate_hz < _CLEARLY * usual_hz
            missing, period = round(span * (usual_hz - rate_hz)) if few else 0, 1 / usual_hz
            self._usual_hz = usual_hz + _ADAPTING * (rate_hz - usual_hz)
        ages = sorted(age for _, age in self._samples)
        low, middle, high = (ages[int(share * (len(ages) - 1))] for share in (0.05, 0.5, 0.95))
        self.quality = Quality(rate_hz, period, missing, missing / span, high - low, middle)
        self.lost, self.counted = self.lost_so_far, self.newest

    @property
    def lost_so_far(self) -> float:
        """Number of samples that did not come."""
        return self.lost + self.quality.missing_hz * max(0.0, self.newest - self.counted)

    def turned(self, state: State, holds: bool | None, now: float) -> float | None:
        """Note a state; return how long it lasted if it ends, 0 if it begins, None if neither."""
        if holds is None or holds == (state in self.since):
            return None
        if holds:
            self.since[state] = now
            return 0.0
        return now - self.since.pop(state)


class Monitor:
    """Follows all streams: `update` takes every sample, `check` returns what has changed."""

    def __init__(self, sensors: Sequence[str] = (), patience_s: float = 3.0):
        """Begin to wait for streams. `patience_s`: after which a stream that does not start is told, s."""
        self._streams = {name: _Stream(name) for name in sensors}
        self._patience = patience_s
        self._front = self._before = self._moved = math.nan  # newest time; before this step; its arrival
        self._start = self._began = math.nan  # first time, first arrival
        self._checked, self._turn = -math.inf, 0
        self._frames: deque[tuple[float, float, float]] = deque(maxlen=_FRAMES)  # time, lag, seconds

    def expect(self, stream: str) -> None:
        """Begin to wait for a further stream. `stream`: sensor, or `VIDEO`."""
        self._streams.setdefault(stream, _Stream(stream))

    def update(self, arrived: Arrived) -> None:
        """Take a sample. `arrived`: with its time; one that is left out (NaN) is ignored."""
        if math.isnan(arrived.time):
            return
        if math.isnan(self._front):
            self._start = self._before = arrived.time
        if not arrived.time <= self._front:
            self._front, self._moved = arrived.time, arrived.arrival
        if arrived.stream not in self._streams:
            self.expect(arrived.stream)
        age = max(0.0, self._before - arrived.time)
        self._streams[arrived.stream].add(arrived, age, self.now(arrived.arrival))

    def estimated(self, estimate: OnlineEstimate, seconds: float) -> None:
        """Take an estimate, for the figures of `status`."""
        self._frames.append((float(estimate.poses.times[0]), estimate.lag_s, seconds))

    def frozen(self, stream: str) -> bool:
        """Return whether a stream repeats itself at the moment, so that its samples tell nothing.

        `stream`: sensor, or `VIDEO`.
        """
        return stream in self._streams and State.FROZEN in self._streams[stream].since

    def now(self, arrival: float) -> float:
        """Return the present on the session's clock, s; NaN before the first sample.

        `arrival`: s on this machine's clock.
        """
        return self._front + max(0.0, arrival - self._moved - _GRACE)

    def elapsed(self, arrival: float) -> float:
        """Return the seconds since the first sample, or before it since the first check.

        `arrival`: s on this machine's clock.
        """
        if math.isnan(self._began):
            self._began = arrival
        return arrival - self._began if math.isnan(self._front) else self.now(arrival) - self._start

    def check(self, arrival: float) -> list[Change]:
        """Return what has changed since the last call; called after the samples of every step.

        `arrival`: now, s on this machine's clock.
        """
        self._before, elapsed = self._front, self.elapsed(arrival)
        now = arrival if math.isnan(self._front) else self.now(arrival)
        if abs(now - self._checked) < _EVERY:
            return []
        self._checked, self._turn = now, (self._turn + 1) % _TURNS
        overdue = max(arrival - self._began, elapsed) >= self._patience
        missing = _TOGETHER if self._loss() >= _LOSS else _MISSING
        groups: dict[tuple[State, bool, bool], list[tuple[_Stream, float]]] = {}
        for stream in self._streams.values():
            if self._turn == 0:
                stream.renew()
            for state, holds in stream.judge(now, overdue, missing).items():
                seconds = stream.turned(state, holds, now)
                if seconds is not None:
                    key = state, bool(holds), stream.name == VIDEO
                    groups.setdefault(key, []).append((stream, seconds))
        return [self._change(*key[:2], group, now, elapsed) for key, group in groups.items()]

    def _loss(self) -> float:
        """Return the share of the samples of all streams that did not come in the last second."""
        figures = [s.quality for s in self._streams.values() if s.received and State.LOST not in s.since]
        lost, came = sum(q.missing_hz for q in figures), sum(q.rate_hz for q in figures)
        return lost / max(lost + came, 1e-9)

    def status(self) -> dict[str, Any]:
        """Return the state of all streams and the figures of the estimate as plain values, for displays.

        Returns:
            ``sensors``, a list, and ``camera`` (empty without one): ``name``, ``state``, ``rate_hz``,
            ``loss_percent``, ``jitter_ms``, ``latency_ms``, ``sentence``; ``rate_hz``, ``lag_ms`` and
            ``frame_ms`` of the last estimates, None before there are any.
        """
        shown = [_shown(stream) for stream in self._streams.values()]
        figures: dict[str, float | None] = dict.fromkeys(("rate_hz", "lag_ms", "frame_ms"))
        if self._frames:
            times, lags, seconds = (np.array(column) for column in zip(*self._frames, strict=True))
            span = float(times[-1] - times[0])
            figures["rate_hz"] = round((len(times) - 1) / span, 1) if span > 0 else None
            figures["lag_ms"] = round(1000 * float(lags[-1]), 1)
            figures["frame_ms"] = round(1000 * float(np.median(seconds)), 2)
        return {
            "sensors": [one for one in shown if one["name"] != VIDEO],
            "camera": next((one for one in shown if one["name"] == VIDEO), {}),
            **figures,
        }

    def counts(self) -> dict[str, StreamSummary]:
        """Return the samples of each stream so far."""
        return {
            s.name: StreamSummary(s.received, round(s.lost_so_far), s.late, s.repeated) for s in self._streams.values()
        }

    def _change(
        self, state: State, begins: bool, group: Sequence[tuple[_Stream, float]], now: float, elapsed: float
    ) -> Change:
        streams = [stream for stream, _ in group]
        seconds = max(lasted for _, lasted in group)
        text = _begun(state, streams, now, self._patience) if begins else _ended(state, seconds)
        names = tuple(stream.name for stream in streams)
        for stream in streams:
            stream.sentence = text
        return Change(elapsed, names, state, begins, f"{', '.join(names)}: {text}")


def _begun(state: State, streams: Sequence[_Stream], now: float, patience: float) -> str:
    """Say what begins; the same state of one or several streams."""
    video = streams[0].name == VIDEO
    silence = f"{min(now - stream.heard for stream in streams):.1f} s"
    if state is State.WAITING:
        return f"nothing has come in {patience:g} s; is it switched on, and the name right?"
    if state is State.LOST:
        return f"no usable sample for {silence}; the estimate goes on without it"
    if state is State.FROZEN and video and now - streams[0].heard > streams[0].silence:
        return f"no frame for {silence}; the estimate goes on with the sensors"
    if state is State.FROZEN:
        seconds = min(stream.newest - stream.same_since for stream in streams)
        return f"the same numbers for {seconds:.1f} s; left out until they change"
    if state is State.EMPTY:
        return "nobody is seen; the estimate goes on with the sensors"
    if state is State.LOSSY:
        return f"{_range([100 * stream.quality.loss for stream in streams])} % of the samples do not come"
    late = [1000 * (stream.quality.age + stream.quality.jitter) for stream in streams]
    return f"samples come up to {_range(late)} ms late"


def _ended(state: State, seconds: float) -> str:
    if state is State.LOSSY:
        return "nearly all samples come again"
    if state is State.LATE:
        return "samples come in time again"
    return "it has started" if state is State.WAITING else f"back again after {seconds:.1f} s"


def _range(values: Sequence[float]) -> str:
    least, most = f"{min(values):.0f}", f"{max(values):.0f}"
    return most if least == most else f"{least} to {most}"


def _shown(stream: _Stream) -> dict[str, Any]:
    q = stream.quality
    return {
        "name": stream.name,
        "state": stream.state.value,
        "rate_hz": round(q.rate_hz, 1),
        "loss_percent": round(100 * q.loss, 1),
        "jitter_ms": round(1000 * q.jitter, 1),
        "latency_ms": round(1000 * q.age, 1),
        "sentence": stream.sentence,
    }
