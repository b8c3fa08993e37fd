"""`LiveSession`: sources (`Feed`) to estimates to sinks, with every disturbance told and none of them fatal."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import methodcaller
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Final

import numpy as np

from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import RtofError
from rtof_kin.live.clock_map import VIDEO, Arrived, SessionClock, stream_of
from rtof_kin.live.monitor import Monitor, State, StreamSummary
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import OnlineEstimate, Sample, Sink, Source
from rtof_kin.live.stream_checks import (
    FirstSeconds,
    landmark_sentences,
    number_faults,
    sensor_sentence,
    unknown_sensors,
)
from rtof_kin.recording.recording import Recording

if TYPE_CHECKING:
    from rtof_kin.live.estimator import OnlineEstimator


_FIRST_PAUSE: Final = 0.5
_LONGEST_PAUSE: Final = 8.0  # [s] between attempts


class Feed:
    """Polls one source; whatever it raises becomes a sentence and another attempt after a pause.

    An attempt is another `Source.start`, which does nothing where the source is open, and polls from then on.
    """

    def __init__(self, source: Source, in_background: bool = False):
        """Take a source that is not started yet.

        `in_background`: start it in a thread, as finding a stream may take seconds.
        """
        self.source, self.name = source, source.name
        self._in_background = in_background
        self._running, self._closed = False, False
        self._starting: Thread | None = None
        self._problem: BaseException | None = None
        self._next, self._pause = float("-inf"), _FIRST_PAUSE
        self._told = ""
        self._sentences: list[str] = []
        self.finished = False
        """Whether no further sample will come."""

    def poll(self, arrival: float) -> list[Sample]:
        """Return what has arrived; start the source where that is due. `arrival`: now, s on this machine's clock."""
        if self._closed or self.finished or not (self._running or self._started(arrival)):
            return []
        try:
            over = self.source.finished
            samples = self.source.poll()
            self._sentences += [self._named(text) for text in self.source.notices()]
        except Exception as error:  # of a foreign device or library
            self._fail(error, arrival)
            return []
        if samples:
            self._pause = _FIRST_PAUSE
            if self._told:
                self._told = ""
                self._sentences.append(f"{self.name}: goes on")
        self.finished = over and not samples
        return samples

    def sentences(self) -> list[str]:
        """Return sentences since the last call: those of the source, failures and recoveries."""
        sentences, self._sentences = self._sentences, []
        return sentences

    def close(self) -> None:
        """Stop; may be called twice."""
        self._closed = True
        try:
            self.source.close()
        except Exception as error:  # of a foreign device or library
            self._tell(error, "")

    def _started(self, arrival: float) -> bool:
        """Begin or go on to start the source; return whether it runs."""
        if self._starting is None:
            if arrival < self._next:
                return False
            self._problem = None
            self._starting = Thread(target=self._start, name=f"start {self.name}", daemon=True)
            self._starting.start()
            if not self._in_background:
                self._starting.join()
        if self._starting.is_alive():
            return False
        self._starting, self._running = None, self._problem is None
        if self._problem is not None:
            self._fail(self._problem, arrival)
        return self._running

    def _start(self) -> None:
        try:
            self.source.start()
        except Exception as error:  # of a foreign device or library
            self._problem = error
        if self._closed:  # meanwhile
            self.source.close()

    def _fail(self, error: BaseException, arrival: float) -> None:
        self._running = False
        self._next, self._pause = arrival + self._pause, min(2 * self._pause, _LONGEST_PAUSE)
        self._tell(error, "; it is tried again")

    def _tell(self, error: BaseException, what_follows: str) -> None:
        text = self._named(str(error) or type(error).__name__)
        if text != self._told:
            self._told = text
            self._sentences.append(text + what_follows)

    def _named(self, text: str) -> str:
        return text if text.startswith(self.name) else f"{self.name}: {text}"


_AHEAD: Final = 1.0  # [s] by which a clock that is ahead of all others is left out
_ALIVE: Final = 0.5  # [s] since a stream's last sample, in which its time counts
_MOST_SENTENCES: Final = 1000
_HURRIED: Final = 120  # frames that were only predicted before the machine counts as too slow


@dataclass(frozen=True)
class SessionSummary:
    """What happened in a session."""

    frames: int  #: Number of estimates
    seconds: float  #: From the first to the last sample, s
    frame_ms_p50: float  #: [ms] Median time for a frame, all included; NaN without frames
    frame_ms_p99: float  #: [ms] 99th percentile of it
    streams: Mapping[str, StreamSummary]  #: By sensor, and ``video``
    sentences: tuple[str, ...]  #: What was told, with the time; at most 1000
    folder: Path | None  #: Recording of the session; None where none was made


class LiveSession:
    """Runs sources, an estimator and sinks; `run` in real time, `step` for one instant.

    A source that fails is told and tried again, a sink that fails is dropped.
    """

    def __init__(
        self,
        setup: Recording,
        sources: Sequence[Source],
        estimator: OnlineEstimator,
        *,
        sinks: Sequence[Sink] = (),
        recorder: Recorder | None = None,
        video_delay_s: float = 0.0,
        patience_s: float = 3.0,
        in_background: bool = True,
    ):
        """Put a session together; nothing is started yet.

        `recorder`: of everything; None for none. `video_delay_s`: by how much the video's stamps are late.
        `patience_s`: for streams that do not start. `in_background`: start sources and check first seconds in threads;
        without, `step` is deterministic. `InvalidInputError`: two sources of one name.
        """
        checked_names("live sources", [source.name for source in sources])
        self._setup, self._estimator, self._recorder = setup, estimator, recorder
        self._feeds = [Feed(source, in_background) for source in sources]
        self._clock = SessionClock({source.name: source.clock for source in sources})
        self._sinks = list(sinks)
        known = setup.calibration.sensors if setup.calibration is not None else ()
        self.monitor = Monitor(known, patience_s=patience_s)
        """State of all streams."""
        self.status = self.monitor.status
        """See `Monitor.status`."""
        self._patience, self._video_delay = patience_s, video_delay_s
        self._first = FirstSeconds()
        self._checker, self._in_background = ThreadPoolExecutor(1, "checks"), in_background
        self._checking: Future[list[str]] | None = None
        self._began = math.nan
        self._heard: set[str] = set()  # sources
        self._newest: dict[str, tuple[float, float]] = {}  # by stream: time, arrival
        self._said: set[tuple[str, str]] = set()
        self._owners: dict[str, str] = {}  # by stream: its source
        self._landmarks: tuple[str, ...] = ()
        self._left_out: dict[str, int] = {}
        self._sentences: list[str] = []
        self._frame_s, self._spent = array("d"), 0.0  # [s] time for each frame; since the last one
        self._summary: SessionSummary | None = None

    # --- one step --------------------------------------------------------------------------------

    def step(self, arrival: float) -> list[OnlineEstimate]:
        """Take what has arrived and return the estimates that are due.

        `arrival`: now, s on a clock that never goes back, such as `time.monotonic`.
        """
        began = time.perf_counter()
        self._began = arrival if math.isnan(self._began) else self._began
        arrived = self._arrived(arrival)
        for one in arrived:
            self.monitor.update(one)
            self._first.add(one)
            if self._recorder is not None:
                self._recorder.add(one)
        self._look(arrived, arrival)
        now = self._now(arrival)
        for one in arrived:
            self._push(one, now, arrival)
        estimates = self._advance(now, arrival)
        self._spent += time.perf_counter() - began
        if estimates:
            seconds = self._spent / len(estimates)
            self._frame_s.extend([seconds] * len(estimates))
            self._spent = 0.0
            for estimate in estimates:
                self.monitor.estimated(estimate, seconds)
        return estimates

    def record(self, recorder: Recorder) -> None:
        """Record from now on; once."""
        self._recorder = recorder
        recorder.landmarks(self._landmarks)

    def _arrived(self, arrival: float) -> list[Arrived]:
        """Return what has come; samples whose numbers are of no use have no time."""
        polled = list(self._polled(arrival))
        arrived = [self._clock.arrived(source, sample, arrival) for source, sample in polled]
        for i, fault in enumerate(number_faults([sample for _, sample in polled])):
            if fault:
                stream = arrived[i].stream
                self._once(stream, fault, f"{stream}: {fault}; such samples are left out", arrival)
                arrived[i] = replace(arrived[i], time=math.nan)
        for sentence in self._clock.notices(arrival):
            self._tell(sentence, arrival)
        return arrived

    def _polled(self, arrival: float) -> Iterator[tuple[str, Sample]]:
        """Poll all sources, by name; a stream is taken from the first source that gives it."""
        for feed in self._feeds:
            samples = feed.poll(arrival)
            for sentence in feed.sentences():
                self._tell(sentence, arrival)
            if samples:
                self._heard.add(feed.name)
            for sample in samples:
                stream = stream_of(sample)
                owner = self._owners.setdefault(stream, feed.name)
                if owner != feed.name:
                    text = f"{feed.name}: {stream} comes from {owner} already, and is used from there alone"
                    self._once(feed.name, stream, text, arrival)
                    continue
                if stream == VIDEO and feed.source.landmarks != self._landmarks:
                    self._landmarks = feed.source.landmarks  # names of the points from now on
                    for sentence in landmark_sentences(self._landmarks, self._setup):
                        self._tell(f"{feed.name}: {sentence}", arrival)
                    if self._recorder is not None:
                        self._recorder.landmarks(self._landmarks)
                yield feed.name, sample

    def _look(self, arrived: Sequence[Arrived], arrival: float) -> None:
        """Tell what is new: states of streams, names, sources that do not start, broken laws."""
        new = {one.stream for one in arrived if one.stream not in self._newest} - {VIDEO}
        for one in arrived:
            if not math.isnan(one.time) and not one.time <= self._newest.get(one.stream, (-math.inf, 0.0))[0]:
                self._newest[one.stream] = one.time, arrival
        unknown = unknown_sensors(sorted(new), self._setup)
        if unknown:
            self._tell(sensor_sentence(unknown, list(self._newest), self._setup), arrival)
        for feed in self._feeds:
            if feed.source.landmarks:
                self.monitor.expect(VIDEO)
        for change in self.monitor.check(arrival):
            if change.state is not State.WAITING or self._partly_heard(change.streams):
                self._tell(change.sentence, arrival)
        if arrival - self._began >= self._patience:
            for feed in self._feeds:
                if feed.name not in self._heard and not feed.finished:
                    text = f"nothing has come in {self._patience:g} s; the session goes on without it"
                    self._once(feed.name, "waiting", f"{feed.name}: {text}", arrival)
        self._check_first(arrival)

    def _partly_heard(self, streams: Sequence[str]) -> bool:
        """Return whether a source of such streams gives samples; else it is told by its name."""
        if VIDEO in streams:
            return any(feed.source.landmarks and feed.name in self._heard for feed in self._feeds)
        return any(name != VIDEO for name in self._newest)

    def _check_first(self, arrival: float) -> None:
        """Check the first seconds of sensors in a thread."""
        if self._checking is None and (due := self._first.due()) is not None:
            self._checking = self._checker.submit(due)
        if self._checking is not None and (self._checking.done() or not self._in_background):
            checked, self._checking = self._checking, None
            for sentence in checked.result():
                self._tell(sentence, arrival)

    def _now(self, arrival: float) -> float:
        """Return the present: the newest time of the sensors, or of the video where there are none.

        A stream that is a second ahead of all others has a wrong clock, which is told, and does not count.
        """
        alive = {n: t for n, (t, at) in self._newest.items() if arrival - at <= _ALIVE}
        sensors = sorted((t, name) for name, t in alive.items() if name != VIDEO)
        if not sensors:
            return alive[VIDEO] - self._video_delay if VIDEO in alive else math.nan
        if len(sensors) > 1 and sensors[-1][0] - sensors[-2][0] > _AHEAD:
            ahead, name = sensors[-1][0] - sensors[-2][0], sensors[-1][1]
            text = f"{name}: its clock is {ahead:.1f} s ahead of the others; it is left out"
            self._once(name, "ahead", text, arrival)
            return sensors[-2][0]
        return sensors[-1][0]

    def _push(self, one: Arrived, now: float, arrival: float) -> None:
        """Give a sample to the estimator, if it is of use."""
        stream = one.stream
        useful = one.time <= now + _AHEAD and not self.monitor.frozen(stream)  # NaN is not
        if not useful or unknown_sensors([stream] if stream != VIDEO else [], self._setup):
            self._left_out[stream] = self._left_out.get(stream, 0) + 1
            return
        try:
            self._estimator.push(replace(one.sample, time=one.time))
        except RtofError as error:
            self._once(stream, str(error), f"{stream}: {error}", arrival)

    def _advance(self, now: float, arrival: float) -> list[OnlineEstimate]:
        if math.isnan(now):
            return []
        try:
            estimates = self._estimator.advance(now, hurry=True)
        except RtofError as error:
            self._once("estimate", str(error), f"estimate: {error}", arrival)
            return []
        if self._estimator.hurried > _HURRIED:
            text = (
                "this machine is too slow for all frames: some are only predicted; choose a lower rate, or end "
                "other programs"
            )
            self._once("estimate", "slow", text, arrival)
        self._send(estimates, arrival)
        return estimates

    # --- sinks and messages ----------------------------------------------------------------------

    def _send(self, estimates: Sequence[OnlineEstimate], arrival: float) -> None:
        for estimate in estimates:
            if self._recorder is not None:
                self._recorder.add_estimate(estimate, arrival)
            for sentence in self._to_sinks(methodcaller("send", estimate)):
                self._tell(sentence, arrival)
        self._tell_notices(arrival)

    def _to_sinks(self, call: Callable[[Sink], None]) -> list[str]:
        """Call each sink; one that fails is closed and dropped. Return a sentence for each of these."""
        dropped = []
        for sink in tuple(self._sinks):
            try:
                call(sink)
            except Exception as error:  # of a foreign listener or library
                self._sinks.remove(sink)
                with suppress(Exception):
                    sink.close()
                dropped.append(f"{type(sink).__name__}: gets no more estimates ({str(error) or type(error).__name__})")
        return dropped

    def _tell_notices(self, arrival: float) -> None:
        for sentence in self._recorder.notices() if self._recorder is not None else ():
            self._tell(sentence, arrival)

    def _once(self, what: str, kind: str, sentence: str, arrival: float) -> None:
        if (what, kind) not in self._said and len(self._said) < _MOST_SENTENCES:
            self._said.add((what, kind))
            self._tell(sentence, arrival)

    def _tell(self, sentence: str, arrival: float) -> None:
        text = f"{self.monitor.elapsed(arrival):.1f} s: {sentence}"
        if len(self._sentences) < _MOST_SENTENCES:
            self._sentences.append(text)
        if self._recorder is not None:
            self._recorder.tell(text, arrival)
        for another in self._to_sinks(methodcaller("tell", text)):
            self._tell(another, arrival)

    # --- whole sessions --------------------------------------------------------------------------

    def run(
        self,
        stop: Callable[[], bool] = lambda: False,
        *,
        clock: Callable[[], float] = time.monotonic,
        period_s: float = 0.004,
    ) -> SessionSummary:
        """Run until told to stop, interrupted (Ctrl-C), or all sources have finished.

        `clock`: of the arrivals, s. period_s: between two polls; 0 for a replay that need not keep pace.
        """
        try:
            while not (stop() or self.finished):
                arrival = clock()
                self.step(arrival)
                time.sleep(max(0.0, period_s - (clock() - arrival)))
        except KeyboardInterrupt:
            pass
        finally:
            summary = self.finish(clock())
        return summary

    @property
    def finished(self) -> bool:
        """Whether no further sample will come."""
        return all(feed.finished for feed in self._feeds)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was told so far, with the time; at most 1000."""
        return tuple(self._sentences)

    def finish(self, arrival: float) -> SessionSummary:
        """Stop everything, make the recording and return what happened; may be called twice.

        `arrival`: now, s on the clock of the arrivals.
        """
        if self._summary is not None:
            return self._summary
        with suppress(RtofError):
            self._send(rest := self._estimator.finish(), arrival)
            if rest and self._frame_s:
                self._frame_s.extend([float(np.median(self._frame_s))] * len(rest))
        for feed in self._feeds:
            feed.close()
        self._checker.shutdown(wait=False, cancel_futures=True)
        folder = None
        if self._recorder is not None:
            try:
                self._recorder.finish()
                folder = self._recorder.folder
            except RtofError as error:
                self._tell(f"no recording was made: {error}", arrival)
            self._tell_notices(arrival)
        self._to_sinks(methodcaller("close"))
        self._summary = self._summed(self.monitor.elapsed(arrival), folder)
        return self._summary

    def _summed(self, seconds: float, folder: Path | None) -> SessionSummary:
        streams = {
            name: replace(count, too_late=self._estimator.dropped.get(name, 0), left_out=self._left_out.get(name, 0))
            for name, count in self.monitor.counts().items()
        }
        p50, p99 = (1e3 * np.percentile(self._frame_s, (50, 99))).tolist() if self._frame_s else (math.nan, math.nan)
        return SessionSummary(len(self._frame_s), seconds, p50, p99, streams, self.sentences, folder)
