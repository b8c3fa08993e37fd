"""Weights of the landmarks, estimated from their residuals during the optimisation."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.settings import JointSpaceSettings

_NORMAL_MEDIAN: Final = 1.177  #: Median norm of a normal error in two dimensions, in standard deviations of an axis
_FEWEST: Final = 20  #: Observed landmarks of a fragment that an estimate needs
_LEAST: Final = 1e-6  #: [px] Lower bound of the residuals' size
_SETTLED: Final = 0.05  #: Relative change below which an estimate is kept


class Annealing:
    """Callback of `LevenbergMarquardt.solve` that weights the landmarks by their residuals.

    Each camera's landmarks have a standard deviation and an autocorrelation of their own.
    """

    def __init__(
        self,
        settings: JointSpaceSettings,
        problem: FragmentEnergy,
        confidence: Array,
        sizes: Array,
        observation: dict[str, Array],
    ) -> None:
        """Set the initial weights: landmarks' confidence (N, L), and sizes (L,) of their errors relative to others'."""
        self._settings, self._problem, self._confidence = settings, problem, confidence
        self._seen, self._others = observation["w_visual"] > 0, observation
        self._bounds = settings.sigma_reprojection_range
        given, visual = settings.sigma_reprojection, problem.energy["visual"]
        largest = self._bounds[1] if given is None else given
        self._camera = np.array(visual.cameras, dtype=int)
        self._errors = [
            CameraErrors(self._seen[:, own], sizes[own], largest, settings.largest_correlation_factor)
            for own in (self._camera == c for c in range(1 + len(visual.further)))
        ]
        self._left = settings.annealing if given is None and visual.landmarks else 0
        self._weigh(False)

    def __call__(self, x: Array) -> bool:
        """Estimate the weights at states x (N, 3 + 4A); return whether they were changed."""
        if self._left == 0:
            return False
        residuals, changed = self._problem.value(x)[1], self._left == self._settings.annealing
        for c, errors in enumerate(self._errors):
            changed |= errors.estimate(residuals[:, self._camera == c])
        if not changed:
            return False
        self._left -= 1
        for errors in self._errors:
            errors.accept(self._bounds)
        self._weigh(True)
        return True

    @property
    def sigma(self) -> float:
        """Standard deviation of a landmark per axis with the factor, px; the mean of cameras that see enough."""
        return float(np.mean([errors.sigma for errors in self._observing]))

    @property
    def _observing(self) -> list[CameraErrors]:
        """Cameras with enough landmarks for an estimate, else all."""
        return [errors for errors in self._errors if errors.enough] or self._errors

    @property
    def constant_px(self) -> float:
        """Size of the constant part of a landmark's errors, px per axis; the first camera's."""
        errors = self._errors[0]
        square = errors.factor**2  # (1 + r) / (1 - r) with the correlation r
        return float(errors.sigma / errors.factor * np.sqrt((square - 1) / (square + 1)))

    def _weigh(self, estimated: bool) -> None:
        """Set the weights, for errors whose autocorrelation was estimated or not yet.

        Outliers are relative to the residuals without the factor. The errors of a sensor, of the root of
        the initial guess and of the prior's mean are constant over a fragment; their weights per frame
        decrease where the errors of vision average out.
        """
        variance = np.array([errors.sigma**2 for errors in self._errors])[self._camera]
        self._problem.reweigh("w_visual", self._confidence * self._seen / variance)
        knees = [self._settings.robust_reprojection / errors.factor for errors in self._errors]
        self._problem.reweigh("knee_visual", np.tile(knees, (len(self._seen), 1)))
        largest = self._settings.largest_correlation_factor
        factor = float(np.mean([errors.factor for errors in self._observing]))
        share = factor / largest if estimated else 1.0
        for name in self._problem.energy.constant_errors:
            self._problem.reweigh(name, share * self._others[name])


class CameraErrors:
    """The errors of one camera's landmarks.

    Attributes:
        sigma: standard deviation of a landmark per axis, px, with the factor.
        factor: by which autocorrelation increases it.
        enough: whether there are enough landmarks for an estimate.
    """

    def __init__(self, seen: Mask, sizes: Array, sigma: float, largest_factor: float) -> None:
        self._seen, self._sizes, self._largest = seen, sizes, largest_factor
        self._count, self._pairs = int(seen.sum()), int((seen[1:] & seen[:-1]).sum())
        self.enough, self.sigma, self.factor = self._count >= _FEWEST, sigma, 1.0
        self._kept = self._found = sigma

    def estimate(self, residuals: Array) -> bool:
        """Estimate from residuals (N, L, 2), px; return whether the size has changed much."""
        size, self.factor = self.estimated(residuals)
        self._found = size * self.factor
        return abs(self._found / self._kept - 1) >= _SETTLED

    def accept(self, bounds: tuple[float, float]) -> None:
        """Take the last estimate, within bounds, px."""
        self._kept = self._found
        self.sigma = float(np.clip(self._found, *bounds))

    def estimated(self, residuals: Array) -> tuple[float, float]:
        """Return size of a residual (N, L, 2) per axis, px, and the factor for its autocorrelation, of a
        landmark of size 1.

        With a correlation r from frame to frame, errors weigh like white ones that are
        sqrt((1 + r) / (1 - r)) times larger.
        """
        if not self.enough:
            return self._kept, 1.0
        residuals = residuals / self._sizes[:, None]
        squares = np.einsum("tli,tli->tl", residuals, residuals)[self._seen]
        size = max(float(np.sqrt(np.median(squares))) / _NORMAL_MEDIAN, _LEAST)
        clipped = np.minimum(np.maximum(residuals, -3 * size), 3 * size) * self._seen[..., None]
        product = float(np.vdot(clipped[1:], clipped[:-1])) / max(self._pairs, 1)
        square = float(np.vdot(clipped, clipped)) / self._count
        r = float(np.clip(product / max(square, _LEAST**2), 0.0, 0.99))
        return size, float(min(np.sqrt((1 + r) / (1 - r)), self._largest))
