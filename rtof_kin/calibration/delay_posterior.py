"""Posterior of the delay of the video, from energies of windows at some delays.

The energy of fast motion is not quadratic in the delay. Energies are added up on a grid of delays
between two standard deviations of the prior; delay and deviation are the moments of the posterior, which is
wide while two delays explain the motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from rtof_kin.calibration.result import Quantity
from rtof_kin.calibration.sensor_unknowns import Sampled
from rtof_kin.core.array_types import Array, Index

Sensors = tuple[Array, Array, Array, Array]
"""What `sensor_unknowns.Sampled` returns."""
_REACH: Final = 2.0
"""Delays that are tried reach so many standard deviations of the prior to both sides."""
_COARSEST: Final = 1 / 3
"""[sigma] Largest step between them; one frame where that is smaller."""
_FINE: Final = np.linspace(-_REACH, _REACH, 401)
"""[sigma] Delays of the posterior, between which energies are interpolated."""
_SHARPEST: Final = 0.02
"""[sigma] Smallest deviation: samples are interpolated."""


@dataclass(frozen=True)
class LateSensors:
    """Sensors at evenly spaced instants, of which every delay of a grid takes some."""

    at: Sensors
    steps: Index
    """(n,) delays of the grid from the present one, in steps."""
    step: float
    """[s]"""
    count: int
    """Instants from the first to the last frame."""
    parts: int
    """Steps from frame to frame."""

    def sensors(self, k: int) -> Sensors:
        """Return the sensors at the frames for a delay k steps longer than the present one."""
        first = int(self.steps[-1]) - k
        frames = slice(first, first + self.count, self.parts)
        q, _, a, _ = (values[frames] for values in self.at)
        return q, self._known[0], a, self._known[1]

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        """Weights (N, S) of orientations and accelerations that all delays have: else their energies are of
        other residuals.
        """
        first = int(self.steps[-1])
        frames = [slice(first - k, first - k + self.count, self.parts) for k in self.steps.tolist()]
        orientations, accelerations = (
            np.minimum.reduce([weights[own] for own in frames]) for weights in (self.at[1], self.at[3])
        )
        return orientations, accelerations


class DelayPosterior:
    """Delay that windows of a motion tell.

    Attributes:
        delay: s. sigma: its standard deviation, s. doubt: why it may be wrong; empty for no reason.
    """

    def __init__(self, usual: float, mean: float, sigma: float) -> None:
        """Begin with a prior.

        Args:
            usual: standard deviation of the delay of any video, s.
            mean, sigma: of this one, from a saved calibration, s; zero and the usual one where unknown.
        """
        self._usual = usual
        self._begin(mean, sigma)

    def _begin(self, mean: float, sigma: float) -> None:
        self._prior, self._energies = (mean, sigma), np.zeros_like(_FINE)
        self.delay, self.sigma, self.doubt = mean, sigma, ""

    def around(self, times: Array, rate_hz: float, sampled: Sampled) -> LateSensors:
        """Return the sensors at the frames of a window, for the present delay and for all others.

        Args:
            times: (N,) stamps of the video, evenly spaced, s. sampled: the sensors at any times.
        """
        mean, sigma = self._prior
        parts = int(np.ceil(1 / (_COARSEST * sigma * rate_hz)))
        step = 1 / (parts * rate_hz)
        present = (self.delay - mean) / step
        ends = np.round(np.array([-1, 1]) * _REACH * sigma / step - present).astype(int)
        lowest, highest = min(int(ends[0]) - 1, 0), max(int(ends[1]) + 1, 0)
        count = parts * (len(times) - 1) + 1
        instants = times[0] - self.delay + step * np.arange(-highest, count - lowest)
        return LateSensors(sampled(instants), np.arange(lowest, highest + 1), step, count, parts)

    def interpolated(self, late: LateSensors, energies: Array) -> Array:
        """Return energies (n,) of a window at the delays of `late` on the grid of the posterior."""
        mean, sigma = self._prior
        delays = (self.delay + late.step * late.steps - mean) / sigma
        return np.asarray(CubicSpline(delays, energies - energies.min())(_FINE))

    def add(self, interpolated: Array, kept: float) -> None:
        """Add the energies of a window."""
        self._energies = kept * self._energies + interpolated

    def estimate(self, weight: float) -> None:
        """Set delay, deviation and doubt; a saved delay that the search leads away from is forgotten."""
        mean, sigma = self._prior
        nats = weight * self._energies + _FINE**2 / 2
        p = np.exp(nats.min() - nats)
        p /= p.sum()
        at = float(p @ _FINE)
        self.sigma = max(float(np.sqrt(p @ (_FINE - at) ** 2)), _SHARPEST) * sigma
        self.delay, self.doubt = mean + sigma * at, ""
        if abs(at) > _REACH - _COARSEST:
            if sigma < self._usual:
                self._begin(0.0, self._usual)
            else:
                self.doubt = f"the search ends at {self.delay:.3g} s, and the delay may lie beyond"

    @property
    def quantity(self) -> Quantity:
        """The delay with its verdict."""
        known = float(np.clip(1 - (self.sigma / self._usual) ** 2, 0.0, 1.0))
        delay, sigma, usual = (np.array([v]) for v in (self.delay, self.sigma, self._usual))
        return Quantity("delay", "video", delay, sigma, usual, known, self.doubt)
