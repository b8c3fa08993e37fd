"""`ReplayClock`: the time that replayed streams have reached together."""

from __future__ import annotations

import threading
import time as system
from collections.abc import Callable
from typing import Final

import numpy as np

from rtof_kin.core.errors import InvalidInputError, SourceError

_STEP: Final = 1 / 60
_LONGEST_WAIT: Final = 0.05
"""[s] after which a thread that waits looks whether it should stop."""


class ReplayClock:
    """Time that all replays of a session have reached.

    Args:
        speed: times real time; inf: every round of polls is one step later, however long it took.
        step: that of a round, s. now: seconds of the system.

    Raises:
        InvalidInputError: the speed or the step is not positive.
    """

    def __init__(self, speed: float = 1.0, step: float = _STEP, now: Callable[[], float] = system.monotonic) -> None:
        if not speed > 0:
            raise InvalidInputError(f"speed of a replay: {speed:g} is not positive")
        if not 0 < step < np.inf:
            raise InvalidInputError(f"step of a replay: {step:g} s is not positive")
        self._speed, self._step, self._system = speed, step, now
        self._spans: dict[str, tuple[float, float]] = {}
        self._begun: float | None = None
        self._round, self._read = 0, set[int]()
        self._lock = threading.Lock()

    @property
    def speed(self) -> float:
        """Times real time."""
        return self._speed

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
            return self.first + self._round * self._step

    def cover(self, name: str, first: float, last: float) -> None:
        """Take part: the replay begins at the earliest time of all sources.

        Args:
            first, last: its times, s.

        Raises:
            SourceError: no time is common with another source, so their clocks differ.
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

        Args:
            reader: the source that asks. Without pace, its second question begins a new round.
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
            return self.first + self._round * self._step

    def _paced(self, begun: float) -> float:
        return self.first + self._speed * (self._system() - begun)

    def age(self, time: float) -> float:
        """Return how long ago a time was reached, in seconds of the system; 0 without pace.

        Args:
            time: s.
        """
        if not self.paced or self._begun is None:
            return 0.0
        return max(self._paced(self._begun) - time, 0.0) / self._speed

    def wait(self, until: float, stop: threading.Event) -> bool:
        """Wait for a time; return False where `stop` was set before.

        Args:
            until: s; without pace there is nothing to wait for.
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
