"""Streams of the Lab Streaming Layer as sources: inertial sensors, or detected points.

Stamps are mapped to the LSL clock of this machine by the measured offset of the clock of the sender. They are
not smoothed: dejittering takes samples to be equally spaced, and where a sender leaves out the 10 % that its
radio lost it moves stamps by up to 0.33 s (measured at 60 Hz; without it they are exact).
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SourceError
from rtof_kin.live.samples import Clock, Sample
from rtof_kin.live.sources.channels import FrameChannels, ImuChannels
from rtof_kin.live.sources.lsl_clock import LslClock
from rtof_kin.live.sources.lsl_inlet import Inlet, find_again, find_one

_SILENT_S: Final = 0.6
"""[s] without a sample after which a stream is reported."""
_SILENT_PERIODS: Final = 4
"""Sampling periods without a sample after which a slow stream is reported."""


class _LslSource(ABC):
    """One stream; subclasses know what its channels mean."""

    def __init__(self, stream: str, timeout_s: float):
        self.stream = stream
        self._timeout_s = timeout_s
        self._inlet: Inlet | None = None
        self._clock = LslClock()
        self._notices: list[str] = []
        self._finished = False
        self._last_arrival = 0.0
        self._silent = False
        self._search: threading.Thread | None = None
        self._found: Inlet | None = None

    @abstractmethod
    def _understand(self, inlet: Inlet) -> tuple[str, ...]:
        """Take the channels of the stream and return remarks; raises SourceError."""

    @abstractmethod
    def _samples(self, times: Array, values: Array) -> list[Sample]:
        """Samples of rows of channels."""

    @property
    def name(self) -> str:
        """``lsl:NAME``."""
        return f"lsl:{self.stream}"

    @property
    def clock(self) -> Clock:
        """The LSL clock of this machine, common to all LSL streams."""
        return Clock.COMMON

    @property
    def clock_offset_s(self) -> float:
        """What is added to the sender's stamps now, s; 0 before it was measured."""
        return self._clock.offset_s

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the inertial sensors; none before `start`."""
        return ()

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points; none before `start`."""
        return ()

    @property
    def finished(self) -> bool:
        """Whether it was closed; a stream that is lost may come back."""
        return self._finished

    def start(self) -> None:
        """Find the stream and connect, unless that is done; takes about a second.

        Raises:
            SourceError: no stream, or two, of the name; no connection; channels that cannot be used.
        """
        if self._inlet is not None:
            return
        inlet, offset = find_one(self.stream, self._timeout_s)
        for remark in self._understand(inlet):
            self._note(remark)
        if offset is None:
            self._note("the offset of its clock is not known yet; its stamps are taken as they are")
        self._clock.corrected_by(offset)
        self._inlet, self._last_arrival = inlet, time.monotonic()

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, without waiting."""
        inlet = self._inlet or self._found_again()
        if inlet is None:
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
        return self._samples(times[known], values[known])

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
        self._found = find_again(self.stream, lambda: self._finished)

    def _found_again(self) -> Inlet | None:
        """Return the new connection to a lost stream, once there is one that can be used."""
        inlet, self._found = self._found, None
        if inlet is None:
            return None
        try:
            self._understand(inlet)
        except SourceError as error:
            self._note(f"came back, but cannot be used: {error}")
            self.close()
            return None
        self._inlet = inlet
        return inlet

    def _note(self, sentence: str | None) -> None:
        if sentence:
            self._notices.append(f"{self.name}: {sentence}")

    def notices(self) -> list[str]:
        """Return sentences since the last call about losses, returns and jumps of the clock."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Stop; may be called twice."""
        self._finished = True
        if self._search is not None:
            self._search.join()
        for inlet in (self._inlet, self._found):
            if inlet is not None:
                inlet.close()
        self._inlet = self._found = None


class LslImuSource(_LslSource):
    """Inertial sensors of one LSL stream; its channels are labelled as in `rtof_kin.formats.channels`."""

    def __init__(self, stream: str, declared: Mapping[str, Any] | None = None, timeout_s: float = 5.0):
        """Take the name of the stream.

        Args:
            timeout_s: s that it has to answer.
            declared: fields of `rtof_kin.data.imu_stream.Declaration` that replace what it states.
        """
        super().__init__(stream, timeout_s)
        self._declared = declared
        self._channels: ImuChannels | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the inertial sensors; none before `start`."""
        return () if self._channels is None else self._channels.sensors

    def _understand(self, inlet: Inlet) -> tuple[str, ...]:
        labels = _labels(self.stream, inlet)
        units, types = inlet.texts("unit"), inlet.texts("type")
        channels = ImuChannels.of(self.stream, labels, units, types, self._declared)
        if self._channels is not None and channels.sensors != self._channels.sensors:
            raise SourceError(
                f"stream {self.stream}: has the sensors {', '.join(channels.sensors)} and had "
                f"{', '.join(self._channels.sensors)}; start anew"
            )
        self._channels = channels
        return channels.notes

    def _samples(self, times: Array, values: Array) -> list[Sample]:
        return [] if self._channels is None else [*self._channels.samples(times, values)]


class LslFrameSource(_LslSource):
    """Points detected in a video: one LSL stream of channels ``<landmark>_x``, ``_y``, ``_confidence``."""

    def __init__(self, stream: str, timeout_s: float = 5.0):
        """Take the name of the stream.

        Args:
            timeout_s: s that it has to answer.
        """
        super().__init__(stream, timeout_s)
        self._channels: FrameChannels | None = None

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points; none before `start`."""
        return () if self._channels is None else self._channels.landmarks

    def _understand(self, inlet: Inlet) -> tuple[str, ...]:
        channels = FrameChannels.of(self.stream, _labels(self.stream, inlet), inlet.texts("unit"))
        if self._channels is not None and channels.landmarks != self._channels.landmarks:
            raise SourceError(f"stream {self.stream}: has other points than before; start anew")
        self._channels = channels
        return ()

    def _samples(self, times: Array, values: Array) -> list[Sample]:
        return [] if self._channels is None else [*self._channels.samples(times, values)]


def _labels(stream: str, inlet: Inlet) -> list[str]:
    """Return the labels of all channels; raises SourceError where some have none."""
    labels = inlet.texts("label")
    if len(labels) != inlet.count or not all(labels):
        named = sum(map(bool, labels))
        raise SourceError(
            f"stream {stream}: has {inlet.count} channels and labels of {named}; label every channel in the "
            "metadata, <channels><channel><label>"
        )
    return labels
