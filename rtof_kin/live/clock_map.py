"""Clocks of live streams on one session clock: `ClockMap` of a source, `SessionClock` of all of them.

The session's clock is that of the sources with a common clock. Arrivals tell how it relates to the clock of
this machine, and so to clocks of their own; without a source of the common clock it is this machine's.
No clock is read here: arrivals are arguments.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from rtof_kin.live.samples import Clock, FrameSample, Sample

VIDEO: Final = "video"  #: Name of the stream of frames, beside the sensors' names
_WINDOW, _BIN = 10.0, 0.5  # [s] over which the earliest arrival counts, and its resolution
_SETTLING, _FOLLOWING = 2.0, 2.0  # [s] in which the offset moves at once; time constant afterwards
_SAME_CLOCK = 0.03  # [s] streams of one source whose offsets agree so well have one clock
_LEAP = 0.5  # [s]
_CONFIRMED, _AT_LEAST, _MANY = 3, 0.03, 10  # samples in a row, [s] that they span, or so many samples
_GATHERED = 0.25  # [s] in which streams that leap together are told in one sentence
_FAST, _FAST_START = 1.5, 0.3  # [-], [s] advance of stamps against arrivals in an accelerated replay
_WAIT = 2.0  # [s] for the common clock before this machine's clock is taken


@dataclass(frozen=True, slots=True)
class Arrived:
    """A sample with what the session knows about its time."""

    source: str  #: Name of its source
    sample: Sample  #: As it came, on the clock of its source
    arrival: float  #: [s] on this machine's clock
    time: float  #: [s] on the session's clock; NaN if the sample is left out

    @property
    def stream(self) -> str:
        """Name of the sensor, or `VIDEO`."""
        return stream_of(self.sample)


def stream_of(sample: Sample) -> str:
    """Return the name of the sensor, or `VIDEO`. `sample`: of any stream."""
    return VIDEO if isinstance(sample, FrameSample) else sample.sensor


class _Offset:
    """Arrival less stamp of the earliest arrivals: jitter does not move it, drift is followed slowly."""

    def __init__(self) -> None:
        self._bins: deque[list[float]] = deque(maxlen=round(_WINDOW / _BIN))
        self._since, self._last = math.nan, math.nan
        self.lowest, self.applied = math.nan, math.nan

    def update(self, difference: float, arrival: float) -> None:
        """Take arrival less stamp, s, of a sample."""
        start = arrival // _BIN
        if self._bins and self._bins[-1][0] == start:
            self._bins[-1][1] = min(self._bins[-1][1], difference)
            self.lowest = min(self.lowest, difference)
        else:
            while self._bins and self._bins[0][0] < start - _WINDOW / _BIN:
                self._bins.popleft()
            self._bins.append([start, difference])
            self.lowest = min(value for _, value in self._bins)
        if math.isnan(self._since):
            self._since = arrival
        if arrival - self._since < _SETTLING:
            self.applied = self.lowest
        else:
            share = 1 - math.exp(-max(arrival - self._last, 0.0) / _FOLLOWING)
            self.applied += share * (self.lowest - self.applied)
        self._last = arrival


class _Track:
    """Time stamps of one stream since its clock's last jump."""

    def __init__(self, shift: float = 0.0):
        self.shift = shift
        self.offset = _Offset()
        self.first, self.newest = (math.nan, math.nan), (math.nan, math.nan)  # stamp and arrival
        self.suspects: list[tuple[float, float]] = []

    def accept(self, stamp: float, arrival: float) -> None:
        self.suspects.clear()
        self.offset.update(arrival - stamp, arrival)
        if math.isnan(self.first[0]):
            self.first = (stamp, arrival)
        if not stamp <= self.newest[0]:
            self.newest = (stamp, arrival)

    def speed(self) -> float:
        """Return by how much a replay is accelerated; infinite where all comes at once."""
        stamps, arrivals = (b - a for a, b in zip(self.first, self.newest, strict=True))
        if stamps < _FAST * arrivals + _FAST_START:
            return 1.0
        return stamps / arrivals if arrivals > _LEAP else float("inf")

    def leap(self, stamp: float, arrival: float, speed: float) -> float:
        """Return by how many seconds the stamp is off the stream's line; 0 where it is on it."""
        if math.isnan(self.newest[0]):
            return 0.0
        advance = stamp - self.newest[0]
        passed = arrival - self.newest[1]
        ahead = advance - speed * passed if passed > 0 or math.isfinite(speed) else 0.0
        back = advance < -_LEAP
        forth = ahead > _LEAP and stamp + self.offset.lowest - arrival > _LEAP
        return advance - passed if back else ahead if forth else 0.0

    def suspect(self, stamp: float, arrival: float) -> bool:
        """Keep a stamp that is off the line, and return whether the stamps before say the same."""
        if self.suspects:
            start, came = self.suspects[0]
            if abs((stamp - start) - (arrival - came)) > _LEAP:
                self.suspects.clear()
        self.suspects.append((stamp, arrival))
        several = len(self.suspects) >= _CONFIRMED
        return several and (arrival - self.suspects[0][1] >= _AT_LEAST or len(self.suspects) >= _MANY)


class ClockMap:
    """Maps the time stamps of one source to the common clock, or a clock of its own to this machine's.

    A clock of its own is mapped by the earliest arrivals of the last ten seconds. Streams of one source whose offsets
    agree within 30 ms are taken to have one clock. Where stamps go back or leap by more than half a second against
    arrivals, and go on from there, the map begins anew; those in between and single stamps off the line are left out.
    """

    def __init__(self, source: str, clock: Clock = Clock.OWN):
        self.source, self.clock = source, clock
        self._tracks: dict[str, _Track] = {}
        self._jumped: dict[str, tuple[float, float]] = {}  # by stream: its leap and when it was noticed

    def time(self, stream: str, stamp: float, arrival: float) -> float:
        """Return the time of a sample, s; NaN if it is left out.

        `stream`: name of its sensor, or `VIDEO`. `stamp`: s on the source's clock. `arrival`: s on this machine's
        clock; does not go back.
        """
        track = self._tracks.setdefault(stream, _Track())
        speed = track.speed() if self.clock is Clock.COMMON else 1.0
        leap = track.leap(stamp, arrival, speed) if math.isfinite(stamp) else math.nan
        if leap != 0:
            if math.isnan(leap) or not track.suspect(stamp, arrival):
                return float("nan")
            track = self._begin_anew(stream, track, leap, arrival)
        track.accept(stamp, arrival)
        if self.clock is Clock.COMMON:
            return stamp + track.shift
        mine = track.offset.applied
        same = (other.offset.applied for other in self._tracks.values())
        return stamp + min(value for value in same if abs(value - mine) <= _SAME_CLOCK)

    @property
    def started(self) -> bool:
        """Whether a sample has come."""
        return bool(self._tracks)

    def notices(self, arrival: float) -> list[str]:
        """Return sentences about jumps since the last call; streams that leap together share one.

        `arrival`: now, s on this machine's clock.
        """
        if not self._jumped or arrival - min(at for _, at in self._jumped.values()) < _GATHERED:
            return []
        jumped, self._jumped = self._jumped, {}
        leaps = [leap for leap, _ in jumped.values()]
        least, most = min(leaps), max(leaps)
        size = f"{least:+.1f} s" if most - least < _LEAP else f"{least:+.1f} to {most:+.1f} s"
        names = ", ".join(jumped)
        return [f"{self.source}: the clock of {names} jumped by {size}; its time is mapped anew from there"]

    def _begin_anew(self, stream: str, old: _Track, leap: float, arrival: float) -> _Track:
        shift = old.shift - leap
        for other in self._tracks.values():  # streams of one source keep their times to each other
            if other is not old and other.shift != 0 and abs(other.shift - shift) < 2 * _LEAP / 5:
                shift = other.shift
        self._tracks[stream] = track = _Track(shift)
        self._jumped.setdefault(stream, (leap, arrival))
        return track


class SessionClock:
    """Puts the samples of all sources on one clock."""

    def __init__(self, clocks: Mapping[str, Clock]):
        """Begin without any sample. `clocks`: clock of each source, by its name."""
        self._maps = {name: ClockMap(name, clock) for name, clock in clocks.items()}
        self._base: _Offset | None = _Offset() if Clock.COMMON in clocks.values() else None
        self._first_arrival = math.nan

    def arrived(self, source: str, sample: Sample, arrival: float) -> Arrived:
        """Return a sample with its time. `sample`: on that source's clock. `arrival`: s on this machine's clock."""
        if math.isnan(self._first_arrival):
            self._first_arrival = arrival
        self._settle(source, sample.time, arrival)
        clock_map = self._maps[source]
        time = clock_map.time(stream_of(sample), sample.time, arrival)
        if clock_map.clock is Clock.COMMON:
            if self._base is not None and math.isfinite(time):
                self._base.update(arrival - time, arrival)
        else:
            time -= 0.0 if self._base is None else self._base.applied  # NaN while that is not known
        return Arrived(source, sample, arrival, float(time))

    def notices(self, arrival: float) -> list[str]:
        """Return sentences about jumps of clocks since the last call. `arrival`: now, s on this machine's clock."""
        return [text for clock_map in self._maps.values() for text in clock_map.notices(arrival)]

    def _settle(self, source: str, stamp: float, arrival: float) -> None:
        """Take this machine's clock if nothing came on the common one, which then is one of its own."""
        waiting = self._base is not None and math.isnan(self._base.applied)
        clock_map = self._maps[source]
        if waiting and clock_map.clock is Clock.OWN and arrival - self._first_arrival > _WAIT:
            self._base = None
        if self._base is not None or clock_map.clock is Clock.OWN or clock_map.started:
            return
        if not abs(arrival - stamp) <= _LEAP:
            self._maps[source] = ClockMap(source, Clock.OWN)
