"""Recordings and sensor files as live streams: at their speed, faster, or as fast as they are read.

Sources of one session share a `ReplayClock`, so that they stay together. Faults may be added on purpose: lost
and late samples, dead sensors, a picture that freezes, a video that is late.
"""

from __future__ import annotations

import threading
import time as system
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError, UnknownNameError
from rtof_kin.core.over_time import BLOCK, Part, Stream
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.orientation import OrientationSettings, log_with_orientation
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample
from rtof_kin.recording.recording import RecordingSource
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
    here: Mask  #: (T,) whether a row holds a sample
    sample: Callable[[int], Sample]  #: Of a row
    delay_s: float = 0.0  #: By how much its samples arrive late, s


class RecordingReplay:
    """Source of the frames, the sensors or both of a recording, of which it reads blocks, or of the sensors of a file.

    `UnknownNameError`: a fault of an unknown sensor.
    """

    def __init__(
        self,
        name: str,
        sensors: Sequence[_Track],
        keypoints: Stream[KeypointSequence] | None,
        replay: ReplayClock | None,
        clock: Clock,
        faults: Faults = _NO_FAULTS,
    ):
        self.name, self.clock, self._replay = name, clock, replay or ReplayClock()
        self.sensors = tuple(track.name for track in sensors)
        """Names of the sensors."""
        self.landmarks: tuple[str, ...] = () if keypoints is None else keypoints.part(slice(0, 1)).names
        """Names of the points of a frame."""
        self._tracks = [*sensors, *([] if keypoints is None else [_video(keypoints, faults)])]
        names = [track.name for track in self._tracks]
        if unknown := [who for who, _, _ in faults.dead if who not in names]:
            raise UnknownNameError("sensor of the faults", unknown, names)
        self._arrival, self._track, self._row = self._arrivals(faults)
        self._notices, self._next, self._closed = list[str](), 0, False

    @classmethod
    def of_recording(
        cls,
        recording: RecordingSource,
        replay: ReplayClock | None = None,
        *,
        video: bool = True,
        sensors: bool = True,
        clock: Clock = Clock.COMMON,
        faults: Faults = _NO_FAULTS,
        renamed: Callable[[str], str] = str,
    ) -> Self:
        """Replay a recording; a reader stays open until the end. `renamed`: name of a sensor in the calibration, by its
        own. `SourceError`: it has none of them.
        """
        keypoints = recording.streams.keypoints if video else None
        imus = recording.streams.imus if sensors else None
        if keypoints is None and imus is None:
            lacking = "keypoints" if video else "samples of sensors"
            raise SourceError(f"recording {recording.name}: has no {lacking} to replay")
        parts = [VIDEO] * (keypoints is not None) + ["sensors"] * (imus is not None)
        name = f"{recording.name} ({' and '.join(parts)})"
        own = cls(name, [] if imus is None else _sensors(imus, renamed), keypoints, replay, clock, faults)
        if video and recording.streams.views:
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
        tracks = [_sensor(stream, renamed(stream.name)) for stream in log.streams]
        own = cls(f"{Path(path).name} (sensors)", tracks, None, replay, clock)
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
            keypoints = found.keypoints
        except RtofError as error:
            raise SourceError(f"{error}") from error
        own = cls(f"{Path(path).name} ({VIDEO})", [], Stream.of(keypoints), replay, clock)
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
    return _Track(name, times, _known(R, f), lambda row: ImuSample(name, float(times[row]), R[row], f[row]))


def _sensors(imus: Stream[ImuSequence], renamed: Callable[[str], str]) -> list[_Track]:
    times, at = imus.times, _reading(imus)
    here = np.concatenate([_known(part.R_inertial_sensor, part.f_sensor) for part in imus.blocks()])

    def track(s: int, name: str) -> _Track:
        def sample(row: int) -> ImuSample:
            part, i = at(row)
            return ImuSample(name, float(times[row]), part.R_inertial_sensor[i, s], part.f_sensor[i, s])

        return _Track(name, times, here[:, s], sample)

    return [track(s, renamed(name)) for s, name in enumerate(imus.part(slice(0, 1)).names)]


def _known(R: Array, f: Array) -> Mask:
    """Return where an orientation (..., 3, 3) or a specific force (..., 3) is known."""
    return np.asarray(np.isfinite(R).all(axis=(-2, -1)) | np.isfinite(f).all(axis=-1))


def _video(frames: Stream[KeypointSequence], faults: Faults) -> _Track:
    delay, frozen, at = faults.video_delay_s, faults.frozen, _reading(frames)
    still = 0 if frozen is None else max(int(np.searchsorted(frames.times, frozen[0])) - 1, 0)

    def sample(row: int) -> Sample:
        time = float(frames.times[row])
        part, i = at(still if frozen is not None and frozen[0] <= time < frozen[1] else row)
        return FrameSample(time + delay, part.uv_px[i], part.confidence[i])

    return _Track(VIDEO, frames.times, np.ones(len(frames), dtype=np.bool_), sample, delay)


def _reading(stream: Stream[Part]) -> Callable[[int], tuple[Part, int]]:
    """Return what reads the block of a row, and gives where the row is in it; late samples are of the block before."""
    block = lru_cache(2)(lambda start: stream.part(slice(start, min(start + BLOCK, len(stream)))))
    return lambda row: (block(row - row % BLOCK), row % BLOCK)
