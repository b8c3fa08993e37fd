"""Weights of the landmarks, estimated from their residuals during the optimisation."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

_NORMAL_MEDIAN: Final = 1.177
"""Median norm of a normal error in two dimensions, in standard deviations of an axis."""
_FEWEST: Final = 20
"""Observed landmarks of a fragment that an estimate needs."""
_LEAST: Final = 1e-6
"""[px] Lower bound of the residuals' size."""
_SETTLED: Final = 0.05
"""Relative change below which an estimate is kept."""


class Annealing:
    """Callback of `LevenbergMarquardt.solve` that weights the landmarks by their residuals.

    Attributes:
        sigma: standard deviation of a landmark per axis, px, with the factor.
        factor: by which autocorrelation increases it.
    """

    def __init__(
        self, settings: JointSpaceSettings, problem: FragmentEnergy, confidence: Array, sizes: Array,
        observation: dict[str, Array], least_px: float = 0.0,
    ) -> None:  # fmt: skip
        """Set the initial weights.

        Args:
            settings: bounds of the estimate. problem: with the fragment bound to it.
            confidence: (N, L) of the landmarks. sizes: (L,) their errors relative to those of the others.
            observation: of the fragment. least_px: lower bound of sigma.
        """
        self._settings, self._problem, self._confidence = settings, problem, confidence
        self._seen, self._others, self._sizes = observation["w_visual"] > 0, observation, sizes
        low, high = settings.sigma_reprojection_range
        self._bounds = max(low, least_px), max(high, least_px)
        seen, given = self._seen, settings.sigma_reprojection
        self._count, self._pairs = int(seen.sum()), int((seen[1:] & seen[:-1]).sum())
        self.sigma = settings.sigma_reprojection_range[1] if given is None else given
        self.factor = 1.0
        sees = bool(problem.energy.shape.landmarks)
        self._left = settings.annealing if given is None and sees else 0
        self._found = self.sigma
        self._weigh(None)

    def __call__(self, x: Array) -> bool:
        """Estimate the weights at states x (N, 3 + 4A); return whether they were changed."""
        if self._left == 0:
            return False
        size, factor = self._estimated(self._problem.value(x)[1])
        self.factor = factor
        first = self._left == self._settings.annealing
        if abs(size * factor / self._found - 1) < _SETTLED and not first:
            return False
        self._left -= 1
        self._found = size * factor
        self.sigma = float(np.clip(self._found, *self._bounds))
        self._weigh(factor)
        return True

    @property
    def constant_px(self) -> float:
        """Size of the constant part of a landmark's errors, px per axis."""
        square = self.factor**2  # (1 + r) / (1 - r) with the correlation r
        return float(self.sigma / self.factor * np.sqrt((square - 1) / (square + 1)))

    def _weigh(self, factor: float | None) -> None:
        """Set the weights for errors whose autocorrelation has a factor.

        Outliers are relative to the residuals without the factor. The errors of a sensor, of the root of
        the initial guess and of the prior's mean are constant over a fragment; their weights per frame
        decrease where the errors of vision average out.
        """
        self._problem.reweigh("w_visual", self._confidence * self._seen / self.sigma**2)
        knee = self._settings.robust_reprojection / (factor or 1.0)
        self._problem.reweigh("knee_visual", np.full(len(self._seen), knee))
        largest = self._settings.largest_correlation_factor
        share = (factor or largest) / largest
        for name in ("w_sensor", "w_prior", "w_root"):
            self._problem.reweigh(name, share * self._others[name])

    def _estimated(self, residuals: Array) -> tuple[float, float]:
        """Size of a residual per axis, px, and the factor for its autocorrelation, of a landmark of size 1.

        With a correlation r from frame to frame, errors weigh like white ones that are
        sqrt((1 + r) / (1 - r)) times larger.
        """
        if self._count < _FEWEST:
            return self._found, 1.0
        residuals = residuals / self._sizes[:, None]
        squares = np.einsum("tli,tli->tl", residuals, residuals)[self._seen]
        size = max(float(np.sqrt(np.median(squares))) / _NORMAL_MEDIAN, _LEAST)
        clipped = np.minimum(np.maximum(residuals, -3 * size), 3 * size) * self._seen[..., None]
        product = float(np.vdot(clipped[1:], clipped[:-1])) / max(self._pairs, 1)
        square = float(np.vdot(clipped, clipped)) / self._count
        r = float(np.clip(product / max(square, _LEAST**2), 0.0, 0.99))
        return size, float(min(np.sqrt((1 + r) / (1 - r)), self._settings.largest_correlation_factor))
