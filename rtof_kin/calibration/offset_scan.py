"""Scan of the offset between two clocks: how well two recordings agree at every offset of a grid.

What agreement means is the caller's: a log-likelihood of rotations (`clock_scan`), of bones in the image
(`bone_images`), of the joints of two videos (`clocks`), of the energy of a window (`sequential`), or a correlation of
joint angles (`rtof_kin.clinical.comparison_samples`). What follows from it is here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

APART = 0.35  # [s] Usual least distance of a rival: no repetition of a movement is faster


@dataclass(frozen=True)
class OffsetScan:
    """Gains of all offsets."""

    offsets: Array  # (K,) s, evenly spaced
    gains: Array  # (K,) larger is better: nats, or a correlation; minus infinity for offsets that are not possible
    apart: float = APART  # [s] Least distance of a rival from the best offset; 0 for another maximum at any distance
    peak: int = -1  # Index of the best offset; -1 for the one with the largest gain

    def __post_init__(self) -> None:
        if self.peak < 0:
            object.__setattr__(self, "peak", int(np.argmax(self.gains)))

    @property
    def gain(self) -> float:
        """Gain of the best offset."""
        return float(self.gains[self.peak])

    @property
    def step(self) -> float:
        """[s] between offsets, negative where they fall."""
        return float(self.offsets[1] - self.offsets[0]) if len(self.offsets) > 1 else 0.0

    @property
    def _around(self) -> Array | None:
        """Gains (3,) of the best offset and its neighbours; None at a border."""
        three = self.gains[max(self.peak - 1, 0) : self.peak + 2]
        return three if len(three) == 3 and np.isfinite(three).all() else None

    @property
    def best(self) -> float:
        """[s] The best offset, by a parabola through it and its neighbours."""
        at, three = float(self.offsets[self.peak]), self._around
        return at if three is None else at + self.step * float(np.clip(signals.vertex(*three), -1, 1))

    @property
    def sigma(self) -> float:
        """[s] Standard deviation by the parabola's curvature, for gains in nats; at a border, a step."""
        three = self._around
        curvature = -1.0 if three is None else min(float(three[0] - 2 * three[1] + three[2]), -1e-6)
        return abs(self.step) / float(np.sqrt(-curvature))

    @cached_property
    def rival(self) -> tuple[float, float]:
        """Second best offset, s, and its gain; NaN and minus infinity where there is none."""
        others = np.where(np.abs(self.offsets - self.offsets[self.peak]) > self.apart, self.gains, -np.inf)
        if not self.apart:
            low = high = self.peak
            while low > 0 and self.gains[low - 1] <= self.gains[low]:
                low -= 1
            while high < len(self.gains) - 1 and self.gains[high + 1] <= self.gains[high]:
                high += 1
            others[low : high + 1] = -np.inf
            inner = (others[1:-1] >= others[:-2]) & (others[1:-1] >= others[2:])
            others = np.where(np.pad(inner, 1), others, -np.inf)
        k = int(np.argmax(others))
        return (float(self.offsets[k]), float(others[k])) if np.isfinite(others[k]) else (np.nan, -np.inf)

    def peaks(self, most: int) -> list[int]:
        """Return indices of the largest gains, `apart` from each other, the best first."""
        left, out = self.gains.copy(), list[int]()
        while len(out) < most and np.isfinite(left.max()):
            out.append(int(np.argmax(left)))
            left[np.abs(self.offsets - self.offsets[out[-1]]) < self.apart] = -np.inf
        return out

    def moments(self) -> tuple[float, float]:
        """Return mean and standard deviation, s, of the offsets in proportion to the exponential of their gains."""
        p = np.exp(self.gains - self.gains.max())
        p /= p.sum()
        mean = float(p @ self.offsets)
        return mean, float(np.sqrt(p @ (self.offsets - mean) ** 2))


def repeated(best: float, *others: float) -> str:
    """Return the doubt that a movement repeats itself, without a remedy; all offsets, s, explain it alike."""
    listed = ", ".join(f"{other:+.2f} s" for other in others)
    return f"the motion repeats itself: offsets of {listed} explain it nearly as well as {best:+.2f} s"
