"""How the points of a person in an image lie to each other: one normal distribution for all of them.

A person in an image is z = s (u - t): pixels u moved and scaled until the 21 joints are centred and their
RMS radius is 1. Of z, mean and covariance were fitted to free motion seen from many sides (Rasmussen and
Williams 2006, A.2, for what follows from them). Where the person is (t) is unknown: a flat prior on it.
How large (s) is found by maximum likelihood from the points that are seen. So any subset of points tells
all the others, and how well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import indices_of, readonly

Array = NDArray[np.float64]
ANYWHERE = 1e4
"""Variance of the person's place, in RMS radii squared: as good as flat."""
UPRIGHT_BONUS = 0.5
"""Log likelihood per point by which a person must look better on their side or upside down to be taken
for lying or hanging."""
QUARTERS = tuple(np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
"""Turns of the image by quarters; the first is none."""
FEWEST_POINTS = 4
"""Fewer points seen than these tell nothing about the others."""


@dataclass(frozen=True)
class Regression:
    """The best linear estimate of some points from others."""

    mean: Array
    """(M, 2) mean of the M estimated points about the middle of the K seen ones' means, RMS radii."""
    gain: Array
    """(2M, 2K) change of the M estimated points with the K seen ones."""
    model_variance: Array
    """(M,) mean square error per axis of exact detections, in RMS radii squared."""
    noise_variance: Array
    """(M,) what the detector's own noise adds to it."""
    weight: Array
    """(M, K) share that each seen point has in each estimated one; rows sum to 1."""


@dataclass(frozen=True)
class Likelihood:
    """How well points fit, frame by frame."""

    scale: Array
    """(T,) s: RMS radii per px."""
    per_point: Array
    """(T,) log likelihood of the pixels, divided by the number of points."""
    misfit: Array
    """(T,) squared Mahalanobis distance per degree of freedom: 1 on average for the points fitted to."""


@dataclass(frozen=True)
class PoseGaussian:
    """Mean and covariance of N points, and the noise of a detector."""

    names: tuple[str, ...]
    """N points."""
    mean: Array
    """(N, 2) in RMS radii, right and down."""
    covariance: Array
    """(2N, 2N), x and y of each point in turn."""
    noise: float
    """Standard deviation of a detector's error per axis, in RMS radii."""

    def __post_init__(self) -> None:
        N = len(self.names)
        object.__setattr__(self, "mean", readonly("mean of points", self.mean, (N, 2)))
        covariance = readonly("covariance of points", self.covariance, (2 * N, 2 * N))
        object.__setattr__(self, "covariance", covariance)

    def given(self, seen: Sequence[str]) -> ConditionedPose:
        """What points that are seen tell about the person and the others."""
        return ConditionedPose(self, seen)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def index(self, points: Sequence[str]) -> list[int]:
        """Where points stand; raises `UnknownNameError`."""
        try:
            return [self._rows[point] for point in points]
        except KeyError:
            return indices_of("point", points, self.names)

    def between(self, a: Sequence[str], b: Sequence[str]) -> Array:
        """Covariance (2A, 2B) of points whose person stands anywhere."""
        rows, columns = (
            (2 * np.array(self.index(points))[:, None] + np.arange(2)).ravel() for points in (a, b)
        )
        anywhere = ANYWHERE * np.tile(np.eye(2), (len(a), len(b)))
        return np.asarray(self.covariance[np.ix_(rows, columns)] + anywhere)


class ConditionedPose:
    """Persons of whom certain points are seen.

    Attributes:
        seen: K points.
    """

    def __init__(self, gaussian: PoseGaussian, seen: Sequence[str]):
        """Factorise once what every estimate needs."""
        self.seen = tuple(seen)
        self._gaussian = gaussian
        self._covariance = gaussian.between(seen, seen)
        with_noise = self._covariance + gaussian.noise**2 * np.eye(2 * len(seen))
        self._precision = np.linalg.inv(with_noise)
        self._log_det = float(np.linalg.slogdet(with_noise)[1])
        self._mean = gaussian.mean[gaussian.index(seen)]

    def regression(self, wanted: Sequence[str]) -> Regression:
        """How to estimate points from those seen, and how well that goes."""
        gaussian, M = self._gaussian, len(wanted)
        cross = gaussian.between(wanted, self.seen)
        gain = cross @ self._precision
        own = np.diag(gaussian.between(wanted, wanted))
        error = own + ((gain @ self._covariance - 2 * cross) * gain).sum(axis=1)
        per_point = np.maximum(error.reshape(M, 2).mean(axis=1), 0)
        size = np.linalg.norm(gain.reshape(M, 2, len(self.seen), 2), axis=(1, 3))
        noise = gaussian.noise**2 * (gain**2).sum(axis=1).reshape(M, 2).mean(axis=1)
        mean = gaussian.mean[gaussian.index(wanted)] - self._mean.mean(axis=0)
        return Regression(mean, gain, per_point, noise, size / size.sum(axis=1, keepdims=True))

    def likelihood(self, uv_px: Array) -> Likelihood:
        """Size and likelihood of persons.

        With a = x' P x, b = x' P m and n degrees of freedom, log p(x | s) = n log s - (s^2 a - 2 s b) / 2
        + constant is largest at the positive root of a s^2 - b s - n = 0.

        Args:
            uv_px: (T, K, 2) pixels of the points seen, all finite.
        """
        x, m = self._centred(uv_px), (self._mean - self._mean.mean(axis=0)).ravel()
        P, n = self._precision, 2 * len(self.seen) - 2
        whitened = x @ P
        a, b = np.maximum((whitened * x).sum(axis=1), 1e-300), whitened @ m
        scale = (b + np.sqrt(b * b + 4 * a * n)) / (2 * a)
        square = scale**2 * a - 2 * scale * b + m @ P @ m
        log_p = n * np.log(scale) - (square + self._log_det) / 2
        return Likelihood(scale, log_p / len(self.seen), square / n)

    def turned_upright(self, uv_px: Array) -> tuple[NDArray[np.int64], Likelihood]:
        """Which of the quarter turns brings each person upright, and how well they fit then.

        Args:
            uv_px: (T, K, 2) pixels of the points seen, all finite.

        Returns:
            (T,) index into `QUARTERS`, and the likelihood of the points turned so.
        """
        T = len(uv_px)
        every = self.likelihood(np.concatenate([uv_px @ turn.T for turn in QUARTERS]))
        per_point = every.per_point.reshape(len(QUARTERS), T)
        best = np.argmax(per_point + np.eye(len(QUARTERS))[:, :1] * UPRIGHT_BONUS, axis=0)
        row = best * T + np.arange(T)
        return best, Likelihood(every.scale[row], every.per_point[row], every.misfit[row])

    def estimate(self, regression: Regression, uv_px: Array, scale: Array) -> Array:
        """Points (T, M, 2) in px from those seen (T, K, 2), all finite, of persons of known size (T,)."""
        centre = uv_px.mean(axis=1, keepdims=True)
        m = (self._mean - self._mean.mean(axis=0)).ravel()
        z = scale[:, None] * self._centred(uv_px) - m
        estimate = (regression.mean.ravel() + z @ regression.gain.T) / scale[:, None]
        return np.asarray(estimate.reshape(len(uv_px), -1, 2) + centre)

    def _centred(self, uv_px: Array) -> Array:
        """(T, 2K) pixels about their own mean, as the flat prior on the place allows."""
        return np.asarray((uv_px - uv_px.mean(axis=1, keepdims=True)).reshape(len(uv_px), -1))
