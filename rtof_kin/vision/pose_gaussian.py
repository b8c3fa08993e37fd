"""Normal distribution of the points of a person in an image, and its conditionals.

A person is z = s (u - t): pixels u shifted and scaled so that the 21 joints are centred and have an RMS
radius of 1. Mean and covariance of z were fitted to free motion seen from many directions. The place t has
a flat prior; the scale s is the maximum-likelihood estimate from the detected points. Any subset of points
then gives a regression of all others (Rasmussen and Williams 2006, A.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, readonly

ANYWHERE: Final = 1e4  # [RMS radii squared] variance of a person's place; practically flat
_UPRIGHT_BONUS = 0.5  # log-likelihood per point by which a turned person must fit better
QUARTERS: Final = tuple(np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
FEWEST_POINTS: Final = 4  # detected, for a regression


class Regression(NamedTuple):
    """Best linear estimate of M points from K detected ones; lengths in RMS radii."""

    mean: Array  # (M, 2) about the centre of the K points' means
    gain: Array  # (2M, 2K) derivative of the estimates
    model_variance: Array  # (M,) mean square error per axis for exact detections
    noise_variance: Array  # (M,) mean square error per axis from detector noise
    weight: Array  # (M, K) relative influence of each detected point; rows sum to 1


class Likelihood(NamedTuple):
    """Goodness of fit of T persons."""

    scale: Array  # (T,) RMS radii per px
    per_point: Array  # (T,) log-likelihood of the pixels per point
    misfit: Array  # (T,) squared Mahalanobis distance per degree of freedom; its expectation is 1


@dataclass(frozen=True)
class PoseGaussian:
    """Mean and covariance of N points, and the noise of a detector."""

    names: tuple[str, ...]
    """N points."""
    mean: Array
    """(N, 2) RMS radii, right and down."""
    covariance: Array
    """(2N, 2N), x and y of each point in turn."""
    noise: float
    """Standard deviation of a detector's error per axis, RMS radii."""

    def __post_init__(self) -> None:
        N = len(self.names)
        object.__setattr__(self, "mean", readonly("mean of points", self.mean, (N, 2)))
        covariance = readonly("covariance of points", self.covariance, (2 * N, 2 * N))
        object.__setattr__(self, "covariance", covariance)

    def given(self, seen: Sequence[str]) -> _ConditionedPose:
        """Return the distribution conditioned on detected points."""
        return _ConditionedPose(self, seen)

    def between(self, a: Sequence[str], b: Sequence[str]) -> Array:
        """Return the covariance (2A, 2B) of points of a person anywhere in the image."""
        rows, columns = (
            (2 * np.array(indices_of("point", p, self.names))[:, None] + np.arange(2)).ravel() for p in (a, b)
        )
        anywhere = ANYWHERE * np.tile(np.eye(2), (len(a), len(b)))
        return np.asarray(self.covariance[np.ix_(rows, columns)] + anywhere)


class _ConditionedPose:
    """Distribution of persons with K detected points; factorised once."""

    def __init__(self, gaussian: PoseGaussian, seen: Sequence[str]):
        self.seen = tuple(seen)
        self._gaussian = gaussian
        self._covariance = gaussian.between(seen, seen)
        with_noise = self._covariance + gaussian.noise**2 * np.eye(2 * len(seen))
        self._precision = np.linalg.inv(with_noise)
        self._log_det = float(np.linalg.slogdet(with_noise)[1])
        mean = gaussian.mean[indices_of("point", seen, gaussian.names)]
        self._centre = mean.mean(axis=0)
        self._mean = (mean - self._centre).ravel()

    def regression(self, wanted: Sequence[str]) -> Regression:
        """Return the regression of M points on the detected ones."""
        gaussian, M = self._gaussian, len(wanted)
        cross = gaussian.between(wanted, self.seen)
        gain = cross @ self._precision
        own = np.diag(gaussian.between(wanted, wanted))
        error = own + ((gain @ self._covariance - 2 * cross) * gain).sum(axis=1)
        per_point = np.maximum(error.reshape(M, 2).mean(axis=1), 0)
        size = np.linalg.norm(gain.reshape(M, 2, len(self.seen), 2), axis=(1, 3))
        noise = gaussian.noise**2 * (gain**2).sum(axis=1).reshape(M, 2).mean(axis=1)
        mean = gaussian.mean[indices_of("point", wanted, gaussian.names)] - self._centre
        return Regression(mean, gain, per_point, noise, size / size.sum(axis=1, keepdims=True))

    def likelihood(self, uv_px: Array) -> Likelihood:
        """Estimate scale and likelihood of persons from pixels (T, K, 2) of the detected points.

        With a = x' P x, b = x' P m and n degrees of freedom, log p(x | s) = n log s - (s^2 a - 2 s b) / 2
        + constant has its maximum at the positive root of a s^2 - b s - n = 0.
        """
        x, m = _centred(uv_px), self._mean
        P, n = self._precision, 2 * len(self.seen) - 2
        whitened = x @ P
        a, b = np.maximum((whitened * x).sum(axis=1), 1e-300), whitened @ m
        scale = (b + np.sqrt(b * b + 4 * a * n)) / (2 * a)
        square = scale**2 * a - 2 * scale * b + m @ P @ m
        log_p = n * np.log(scale) - (square + self._log_det) / 2
        return Likelihood(scale, log_p / len(self.seen), square / n)

    def turned_upright(self, uv_px: Array) -> tuple[NDArray[np.int64], Likelihood]:
        """Return the quarter turn (T,) that brings persons (T, K, 2) upright, and their likelihood then."""
        T = len(uv_px)
        every = self.likelihood(np.concatenate([uv_px @ turn.T for turn in QUARTERS]))
        per_point = every.per_point.reshape(len(QUARTERS), T)
        best = np.argmax(per_point + np.eye(len(QUARTERS))[:, :1] * _UPRIGHT_BONUS, axis=0)
        row = best * T + np.arange(T)
        return best, Likelihood(every.scale[row], every.per_point[row], every.misfit[row])

    def estimate(self, regression: Regression, uv_px: Array, scale: Array) -> Array:
        """Return points (T, M, 2), px, from the detected ones (T, K, 2) of persons of scale (T,)."""
        centre = uv_px.mean(axis=1, keepdims=True)
        z = scale[:, None] * _centred(uv_px) - self._mean
        estimate = (regression.mean.ravel() + z @ regression.gain.T) / scale[:, None]
        return np.asarray(estimate.reshape(len(uv_px), -1, 2) + centre)


def _centred(uv_px: Array) -> Array:
    """Return (T, 2K) pixels about their mean, as the flat prior on the place allows."""
    return np.asarray((uv_px - uv_px.mean(axis=1, keepdims=True)).reshape(len(uv_px), -1))
