"""Rate, losses and lateness of one live stream over its last second."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

_SPAN: Final = 1.0  # [s] that is judged
_OUT_OF_ORDER: Final = 0.1  # [s] for which a missing sample may still come
_FEWEST, _SHORTEST = 8, 0.4  # samples, [s]
_EVEN, _MOSTLY_EVEN = 0.25, 0.8  # [periods] deviation of a step from whole ones; share of such steps
_HALVES = 0.1  # [-] share of steps of a part of the median that make this part the period
_CLEARLY, _ADAPTING = 0.75, 0.05  # [-] of the usual rate of a stream without a period; followed each time
_MOST: Final = 1024


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of a stream over its last second; 0 before there are any."""

    rate_hz: float = 0.0
    """Samples per second that came."""
    period: float = 0.0
    """[s] between samples where none is lost."""
    missing: int = 0
    """Samples that did not come in that second."""
    missing_hz: float = 0.0
    """Samples per second that did not come."""
    jitter: float = 0.0
    """[s] between the 5th and the 95th percentile of lateness."""
    age: float = 0.0
    """[s] median lateness: by how much a sample is older than the newest of any stream before it."""

    @property
    def loss(self) -> float:
        """Share of the samples that did not come, [-]."""
        return self.missing_hz / max(self.missing_hz + self.rate_hz, 1e-9)


class Recent:
    """Times and lateness of the last samples of a stream."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque(maxlen=_MOST)
        self._usual_hz = 0.0

    def add(self, time: float, age: float) -> None:
        """Take a sample.

        Args:
            time, age: s.
        """
        self._samples.append((time, age))

    def clear(self) -> None:
        """Forget the samples, after an interruption."""
        self._samples.clear()

    def quality(self) -> Quality | None:
        """Return the figures; None for too few samples."""
        if not self._samples:
            return None
        newest = max(time for time, _ in self._samples)
        first, last = newest - _OUT_OF_ORDER - _SPAN, newest - _OUT_OF_ORDER
        while self._samples and self._samples[0][0] < first:
            self._samples.popleft()
        times = sorted({time for time, _ in self._samples if first <= time <= last})
        if len(times) < _FEWEST or times[-1] - times[0] < _SHORTEST:
            return None
        span = times[-1] - times[0]
        period, even = _period([b - a for a, b in pairwise(times)])
        rate_hz = (len(times) - 1) / span
        if even:
            missing, self._usual_hz = max(0, round(span / period) + 1 - len(times)), 1 / period
        else:  # stamps of arrival, in bursts: only against what was usual
            usual_hz = self._usual_hz or rate_hz
            few = rate_hz < _CLEARLY * usual_hz
            missing, period = round(span * (usual_hz - rate_hz)) if few else 0, 1 / usual_hz
            self._usual_hz = usual_hz + _ADAPTING * (rate_hz - usual_hz)
        ages = sorted(age for _, age in self._samples)
        low, middle, high = (ages[int(share * (len(ages) - 1))] for share in (0.05, 0.5, 0.95))
        return Quality(rate_hz, period, missing, missing / span, high - low, middle)


def _period(steps: list[float]) -> tuple[float, bool]:
    """Return the step without lost samples and whether nearly all steps are whole multiples of it."""
    ordered = sorted(steps)
    median = ordered[len(ordered) // 2]
    for period in (median / 3, median / 2, median):
        shares = [step / period for step in steps]
        if period < median and sum(abs(s - 1) < _EVEN for s in shares) < _HALVES * len(steps):
            continue
        even = sum(abs(s - max(round(s), 1)) < _EVEN for s in shares)
        if even >= _MOSTLY_EVEN * len(steps):
            return period, True
    return median, False
