"""One sensor of a UDP port: who sends it, which quaternion belongs to which acceleration, its clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from rtof_kin.live.sources.datagrams import Reading, Remark

_PAIR_WITHIN_S: Final = 0.05
"""A quaternion and an acceleration of different datagrams belong together if they arrive within this."""
_ALONE: Final = 10
"""Successive readings without the other part, after which the other part is no longer waited for."""
_SILENT_S: Final = 1.0
"""A second sender may take over after this silence of the first."""
_MOST_SENDERS: Final = 1000
"""Addresses of senders that are remembered."""
_CLOCK_SAMPLES: Final = 20
"""Readings whose earliest arrival gives the offset of the clock."""
_SAME_CLOCK_S: Final = 0.25
"""Largest difference of the offsets of two sensors of one clock."""
_JUMP_S: Final = 1.0
"""Change of the offset from which a clock is said to jump; less is a late arrival."""


class UdpSensor:
    """State of one sensor."""

    def __init__(self, name: str):
        """Take its name."""
        self.name = name
        self._sender: Any = None
        self._heard = 0.0
        self._senders: set[Any] = set()
        self._rivals: set[Any] = set()
        self._part: tuple[Reading, float] | None = None
        self._alone = 0
        self._last: float | None = None
        self._offset: float | None = None
        self._samples = 0
        self._compared = False

    # --- who sends -------------------------------------------------------------------------------

    def of_another(self, sender: Any, now: float) -> Remark | None:
        """Return a remark if a second sender uses the name of this sensor at the same time.

        A program that sends each datagram from a new port is one sender: none of its ports comes again.

        Args:
            sender: address of the datagram. now: its arrival, s.
        """
        silent = now - self._heard > _SILENT_S
        if sender in self._rivals and not silent:
            problem = "comes from two senders, of which the first is used; give every sensor its own name"
            return Remark(self.name, "two senders", problem)
        if sender != self._sender:
            if silent or len(self._senders) > _MOST_SENDERS:
                self._senders.clear()
                self._rivals.clear()
            if sender in self._senders:  # the one before sends again
                self._rivals.add(self._sender)
            self._senders.add(sender)
            self._sender = sender
        self._heard = now
        return None

    # --- quaternion and acceleration -------------------------------------------------------------

    def paired(self, reading: Reading, now: float) -> list[tuple[Reading, float]]:
        """Return the readings that are complete, or will not become so, with their arrivals.

        Args:
            reading: the next one. now: its arrival, s.
        """
        if reading.quaternion is not None and reading.acceleration is not None:
            self._alone = 0
            return [*self._unpaired(), (reading, now)]
        if self._part is not None:
            other, arrival = self._part
            complement = (other.quaternion is None) != (reading.quaternion is None)
            if complement and self._together(other, arrival, reading, now):
                self._part, self._alone = None, 0
                whole = replace(
                    other,
                    quaternion=other.quaternion or reading.quaternion,
                    acceleration=other.acceleration or reading.acceleration,
                )
                return [(whole, arrival)]
        before = self._unpaired()
        if self._alone >= _ALONE:
            self._alone += 1
            return [*before, (reading, now)]
        self._part = (reading, now)
        return before

    def overdue(self, now: float) -> list[tuple[Reading, float]]:
        """Return a reading that has waited too long for its other part.

        Args:
            now: s.
        """
        waits = self._part is not None and now - self._part[1] > _PAIR_WITHIN_S
        return self._unpaired() if waits else []

    def _unpaired(self) -> list[tuple[Reading, float]]:
        part, self._part = self._part, None
        if part is None:
            return []
        self._alone += 1
        return [part]

    @staticmethod
    def _together(first: Reading, first_at: float, second: Reading, second_at: float) -> bool:
        if first.time is not None or second.time is not None:
            return first.time == second.time
        return second_at - first_at <= _PAIR_WITHIN_S

    # --- time ------------------------------------------------------------------------------------

    def stamped(self, reading: Reading, arrival: float) -> tuple[float | None, list[Remark]]:
        """Return the time of a reading, s, and remarks about it; None if it has to be left out.

        Args:
            reading: the next whole one. arrival: s.
        """
        remarks = []
        if reading.time is None:
            problem = "sends no time; times of arrival are used, which jitter with the network"
            remarks.append(Remark(self.name, "no time", problem, left_out=False))
        stamp = arrival if reading.time is None else reading.time
        if stamp == self._last:
            problem = "two readings have one time; send each once, with its time as 64-bit float"
            return None, [*remarks, Remark(self.name, "repeated time", problem)]
        self._last = stamp
        offset = arrival - stamp
        if self._offset is not None and abs(offset - self._offset) > _JUMP_S:
            problem = f"its clock jumped by {self._offset - offset:+.3g} s against arrival"
            remarks.append(Remark(self.name, "clock", problem, left_out=False))
            self._offset, self._samples, self._compared = None, 0, False
        self._offset = offset if self._offset is None else min(offset, self._offset)
        self._samples += 1
        return stamp, remarks

    @property
    def clock_known(self) -> bool:
        """Whether enough readings came to know the offset of the clock."""
        return self._samples >= _CLOCK_SAMPLES

    def compared(self, other: UdpSensor) -> list[Remark]:
        """Return, once, whether the clock differs from that of another sensor.

        Args:
            other: whose clock is known.
        """
        if other is self or self._compared or not self.clock_known:
            return []
        assert self._offset is not None
        assert other._offset is not None
        self._compared = True
        difference = other._offset - self._offset
        if abs(difference) <= _SAME_CLOCK_S:
            return []
        problem = (
            f"its clock is {difference:+.3g} s from that of {other.name}; one port has one clock: send it to "
            "a port of its own, or synchronise the devices"
        )
        return [Remark(self.name, "clock of another", problem, left_out=False)]
