"""What a landmark is worth, from what is left of it: estimated anew as the solver goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

Array = NDArray[np.float64]
_NORMAL_MEDIAN = 1.177
"""Median norm of a normal error in two dimensions, in standard deviations of an axis."""
_FEWEST = 20
"""Landmarks seen in a fragment that an estimate needs."""
_LEAST = 1e-6
"""[px] that the size of residuals is at least taken to be."""
_SETTLED = 0.05
"""Relative change below which an estimate is kept."""


class Annealing:
    """Weighs the landmarks by what is left of them, after every step that changes it."""

    def __init__(
        self, settings: JointSpaceSettings, problem: FragmentEnergy, confidence: Array,
        observation: dict[str, Array],
    ) -> None:  # fmt: skip
        self._settings, self._problem, self._confidence = settings, problem, confidence
        self._seen, self._others = observation["w_visual"] > 0, observation
        seen = self._seen
        self._count, self._pairs = int(seen.sum()), int((seen[1:] & seen[:-1]).sum())
        given = settings.sigma_reprojection
        self.sigma = settings.sigma_reprojection_range[1] if given is None else given
        """[px] of a landmark per axis."""
        self.factor = 1.0
        """[1] By how much that is larger because errors last."""
        sees = bool(problem.energy.shape.landmarks)
        self._left = settings.annealing if given is None and sees else 0
        self._found = self.sigma
        self._weigh(None)

    def __call__(self, x: Array) -> bool:
        """Whether the weights were changed for a state."""
        if self._left == 0:
            return False
        size, factor = self._estimated(self._problem.value(x)[1])
        self.factor = factor
        first = self._left == self._settings.annealing
        if abs(size * factor / self._found - 1) < _SETTLED and not first:
            return False
        self._left -= 1
        self._found = size * factor
        self.sigma = float(np.clip(self._found, *self._settings.sigma_reprojection_range))
        self._weigh(factor)
        return True

    @property
    def lasting_px(self) -> float:
        """Size of that part of a landmark's errors that is the same from frame to frame, px per axis."""
        square = self.factor**2  # (1 + r) / (1 - r) with the correlation r
        return float(self.sigma / self.factor * np.sqrt((square - 1) / (square + 1)))

    def _weigh(self, factor: float | None) -> None:
        """Weights for errors that correlation in time makes count as if larger by a factor.

        Outliers are landmarks that are far out by the size of the others. A sensor's error, the start's
        root and the distance from the prior's mean stay for a whole fragment; counted once a frame, their
        standard deviations hold beside a vision whose errors stay too. Where those average out they give
        way.
        """
        self._problem.reweigh("w_visual", self._confidence * self._seen / self.sigma**2)
        knee = self._settings.robust_reprojection / (factor or 1.0)
        self._problem.reweigh("knee_visual", np.full(len(self._seen), knee))
        largest = self._settings.largest_correlation_factor
        share = (factor or largest) / largest
        for name in ("w_sensor", "w_prior", "w_root"):
            self._problem.reweigh(name, share * self._others[name])

    def _estimated(self, residuals: Array) -> tuple[float, float]:
        """Size of a landmark's residual per axis, px, and the factor for its correlation in time.

        Errors that stay (biases, drifts) do not average out over a fragment; with a correlation r from
        frame to frame they weigh like white ones that are sqrt((1 + r) / (1 - r)) times larger.
        """
        if self._count < _FEWEST:
            return self._found, 1.0
        squares = np.einsum("tli,tli->tl", residuals, residuals)[self._seen]
        size = max(float(np.sqrt(_median(squares))) / _NORMAL_MEDIAN, _LEAST)
        clipped = np.minimum(np.maximum(residuals, -3 * size), 3 * size) * self._seen[..., None]
        product = float(np.vdot(clipped[1:], clipped[:-1])) / max(self._pairs, 1)
        square = float(np.vdot(clipped, clipped)) / self._count
        r = float(np.clip(product / max(square, _LEAST**2), 0.0, 0.99))
        return size, float(min(np.sqrt((1 + r) / (1 - r)), self._settings.largest_correlation_factor))


def _median(values: Array) -> float:
    """NumPy's, which for a thousand numbers takes several times as long."""
    upper = len(values) // 2
    lower = upper - 1 + len(values) % 2
    ordered = np.partition(values, [lower, upper])
    return float(ordered[lower] + ordered[upper]) / 2
