"""Streams of the Lab Streaming Layer as sources: inertial sensors, or detected points.

Stamps are mapped to the LSL clock of this machine by the measured offset of the clock of the sender. They are
not smoothed: dejittering takes samples to be equally spaced, and where a sender leaves out the 10 % that its
radio lost it moves stamps by up to 0.33 s (measured at 60 Hz; without it they are exact). A stream that is lost is
an error of `poll`, after which `start` looks for it again; jumps of its stamps are mended by `ClockMap`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.core.packages import optional
from rtof_kin.formats.channels import PointChannels, StreamChannels
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample

_CONNECT_S: Final = 3.0  # [s] for the connection, the metadata and the first offset of the clock, each
_SETTLE_S: Final = 0.7
"""[s] after the first answer within which another stream of the name answers too; LSL asks every 0.5 s."""
_POLL_S: Final = 0.005
_BUFFER_S: Final = 60
_MOST_SAMPLES: Final = 4096  # Samples of one call to LSL
_AHEAD_S, _LATE_S = 0.5, 10.0  # [s] after and before now; a first stamp outside is of another clock


def load_pylsl() -> Any:
    """Return the module pylsl. `MissingPackageError`: it is not installed, or its library does not load."""
    return optional("pylsl", "live", "an LSL stream")


class LslSource(ABC):
    """One stream of numbers; `LslImuSource` and `LslFrameSource` know what its channels mean.

    `timeout_s`: s that it has to answer.
    """

    clock = Clock.COMMON  #: The LSL clock of this machine, common to all LSL streams

    def __init__(self, stream: str, timeout_s: float = 5.0):
        self.stream, self.name, self._timeout_s = stream, f"lsl:{stream}", timeout_s
        self.sensors: tuple[str, ...] = ()
        """Names of the inertial sensors; none before `start`."""
        self.landmarks: tuple[str, ...] = ()
        """Names of the points; none before `start`."""
        self.finished = False
        """Whether it was closed; a stream that is lost may come back."""
        self._inlet: Any = None
        self._offset_s, self._shift_s = 0.0, 0.0
        self._first = True  # whether no sample came since it was connected
        self._notices: list[str] = []

    def start(self) -> None:
        """Find the stream and connect, unless that is done; takes about a second. `SourceError`: no stream, or two, of
        the name; no connection; channels that cannot be used, or others than before.
        """
        if self._inlet is not None:
            return
        lsl = load_pylsl()
        resolver = lsl.ContinuousResolver()

        def named() -> list[Any]:
            return [info for info in resolver.results() if info.name() == self.stream]

        if not wait_until(lambda: bool(named()), self._timeout_s):
            others = ", ".join(sorted({info.name() for info in resolver.results()}))
            raise SourceError(
                f"stream {self.stream}: no LSL stream has this name after {self._timeout_s:g} s; "
                + (f"there are {others}" if others else "there is no LSL stream at all; start its sender")
            )
        settled = time.monotonic() + _SETTLE_S
        found = named()[0]
        if found.channel_format() == lsl.cf_string:
            raise SourceError(f"stream {self.stream}: sends text; send channels of numbers")
        inlet = lsl.StreamInlet(found, max_buflen=_BUFFER_S, as_numpy=True)
        try:
            self._read_metadata(inlet.info(_CONNECT_S))
            inlet.open_stream(_CONNECT_S)
            self._correct(inlet, _CONNECT_S)
        except (lsl.util.TimeoutError, lsl.util.LostError) as error:
            raise SourceError(
                f"stream {self.stream}: answers from {found.hostname()}, but no connection opens; check the firewall "
                "there"
            ) from error
        if wait_until(lambda: len(named()) > 1, settled - time.monotonic()):
            inlet.close_stream()
            each = " and ".join(f"source_id {one.source_id() or 'none'} on {one.hostname()}" for one in named())
            raise SourceError(
                f"stream {self.stream}: {len(named())} have this name, {each}; stop or rename all but one"
            )
        self._inlet, self._first, self._shift_s = inlet, True, 0.0

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, without waiting. `SourceError`: the connection is lost; `start`
        finds the stream again.
        """
        if self._inlet is None:
            return []
        lsl = load_pylsl()
        stamps, values = [np.zeros(0)], [np.zeros((0, self._inlet.channel_count))]
        try:
            self._correct(self._inlet)
            while len(stamps) == 1 or len(stamps[-1]) == _MOST_SAMPLES:
                some, at = self._inlet.pull_chunk(0.0, max_samples=_MOST_SAMPLES)
                stamps.append(at)
                values.append(some)
        except lsl.util.LostError as error:
            self._inlet = None
            raise SourceError(f"{self.name}: the connection is lost; start its sender") from error
        times = np.concatenate(stamps) + self._offset_s
        if self._first and np.isfinite(times).any():
            self._first, ahead = False, float(times[np.isfinite(times)][0] - lsl.local_clock())
            if not -_LATE_S <= ahead <= _AHEAD_S:
                self._shift_s = -ahead
                self._note(f"its stamps are {ahead:+.2f} s off the LSL clock; they are shifted to the first arrival")
        return self.samples(times + self._shift_s, np.concatenate(values))

    @abstractmethod
    def read_channels(self, labels: Sequence[str], units: Sequence[str] = (), types: Sequence[str] = ()) -> None:
        """Take what the channels mean, see `rtof_kin.formats.channels`; units and types may be empty.
        `InvalidInputError`: they cannot be used; names stream, channel and remedy.
        """

    @abstractmethod
    def samples(self, times: Array, values: Array) -> list[Sample]:
        """Return the samples of all channels, in the order of times. `times`: (T,) s. `values`: (T, C)."""

    def notices(self) -> list[str]:
        """Return sentences since the last call about its channels and its clock."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Stop; may be called twice."""
        self.finished = True
        if self._inlet is not None:
            self._inlet.close_stream()
            self._inlet = None

    def _read_metadata(self, info: Any) -> None:
        """Read the labels, units and types of the channels; those that a source begins with are kept."""
        channel, rows = info.desc().child("channels").child("channel"), []
        while not channel.empty():
            rows.append([channel.child_value(field) for field in ("label", "unit", "type")])
            channel = channel.next_sibling("channel")
        labels, units, types = zip(*rows, strict=True) if rows else ((), (), ())
        if len(labels) != info.channel_count() or not all(labels):
            raise SourceError(
                f"stream {self.stream}: has {info.channel_count()} channels and labels of {sum(map(bool, labels))}; "
                "label every channel in the metadata, <channels><channel><label>"
            )
        before = (*self.sensors, *self.landmarks)
        try:
            self.read_channels(labels, units, types)
        except InvalidInputError as error:
            raise SourceError(str(error)) from error
        now = (*self.sensors, *self.landmarks)
        if before and now != before:
            raise SourceError(
                f"stream {self.stream}: has {', '.join(now)} and had {', '.join(before)}; start a new session"
            )

    def _correct(self, inlet: Any, wait_s: float = 0.0) -> None:
        """Take the measured offset of the sender's clock; the first measurement may take some seconds."""
        try:
            self._offset_s = float(inlet.time_correction(wait_s))
        except load_pylsl().util.TimeoutError:
            if wait_s:
                self._note("the offset of its clock is not known yet; its stamps are taken as they are")

    def _note(self, sentence: str) -> None:
        self._notices.append(f"{self.name}: {sentence}")


class LslImuSource(LslSource):
    """Inertial sensors of one LSL stream, each with an orientation.

    `renamed`: name of a sensor in the calibration, by its name in the stream.
    """

    def __init__(self, stream: str, timeout_s: float = 5.0, renamed: Callable[[str], str] = str):
        super().__init__(stream, timeout_s)
        self._renamed = renamed

    def read_channels(self, labels: Sequence[str], units: Sequence[str] = (), types: Sequence[str] = ()) -> None:
        """Take what the channels mean; raises `InvalidInputError` also for a sensor without orientation."""
        found = StreamChannels.of(self.stream, labels, units, types)
        for sensor in found.sensors:
            if sensor.quaternions is None:
                raise InvalidInputError(
                    f"stream {self.stream}: sensor {sensor.name} has no quaternion; send qw, qx, qy, qz of its "
                    "orientation filter too"
                )
        none = np.full(3, -1)
        self._declaration = found.declaration
        self._quaternions = np.array([s.quaternions for s in found.sensors])
        self._acceleration = np.array([none if s.acceleration is None else s.acceleration for s in found.sensors])
        self.sensors = tuple(self._renamed(sensor.name) for sensor in found.sensors)
        self._notices += found.notes
        if without := [s.name for s in found.sensors if s.acceleration is None]:
            self._note(f"no acceleration of {', '.join(without)}")

    def samples(self, times: Array, values: Array) -> list[Sample]:
        """Return one sample of each sensor at each time."""
        S = len(self.sensors)
        R = self._declaration.rotations(values[:, self._quaternions].reshape(-1, 4))
        a = np.where(self._acceleration < 0, np.nan, values[:, self._acceleration]).reshape(-1, 3)
        f = self._declaration.specific_force(a, R)
        return [ImuSample(self.sensors[i % S], float(times[i // S]), R[i], f[i]) for i in range(len(times) * S)]


class LslFrameSource(LslSource):
    """Points detected in a video: one LSL stream of channels ``<landmark>_x``, ``_y`` in px, ``_confidence``."""

    def read_channels(self, labels: Sequence[str], units: Sequence[str] = (), types: Sequence[str] = ()) -> None:  # noqa: ARG002
        """Take what the channels mean; raises `InvalidInputError` also where coordinates are not in px."""
        self._channels = PointChannels.of(self.stream, labels, units)
        self.landmarks = self._channels.names

    def samples(self, times: Array, values: Array) -> list[Sample]:
        """Return the frames."""
        uv, confidence = self._channels.points(values)
        return [FrameSample(float(times[i]), uv[i], confidence[i]) for i in range(len(times))]


def wait_until(holds: Callable[[], bool], timeout_s: float) -> bool:
    """Return whether a condition holds within a time, s; it is asked at least once."""
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_S)
    return True
