"""Recordings and sensor files as live streams: at their speed, faster, or as fast as they are read.

Sources of one session share a `ReplayClock`, so that they stay together. Faults may be added on purpose: lost
and late samples, dead sensors, a picture that freezes, a video that is late.
"""

from __future__ import annotations

import threading
import time as system
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.orientation import OrientationSettings, log_with_orientation
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.keypoints import read_detector_keypoints

_STEP: Final = 1 / 60
_LONGEST_WAIT: Final = 0.05  # [s] after which a thread that waits looks whether it should stop


class ReplayClock:
    """Time that all replays of a session have reached.

    `speed`: times real time; inf: every round of polls is 1/60 s later, however long it took. `now`: seconds of the
    system. `InvalidInputError`: the speed is not positive.
    """

    def __init__(self, speed: float = 1.0, now: Callable[[], float] = system.monotonic) -> None:
        if not speed > 0:
            raise InvalidInputError(f"speed of a replay: {speed:g} is not positive")
        self._speed, self._system = speed, now
        self._spans: dict[str, tuple[float, float]] = {}
        self._begun: float | None = None
        self._round, self._read = 0, set[int]()
        self._lock = threading.Lock()

    @property
    def paced(self) -> bool:
        """Whether time passes by itself; else by polls."""
        return bool(np.isfinite(self._speed))

    @property
    def first(self) -> float:
        """Earliest time of any source, s."""
        return min((start for start, _ in self._spans.values()), default=0.0)

    @property
    def time(self) -> float:
        """Time that was reached, s; asking does not move it on."""
        with self._lock:
            if self.paced:
                return self.first if self._begun is None else self._paced(self._begun)
            return self.first + self._round * _STEP

    def cover(self, name: str, first: float, last: float) -> None:
        """Take part: the replay begins at the earliest time of all sources. `first`, `last`: its times, s.
        `SourceError`: no time is common with another source, so their clocks differ.
        """
        for other, (start, stop) in self._spans.items():
            if last < start or stop < first:
                raise SourceError(
                    f"{name}: its times run from {first:.3f} to {last:.3f} s, those of {other} from "
                    f"{start:.3f} to {stop:.3f} s, so their clocks differ; make a recording of them first "
                    "(rtof-kin run --only recording) and replay that"
                )
        self._spans[name] = first, last

    def now(self, reader: object) -> float:
        """Return the time that was reached, s; it begins with the first call.

        `reader`: the source that asks. Without pace, its second question begins a new round.
        """
        with self._lock:
            if self._begun is None:
                self._begun = self._system()
            if self.paced:
                return self._paced(self._begun)
            if id(reader) in self._read:
                self._round += 1
                self._read.clear()
            self._read.add(id(reader))
            return self.first + self._round * _STEP

    def _paced(self, begun: float) -> float:
        return self.first + self._speed * (self._system() - begun)

    def age(self, time: float) -> float:
        """Return how long ago a time was reached, in seconds of the system; 0 without pace. `time`: s."""
        if not self.paced or self._begun is None:
            return 0.0
        return max(self._paced(self._begun) - time, 0.0) / self._speed

    def wait(self, until: float, stop: threading.Event) -> bool:
        """Wait for a time; return False where `stop` was set before.

        `until`: s; without pace there is nothing to wait for.
        """
        while not stop.is_set():
            if not self.paced:
                return True
            if self._begun is None:
                stop.wait(_LONGEST_WAIT / 10)
                continue
            left = (until - self._paced(self._begun)) / self._speed
            if left <= 0:
                return True
            stop.wait(min(left, _LONGEST_WAIT))
        return False


@dataclass(frozen=True)
class Faults:
    """Faults that a replay adds; the same seed gives the same ones."""

    loss: float = 0.0  #: Fraction of the samples that never arrive
    jitter_s: float = 0.0  #: Largest delay of an arrival, s; stamps stay as they are, the order does not
    dead: tuple[tuple[str, float, float], ...] = ()
    """Sensor (or `VIDEO`), start and stop, s: none of its samples arrives."""
    frozen: tuple[float, float] | None = None  #: Start and stop, s: the picture repeats, with new stamps
    video_delay_s: float = 0.0  #: By how much frames arrive and are stamped late, s
    seed: int = 0  #: Of losses and delays

    def __post_init__(self) -> None:
        object.__setattr__(self, "dead", tuple((str(n), float(a), float(b)) for n, a, b in self.dead))
        if not (0 <= self.loss <= 1 and 0 <= self.jitter_s < np.inf and np.isfinite(self.video_delay_s)):
            raise InvalidInputError(
                f"faults: loss {self.loss:g}, jitter {self.jitter_s:g} s and video delay "
                f"{self.video_delay_s:g} s; give a fraction, a positive time and a time"
            )


_NO_FAULTS: Final = Faults()


@dataclass(frozen=True)
class _Track:
    """One stream of a replay."""

    name: str  #: Sensor, or `VIDEO`
    times: Array  #: (T,) s
    here: NDArray[np.bool_]  #: (T,) whether a row holds a sample
    sample: Callable[[int], Sample]  #: Of a row
    delay_s: float = 0.0  #: By how much its samples arrive late, s


class RecordingReplay:
    """Source of the frames, the sensors or both of a recording, or of the sensors of a file.

    `streams`: sensors with orientation, at their own times on one clock. `renamed`: name of a sensor in the
    calibration, by its own. `UnknownNameError`: a fault of an unknown sensor.
    """

    def __init__(
        self,
        name: str,
        streams: Sequence[SensorStream] = (),
        keypoints: KeypointSequence | None = None,
        replay: ReplayClock | None = None,
        clock: Clock = Clock.COMMON,
        faults: Faults = _NO_FAULTS,
        renamed: Callable[[str], str] = str,
    ):
        self.name, self.clock, self._replay = name, clock, replay or ReplayClock()
        self.sensors = tuple(renamed(stream.name) for stream in streams)
        """Names of the sensors."""
        self.landmarks: tuple[str, ...] = () if keypoints is None else keypoints.names
        """Names of the points of a frame."""
        self._tracks = [_sensor(stream, own) for stream, own in zip(streams, self.sensors, strict=True)]
        self._tracks += [] if keypoints is None else [_video(keypoints, faults)]
        names = [track.name for track in self._tracks]
        if unknown := [who for who, _, _ in faults.dead if who not in names]:
            raise UnknownNameError("sensor of the faults", unknown, names)
        self._arrival, self._track, self._row = self._arrivals(faults)
        self._notices = list[str]()
        self._next, self._closed = 0, False

    @classmethod
    def of_recording(
        cls,
        recording: Recording,
        replay: ReplayClock | None = None,
        *,
        video: bool = True,
        sensors: bool = True,
        clock: Clock = Clock.COMMON,
        faults: Faults = _NO_FAULTS,
        renamed: Callable[[str], str] = str,
    ) -> Self:
        """Replay a recording. `SourceError`: it has none of them."""
        keypoints = recording.keypoints if video else None
        imus = recording.imus if sensors else None
        if keypoints is None and imus is None:
            lacking = "keypoints" if video else "samples of sensors"
            raise SourceError(f"recording {recording.name}: has no {lacking} to replay")
        parts = [VIDEO] * (keypoints is not None) + ["sensors"] * (imus is not None)
        streams = () if imus is None else SensorLog.of_imus(imus, recording.name).streams
        name = f"{recording.name} ({' and '.join(parts)})"
        own = cls(name, streams, keypoints, replay, clock, faults, renamed)
        if video and recording.views:
            own._notices.append(f"{name}: only its first camera is replayed")
        return own

    @classmethod
    def of_sensor_file(
        cls,
        path: str | Path,
        replay: ReplayClock | None = None,
        *,
        clock: Clock = Clock.COMMON,
        renamed: Callable[[str], str] = str,
    ) -> Self:
        """Replay sensor files; orientations that they lack are estimated by the causal filter.

        `path`: file or folder that `read_sensor_log` reads. `SourceError`: not read, or a sensor has neither an
        orientation nor what gives one.
        """
        try:
            log = log_with_orientation(read_sensor_log(path), settings=OrientationSettings(causal=True))
        except RtofError as error:
            raise SourceError(f"{error}") from error
        own = cls(f"{Path(path).name} (sensors)", log.streams, None, replay, clock, renamed=renamed)
        remarks: dict[str, list[str]] = {note: [] for note in log.file_notes}
        for stream in log.streams:
            for note in stream.notes:
                remarks.setdefault(note, []).append(stream.name)
        for note, sensors in remarks.items():
            own._notices.append(": ".join(filter(None, (own.name, ", ".join(sensors), note))))
        return own

    @classmethod
    def of_keypoint_file(
        cls, path: str | Path, camera: Camera, replay: ReplayClock | None = None, *, clock: Clock = Clock.COMMON
    ) -> Self:
        """Replay the points that a detector wrote, of the person who is most prominent in the whole file.

        `path`: file with times that `read_detector_keypoints` reads. `SourceError`: not read, or without times.
        """
        try:
            found = read_detector_keypoints(path, camera)
        except RtofError as error:
            raise SourceError(f"{error}") from error
        own = cls(f"{Path(path).name} ({VIDEO})", (), found.keypoints, replay, clock)
        own._notices.append(f"{own.name}: {found.summary}")
        return own

    def _arrivals(self, faults: Faults) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """Return arrival (N,) s, index of the track (N,) and row (N,) of all samples, in order."""
        kept: list[NDArray[np.int64]] = []
        for track in self._tracks:
            here = track.here
            for who, start, stop in faults.dead:
                if who == track.name:
                    here = here & ~((start <= track.times) & (track.times < stop))
            kept.append(np.flatnonzero(here))
        times = [track.times[rows] + track.delay_s for track, rows in zip(self._tracks, kept, strict=True)]
        arrival, row = np.concatenate(times), np.concatenate(kept)
        tracks = np.repeat(np.arange(len(kept)), list(map(len, kept)))
        rng = np.random.default_rng(faults.seed)
        arrives = rng.random(len(arrival)) >= faults.loss
        arrival = arrival + faults.jitter_s * rng.random(len(arrival))
        order = np.argsort(np.where(arrives, arrival, np.inf), kind="stable")[: int(arrives.sum())]
        return arrival[order], tracks[order], row[order]

    @property
    def finished(self) -> bool:
        """Whether every sample was polled."""
        return self._closed or self._next == len(self._arrival)

    def start(self) -> None:
        """Join the shared clock. `SourceError`: the times are those of another clock than another replay's."""
        self._closed = False
        first = min(float(track.times[0]) for track in self._tracks)
        self._replay.cover(self.name, first, max(float(track.times[-1]) for track in self._tracks))

    def poll(self) -> list[Sample]:
        """Return the samples that arrived up to the shared clock's time."""
        if self.finished:
            return []
        begin = self._next
        self._next += int(np.searchsorted(self._arrival[begin:], self._replay.now(self), side="right"))
        return [self._tracks[self._track[i]].sample(int(self._row[i])) for i in range(begin, self._next)]

    def notices(self) -> list[str]:
        """Return remarks on the file, once."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Stop."""
        self._closed = True


def _sensor(stream: SensorStream, name: str) -> _Track:
    times, R, f = stream.times, stream.R_inertial_sensor, stream.f_sensor
    assert R is not None
    f = np.full((len(times), 3), np.nan) if f is None else f
    here = np.asarray(np.isfinite(R).all(axis=(1, 2)) | np.isfinite(f).all(axis=1))
    return _Track(name, times, here, lambda row: ImuSample(name, float(times[row]), R[row], f[row]))


def _video(frames: KeypointSequence, faults: Faults) -> _Track:
    delay, frozen = faults.video_delay_s, faults.frozen
    still = 0 if frozen is None else max(int(np.searchsorted(frames.times, frozen[0])) - 1, 0)

    def sample(row: int) -> Sample:
        time = float(frames.times[row])
        seen = still if frozen is not None and frozen[0] <= time < frozen[1] else row
        return FrameSample(time + delay, frames.uv_px[seen], frames.confidence[seen])

    return _Track(VIDEO, frames.times, np.ones(len(frames), dtype=np.bool_), sample, delay)
