"""Percentiles of the frame time in constant memory."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

_LEAST: Final = 1e-5  # [s]
_WIDTH: Final = math.log(1.02)
_BINS: Final = 800


class FrameTimes:
    """Counts frame times in bins of 2 % width."""

    def __init__(self) -> None:
        """Begin without any frame."""
        self._counts = np.zeros(_BINS, dtype=np.int64)

    def add(self, seconds: float, frames: int = 1) -> None:
        """Take frames.

        Args:
            seconds: of each.
        """
        place = int(math.log(max(seconds, _LEAST) / _LEAST) / _WIDTH)
        self._counts[min(place, _BINS - 1)] += frames

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self._counts.sum())

    def percentile(self, percent: float) -> float:
        """Return a percentile, s; NaN without frames.

        Args:
            percent: 0 to 100.
        """
        if not self.frames:
            return float("nan")
        place = int(np.searchsorted(np.cumsum(self._counts), percent / 100 * self.frames))
        return _LEAST * math.exp((place + 0.5) * _WIDTH)
