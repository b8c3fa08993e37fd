"""Streams of the Lab Streaming Layer as sources: inertial sensors, or detected points.

Stamps are mapped to the LSL clock of this machine by the measured offset of the clock of the sender. They are
not smoothed: dejittering takes samples to be equally spaced, and where a sender leaves out the 10 % that its
radio lost it moves stamps by up to 0.33 s (measured at 60 Hz; without it they are exact).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.core.packages import optional
from rtof_kin.formats.channels import PointChannels, StreamChannels
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample

_CONNECT_S: Final = 3.0  # [s] for the connection, the metadata and the first offset of the clock, each
_SETTLE_S: Final = 0.7
"""[s] after the first answer within which another stream of the name answers too; LSL asks every 0.5 s."""
_FORGET_S: Final = 1.5  # [s] without an answer after which a stream is gone
_POLL_S: Final = 0.005
_BUFFER_S: Final = 60
_MOST_SAMPLES: Final = 4096  # Samples of one call to LSL
_OFFSET_JUMP_S: Final = 0.02  # [s] that measured offsets do not change by between two measurements, which agree to 1 ms
_AHEAD_S: Final = 0.5  # [s] after now; no sample comes from there
_BACK_S: Final = 1.0  # [s] before the newest sample; senders keep the order of their samples but for less
_LATE_S: Final = 10.0  # [s] of age that a first sample may have
_MOST_REPORTED: Final = 5
_SILENT_S: Final = 0.6  # [s] without a sample after which a stream is reported
_SILENT_PERIODS: Final = 4  # Sampling periods without a sample after which a slow stream is reported


def load_pylsl() -> Any:
    """Return the module pylsl.

    Raises:
        MissingPackageError: it is not installed, or its library does not load.
    """
    return optional("pylsl", "live", "an LSL stream")


# --- channels ------------------------------------------------------------------------------------


class ImuChannels:
    """Inertial sensors of one stream, each with an orientation, see `rtof_kin.formats.channels`.

    `stream`: its name; of the sensor too, where labels name none. `labels`, `units`, `types`: of each channel; units
    and types may be empty. `declared`: fields of `rtof_kin.data.imu_stream.Declaration` that replace what it states.

    Raises:
        SourceError: no sensor, one without orientation, an incomplete quantity, a channel twice, an
            unknown unit; names stream, channel and remedy.
        UnknownNameError: an unknown field or value of the declaration.
    """

    def __init__(
        self,
        stream: str,
        labels: Sequence[str],
        units: Sequence[str] = (),
        types: Sequence[str] = (),
        declared: Mapping[str, Any] | None = None,
    ):
        try:
            channels = StreamChannels.of(stream, labels, units, types, declared)
        except InvalidInputError as error:
            raise SourceError(str(error)) from error
        for sensor in channels.sensors:
            if sensor.quaternions is None:
                raise SourceError(
                    f"stream {stream}: sensor {sensor.name} has no quaternion; send qw, qx, qy, qz of its "
                    "orientation filter too"
                )
        self._stream, self._channels = stream, channels
        self.names = tuple(sensor.name for sensor in channels.sensors)
        none = np.full(3, -1)
        self._acceleration = np.array([none if s.acceleration is None else s.acceleration for s in channels.sensors])
        self._quaternions = np.array([s.quaternions for s in channels.sensors])
        without = [s.name for s in channels.sensors if s.acceleration is None]
        lacks = (f"stream {stream}: no acceleration of {', '.join(without)}",) if without else ()
        self.notes = (*channels.notes, *lacks)

    def samples(self, times: ArrayLike, values: ArrayLike) -> list[Sample]:
        """Return one sample of each sensor at each time, in the order of times.

        `times`: (T,) s. values: (T, C) of all channels.

        Raises:
            SourceError: another number of channels than labels.
        """
        stamps = np.asarray(times, dtype=float)
        numbers = _checked_width(self._stream, values, len(stamps), self._channels.count)
        declaration, S = self._channels.declaration, len(self.names)
        R = declaration.rotations(numbers[:, self._quaternions].reshape(-1, 4))
        a = np.where(self._acceleration < 0, np.nan, numbers[:, self._acceleration]).reshape(-1, 3)
        f = declaration.specific_force(a, R)
        return [ImuSample(self.names[i % S], float(stamps[i // S]), R[i], f[i]) for i in range(len(stamps) * S)]


class FrameChannels:
    """Detected points of one stream: ``<landmark>_x``, ``_y`` in px, ``_confidence``.

    `labels`, `units`: of each channel; units may be empty.

    Raises:
        SourceError: no point, one without x or y, a channel twice, or coordinates that are not in px.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, stream: str, labels: Sequence[str], units: Sequence[str] = ()):
        self._stream = stream
        try:
            self._channels = PointChannels.of(stream, labels, units)
        except InvalidInputError as error:
            raise SourceError(str(error)) from error
        self.names = self._channels.names

    def samples(self, times: ArrayLike, values: ArrayLike) -> list[Sample]:
        """Return the frames; arguments and errors as of `ImuChannels.samples`."""
        stamps = np.asarray(times, dtype=float)
        uv, confidence = self._channels.points(_checked_width(self._stream, values, len(stamps), self._channels.count))
        return [FrameSample(float(stamps[i]), uv[i], confidence[i]) for i in range(len(stamps))]


Channels = ImuChannels | FrameChannels


def _checked_width(stream: str, values: ArrayLike, rows: int, count: int) -> Array:
    """Return the numbers of some samples as an array (T, C); raise SourceError for another shape."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise SourceError(f"stream {stream}: sends something else than {count} numbers ({error})") from error
    if numbers.shape != (rows, count):
        width = numbers.shape[-1] if numbers.ndim == 2 else numbers.size
        raise SourceError(
            f"stream {stream}: {width} numbers in a sample, and labels for {count}; label every channel once"
        )
    return numbers


# --- clock ---------------------------------------------------------------------------------------


class LslClock:
    """Maps the stamps of one sender to the LSL clock of this machine."""

    def __init__(self) -> None:
        self._measured: float | None = None
        self._shift_s = 0.0  # [s] that mends jumps of the stamps
        self._newest: float | None = None
        self._lead_s = -np.inf  # [s] of the newest sample against its arrival, at most so far
        self._jumps = 0

    @property
    def offset_s(self) -> float:
        """What is added to stamps now, s."""
        return (self._measured or 0.0) + self._shift_s

    def corrected_by(self, offset_s: float | None) -> str | None:
        """Take a measured offset of the sender's clock, s, None where there is none yet; say where it jumped."""
        if offset_s is None or offset_s == self._measured:
            return None
        before, self._measured = self._measured, offset_s
        step = offset_s - (before or 0.0)
        if self._shift_s and abs(step - self._shift_s) < _BACK_S:  # the stamps have shown it already
            self._shift_s = 0.0
        if before is None or abs(step) <= _OFFSET_JUMP_S:
            return None
        return self._reported(f"the sender's clock jumped by {-step:+.3f} s against this machine's")

    def times(self, stamps: Array, now: float) -> tuple[Array, str | None]:
        """Return times of samples on this machine's clock, and a sentence where the stamps jumped.

        After a jump they go on from the arrivals, to within the jitter of the network.

        `stamps`: (T,) s of the sender, in the order of arrival. `now`: s of this machine.
        """
        if not np.isfinite(stamps).any():
            return stamps, None
        times = stamps + self.offset_s
        sentence = None
        before = now - _LATE_S if self._newest is None else self._newest
        front = np.fmax.accumulate(np.append(before, times))[:-1]
        wrong = np.flatnonzero((times > now + _AHEAD_S) | (times < front - _BACK_S))
        if len(wrong):
            shift = now - times[np.isfinite(times)][-1]
            if self._newest is None:
                what = f"its stamps are {-shift:+.2f} s off the LSL clock"
            else:
                shift += max(self._lead_s, -_LATE_S)
                what = f"its stamps jumped by {-shift:+.2f} s"
            times[wrong[0] :] += shift
            self._shift_s += shift
            sentence = self._reported(f"{what}; they are shifted by the arrivals of its samples")
        newest = float(np.nanmax(times))
        self._lead_s = max(self._lead_s, newest - now)
        self._newest = newest if self._newest is None else max(self._newest, newest)
        return times, sentence

    def _reported(self, sentence: str) -> str | None:
        self._jumps += 1
        if self._jumps > _MOST_REPORTED:
            return None
        return sentence + (" (further jumps are not reported)" if self._jumps == _MOST_REPORTED else "")


# --- connection ----------------------------------------------------------------------------------


class Inlet:
    """An open connection to one stream of numbers. `info`: `pylsl.StreamInfo` of a resolver.

    Raises:
        SourceError: no connection, or a stream of text.
    """

    def __init__(self, info: Any):
        self._pylsl = load_pylsl()
        stream = info.name()
        if info.channel_format() == self._pylsl.cf_string:
            raise SourceError(f"stream {stream}: sends text; send channels of numbers")
        self._inlet = self._pylsl.StreamInlet(info, max_buflen=_BUFFER_S, as_numpy=True)
        try:
            self._info = self._inlet.info(_CONNECT_S)
            self._inlet.open_stream(_CONNECT_S)
        except (self._pylsl.util.TimeoutError, self._pylsl.util.LostError) as error:
            raise SourceError(
                f"stream {stream}: answers from {info.hostname()}, but no connection opens; check the firewall there"
            ) from error
        self.rate_hz = float(self._info.nominal_srate())
        """Nominal rate, Hz; 0 where irregular."""
        self.count = int(self._info.channel_count())
        """Number of channels."""

    def texts(self, field: str) -> list[str]:
        """Return a field (``label``, ``unit`` or ``type``) of the channels in the metadata; it may lack some."""
        node, found = self._info.desc().child("channels").child("channel"), []
        while not node.empty():
            found.append(node.child_value(field))
            node = node.next_sibling("channel")
        return found

    def labels(self) -> list[str]:
        """Return the labels of all channels.

        Raises:
            SourceError: some have none.
        """
        labels = self.texts("label")
        if len(labels) != self.count or not all(labels):
            raise SourceError(
                f"stream {self._info.name()}: has {self.count} channels and labels of {sum(map(bool, labels))}; "
                "label every channel in the metadata, <channels><channel><label>"
            )
        return labels

    def offset_s(self, wait_s: float = 0.0) -> float | None:
        """Return what is to be added to stamps for this machine's clock, s; None where not known yet.

        `wait_s`: s that the first measurement may take.

        Raises:
            ConnectionError: the stream is lost.
        """
        try:
            return float(self._inlet.time_correction(wait_s))
        except self._pylsl.util.TimeoutError:
            return None
        except self._pylsl.util.LostError as error:
            raise ConnectionError(str(error)) from error

    def pull(self) -> tuple[Array, Array]:
        """Return stamps (T,) and values (T, C) that have arrived, without waiting.

        Raises:
            ConnectionError: the stream is lost.
        """
        stamps, values = [np.zeros(0)], [np.zeros((0, self.count))]
        while len(stamps) == 1 or len(stamps[-1]) == _MOST_SAMPLES:
            try:
                some, at = self._inlet.pull_chunk(0.0, max_samples=_MOST_SAMPLES)
            except self._pylsl.util.LostError as error:
                raise ConnectionError(str(error)) from error
            stamps.append(at)
            values.append(some)
        return np.concatenate(stamps), np.concatenate(values)

    def now(self) -> float:
        """Return the LSL time of this machine, s."""
        return float(self._pylsl.local_clock())

    def close(self) -> None:
        """Close the connection."""
        self._inlet.close_stream()


def find_one(stream: str, timeout_s: float) -> tuple[Inlet, float | None]:
    """Connect to the stream of a name, of which there must be one; measure the offset of the sender's clock, s.

    `timeout_s`: s that it has to answer.

    Raises:
        SourceError: no stream, or two, of the name; no connection; a stream of text.
    """
    resolver = load_pylsl().ContinuousResolver()

    def named() -> list[Any]:
        return [info for info in resolver.results() if info.name() == stream]

    if not wait_until(lambda: bool(named()), timeout_s):
        others = ", ".join(sorted({info.name() for info in resolver.results()}))
        raise SourceError(
            f"stream {stream}: no LSL stream has this name after {timeout_s:g} s; "
            + (f"there are {others}" if others else "there is no LSL stream at all; start its sender")
        )
    settled = time.monotonic() + _SETTLE_S
    inlet = Inlet(named()[0])
    try:
        offset = inlet.offset_s(_CONNECT_S)
    except ConnectionError as error:
        raise SourceError(f"stream {stream}: was lost while it was connected; start its sender") from error
    if wait_until(lambda: len(named()) > 1, settled - time.monotonic()):
        inlet.close()
        each = " and ".join(f"source_id {one.source_id() or 'none'} on {one.hostname()}" for one in named())
        raise SourceError(f"stream {stream}: {len(named())} have this name, {each}; stop or rename all but one")
    return inlet, offset


def find_again(stream: str, stop: Callable[[], bool]) -> Inlet | None:
    """Wait until a lost stream is there again, and connect; None where `stop` returned True before."""
    resolver = load_pylsl().ContinuousResolver("name", stream, forget_after=_FORGET_S)
    while not stop():
        if wait_until(lambda: stop() or bool(resolver.results()), _CONNECT_S) and not stop():
            try:
                return Inlet(resolver.results()[0])
            except (SourceError, IndexError):  # it went again meanwhile
                continue
    return None


def wait_until(holds: Callable[[], bool], timeout_s: float) -> bool:
    """Return whether a condition holds within a time, s; it is asked at least once."""
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_S)
    return True


# --- sources -------------------------------------------------------------------------------------


class LslSource:
    """One stream; `LslImuSource` and `LslFrameSource` know what its channels mean.

    `timeout_s`: s that it has to answer. `changed`: what is said of a stream that came back with other names, by the
    new and the earlier ones.
    """

    clock = Clock.COMMON  #: The LSL clock of this machine, common to all LSL streams

    def __init__(self, stream: str, timeout_s: float, read: Callable[[Inlet], Channels], changed: str):
        self.stream, self.name = stream, f"lsl:{stream}"
        self._timeout_s, self._read, self._changed = timeout_s, read, changed
        self._inlet: Inlet | None = None
        self._channels: Channels | None = None
        self._clock = LslClock()
        self._notices: list[str] = []
        self.finished = False
        """Whether it was closed; a stream that is lost may come back."""
        self._last_arrival = 0.0
        self._silent = False
        self._search: threading.Thread | None = None
        self._found: Inlet | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the inertial sensors; none before `start`."""
        return self._channels.names if isinstance(self._channels, ImuChannels) else ()

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points; none before `start`."""
        return self._channels.names if isinstance(self._channels, FrameChannels) else ()

    @property
    def clock_offset_s(self) -> float:
        """What is added to the sender's stamps now, s; 0 before it was measured."""
        return self._clock.offset_s

    def start(self) -> None:
        """Find the stream and connect, unless that is done; takes about a second.

        Raises:
            SourceError: no stream, or two, of the name; no connection; channels that cannot be used.
        """
        if self._inlet is not None:
            return
        inlet, offset = find_one(self.stream, self._timeout_s)
        for remark in self._understood(inlet).notes:
            self._note(remark)
        if offset is None:
            self._note("the offset of its clock is not known yet; its stamps are taken as they are")
        self._clock.corrected_by(offset)
        self._inlet, self._last_arrival = inlet, time.monotonic()

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, without waiting."""
        inlet = self._inlet or self._found_again()
        if inlet is None or self._channels is None:
            return []
        try:
            self._note(self._clock.corrected_by(inlet.offset_s()))
            stamps, values = inlet.pull()
        except ConnectionError:
            self._note("the connection is lost; it goes on as soon as the stream comes back")
            self._inlet, self._silent = None, True
            self._search = threading.Thread(target=self._find_again, name=self.name, daemon=True)
            self._search.start()
            return []
        self._watch(inlet, len(stamps))
        if len(stamps) == 0:
            return []
        times, jump = self._clock.times(stamps, inlet.now())
        self._note(jump)
        known = np.isfinite(times)
        if not known.all():
            self._note(f"{int(np.sum(~known))} samples without a time are left out")
        return self._channels.samples(times[known], values[known])

    def notices(self) -> list[str]:
        """Return sentences since the last call about losses, returns and jumps of the clock."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Stop; may be called twice."""
        self.finished = True
        if self._search is not None:
            self._search.join()
        for inlet in (self._inlet, self._found):
            if inlet is not None:
                inlet.close()
        self._inlet = self._found = None

    def _understood(self, inlet: Inlet) -> Channels:
        """Take the channels of the stream; raise SourceError where they cannot be used or are others than before."""
        channels = self._read(inlet)
        if self._channels is not None and channels.names != self._channels.names:
            now, before = (", ".join(each.names) for each in (channels, self._channels))
            raise SourceError(f"stream {self.stream}: {self._changed.format(now=now, before=before)}; start anew")
        self._channels = channels
        return channels

    def _watch(self, inlet: Inlet, arrived: int) -> None:
        """Note that nothing arrives any more, and that it does again."""
        now = time.monotonic()
        silence = now - self._last_arrival
        if arrived:
            if self._silent:
                self._note(f"is back after {silence:.1f} s")
            self._last_arrival, self._silent = now, False
            return
        slow = _SILENT_PERIODS / inlet.rate_hz if inlet.rate_hz > 0 else 0.0
        if not self._silent and silence > max(_SILENT_S, slow):
            self._silent = True
            self._note(f"gives nothing since {silence:.1f} s; it goes on as soon as samples come")

    def _find_again(self) -> None:
        self._found = find_again(self.stream, lambda: self.finished)

    def _found_again(self) -> Inlet | None:
        """Return the new connection to a lost stream, once there is one that can be used."""
        inlet, self._found = self._found, None
        if inlet is None:
            return None
        try:
            self._understood(inlet)
        except SourceError as error:
            self._note(f"came back, but cannot be used: {error}")
            self.close()
            return None
        self._inlet = inlet
        return inlet

    def _note(self, sentence: str | None) -> None:
        if sentence:
            self._notices.append(f"{self.name}: {sentence}")


class LslImuSource(LslSource):
    """Inertial sensors of one LSL stream; its channels are labelled as in `rtof_kin.formats.channels`.

    `timeout_s`: s that it has to answer. `declared`: fields of `rtof_kin.data.imu_stream.Declaration` that replace what
    it states.
    """

    def __init__(self, stream: str, declared: Mapping[str, Any] | None = None, timeout_s: float = 5.0):
        def read(inlet: Inlet) -> Channels:
            return ImuChannels(stream, inlet.labels(), inlet.texts("unit"), inlet.texts("type"), declared)

        super().__init__(stream, timeout_s, read, "has the sensors {now} and had {before}")


class LslFrameSource(LslSource):
    """Points detected in a video: one LSL stream of channels ``<landmark>_x``, ``_y``, ``_confidence``."""

    def __init__(self, stream: str, timeout_s: float = 5.0):
        def read(inlet: Inlet) -> Channels:
            return FrameChannels(stream, inlet.labels(), inlet.texts("unit"))

        super().__init__(stream, timeout_s, read, "has other points than before")
