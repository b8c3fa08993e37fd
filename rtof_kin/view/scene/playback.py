"""`Playback`: which time of a motion is shown at which time of the clock."""

from __future__ import annotations

import threading
from typing import Final

SPEEDS: Final = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
"""Speeds relative to real time, by label."""


class Playback:
    """Position, speed and pause of a motion; may be used by several threads."""

    def __init__(self, start: float, stop: float):
        """Pause at the start.

        Args:
            start, stop: times of the first and the last frame, s.
        """
        self.start, self.stop = start, stop
        self.repeat = True
        self._lock = threading.Lock()
        self._speed, self._playing = 1.0, False
        self._time, self._since = start, 0.0

    @property
    def playing(self) -> bool:
        """Whether the time moves on."""
        return self._playing

    def at(self, now: float) -> float:
        """Return the time to show, s; playing ends at the last frame, or begins again.

        Args:
            now: of a monotonic clock, s.
        """
        with self._lock:
            if not self._playing:
                return self._time
            time = self._time + (now - self._since) * self._speed
            if time > self.stop:
                self._time, self._since = (self.start if self.repeat else self.stop), now
                self._playing = self.repeat and self.stop > self.start
                return self._time
            return time

    def play(self, now: float, playing: bool = True) -> None:
        """Go on, from the start if at the end, or pause.

        Args:
            now: of the clock, s. playing: False to pause.
        """
        time = self.at(now)
        with self._lock:
            if playing and time >= self.stop:
                time = self.start
            self._time, self._since, self._playing = time, now, playing

    def seek(self, time: float, now: float) -> None:
        """Go to a time, without pausing.

        Args:
            time: s; limited to those of the motion. now: of the clock, s.
        """
        with self._lock:
            self._time, self._since = min(max(time, self.start), self.stop), now

    def set_speed(self, speed: float, now: float) -> None:
        """Change the speed.

        Args:
            now: of the clock, s.
        """
        time = self.at(now)
        with self._lock:
            self._time, self._since, self._speed = time, now, speed
