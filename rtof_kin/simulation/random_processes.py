"""Random processes at a constant rate: coloured noise, and episodes that come and go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from rtof_kin.core.array_types import Array


def ornstein_uhlenbeck(rng: Generator, frames: int, size: Sequence[int], memory: float) -> Array:
    """Return a stationary process (T, *size) of unit variance with an exponential autocorrelation.

    Args:
        memory: correlation time in frames; 0 gives white noise.
    """
    noise = rng.standard_normal((frames, *size))
    if memory <= 0:
        return noise
    share = np.exp(-1 / memory)
    noise[1:] *= np.sqrt(1 - share**2)
    return np.asarray(lfilter([1.0], [1.0, -share], noise, axis=0))


def smoothed(values: Array, width: float) -> Array:
    """Return values (T, ...) under a moving normal window.

    Args:
        values: (T, ...).
    """
    return np.asarray(gaussian_filter1d(values, width, axis=0, mode="nearest"))


def episodes(rng: Generator, per_minute: Array, rate_hz: float, median: float, spread: float) -> list[slice]:
    """Return runs of frames that start at random, of log-normal durations of at least one frame.

    Args:
        per_minute: (T,) expected starts per minute at each frame. rate_hz: frames per second.
        median: of the durations, s.
    """
    starts = np.flatnonzero(rng.random(len(per_minute)) < per_minute / 60 / rate_hz)
    durations = median * np.exp(spread * rng.standard_normal(len(starts)))
    lengths = np.maximum(np.round(durations * rate_hz).astype(int), 1)
    return [slice(start, start + length) for start, length in zip(starts, lengths, strict=True)]
