"""Times of LSL stamps on this machine's clock, and the jumps of a sender's clock."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array

_OFFSET_JUMP_S: Final = 0.02
"""[s] that measured offsets do not change by between two measurements, which agree to 1 ms."""
_AHEAD_S: Final = 0.5
"""[s] after now; no sample comes from there."""
_BACK_S: Final = 1.0
"""[s] before the newest sample; senders keep the order of their samples but for less."""
_LATE_S: Final = 10.0
"""[s] of age that a first sample may have."""
_MOST_REPORTED: Final = 5


class LslClock:
    """Maps the stamps of one sender to the LSL clock of this machine."""

    def __init__(self) -> None:
        """Begin without a measured offset."""
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
        """Take a measured offset of the sender's clock.

        Args:
            offset_s: s; None where there is none yet.

        Returns:
            A sentence where it jumped.
        """
        if offset_s is None or offset_s == self._measured:
            return None
        before, self._measured = self._measured, offset_s
        step = offset_s - (before or 0.0)
        if self._shift_s and abs(step - self._shift_s) < _BACK_S:  # the stamps have shown it already
            self._shift_s = 0.0
        if before is None or abs(step) <= _OFFSET_JUMP_S:
            return None
        return self._told(f"the sender's clock jumped by {-step:+.3f} s against this machine's")

    def times(self, stamps: Array, now: float) -> tuple[Array, str | None]:
        """Return times of samples on this machine's clock, and a sentence where the stamps jumped.

        After a jump they go on from the arrivals, to within the jitter of the network.

        Args:
            stamps: (T,) s of the sender, in the order of arrival. now: s of this machine.
        """
        if not np.isfinite(stamps).any():
            return stamps, None
        times = stamps + self.offset_s
        sentence = None
        jump = self._jump(times, now)
        if jump is not None:
            shift = now + max(self._lead_s, -_LATE_S) - times[np.isfinite(times)][-1]
            if self._newest is None:
                shift = now - times[np.isfinite(times)][-1]
                what = f"its stamps are {-shift:+.2f} s off the LSL clock"
            else:
                what = f"its stamps jumped by {-shift:+.2f} s"
            times[jump:] += shift
            self._shift_s += shift
            sentence = self._told(f"{what}; they are shifted by the arrivals of its samples")
        newest = float(np.nanmax(times))
        self._lead_s = max(self._lead_s, newest - now)
        self._newest = newest if self._newest is None else max(self._newest, newest)
        return times, sentence

    def _jump(self, times: Array, now: float) -> int | None:
        """Return the first sample after a jump of the stamps; None without one."""
        before = now - _LATE_S if self._newest is None else self._newest
        newest = np.fmax.accumulate(np.append(before, times))[:-1]
        wrong = np.flatnonzero((times > now + _AHEAD_S) | (times < newest - _BACK_S))
        return int(wrong[0]) if len(wrong) else None

    def _told(self, sentence: str) -> str | None:
        self._jumps += 1
        if self._jumps > _MOST_REPORTED:
            return None
        return sentence + (" (further jumps are not reported)" if self._jumps == _MOST_REPORTED else "")
