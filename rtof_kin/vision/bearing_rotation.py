"""Rotation of a camera from corresponding points of two images, and the focal length that makes them agree.

Bearings of two images of a camera that turns about its optical centre differ by a rotation: least squares by
Kabsch (1976), outliers by random samples of two points (Fischler and Bolles 1981). The focal length follows
from how displacements grow towards the borders of the image (Hartley, IJCV 22, 1997: homographies K R K^-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.camera import Camera

_SAMPLES: Final = 60
_HUBER: Final = 1.0  # px
_FACTOR: Final = 2.0  # between the given focal length and the shortest or longest that is tried
_CORRELATED: Final = 10.0  # points that err as one: those of one thing, of one keyframe
_LENS: Final = 0.01  # relative error of the focal length by unknown distortion of the lens


class Turned(NamedTuple):
    """Rotation between two images."""

    R_a_b: Array
    """(3, 3) bearings of b to those of a."""
    inliers: Mask
    """(n,) points that agree with it."""
    sigma: float
    """Standard deviation per axis, rad, of the axis that is known the least."""


class Pair(NamedTuple):
    """Corresponding points of two images of one camera, px."""

    uv_a: Array
    """(n, 2)."""
    uv_b: Array
    """(n, 2)."""


def bearings(camera: Camera, uv_px: Array) -> Array:
    """Return unit vectors (..., 3) in camera axes.

    Args:
        uv_px: (..., 2).
    """
    xy = camera.normalise(uv_px)
    return so3.unit(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1))


def turn_between(b_a: Array, b_b: Array, tolerance: float, rng: np.random.Generator | None = None) -> Turned:
    """Return the rotation with the most inliers, refined by all of them.

    Args:
        b_a, b_b: (n, 3) bearings of corresponding points, at least two. tolerance: of an inlier, rad.
        rng: source of random samples; None where all points are inliers.
    """
    inliers = np.ones(len(b_a), bool)
    if rng is not None:
        pick = rng.integers(len(b_a), size=(_SAMPLES, 2))
        R = so3.nearest_rotation(np.swapaxes(b_a[pick], -1, -2) @ b_b[pick])
        near = np.linalg.norm(b_a - np.einsum("sij,nj->sni", R, b_b), axis=-1) < tolerance
        inliers = near[int(np.argmax(near.sum(axis=1)))]
    for _ in range(3 if rng is not None else 1):
        R = so3.nearest_rotation(b_a[inliers].T @ b_b[inliers])
        off = np.linalg.norm(b_a - b_b @ R.T, axis=-1)
        if rng is not None:
            inliers = off < tolerance
    n = int(inliers.sum())
    information = n * np.eye(3) - b_a[inliers].T @ b_a[inliers]
    variance = float(np.mean(off[inliers] ** 2)) / 2 if n else np.inf
    return Turned(R, inliers, float(np.sqrt(variance / max(np.linalg.eigvalsh(information)[0], 1e-12))))


def with_focal(camera: Camera, factor: float) -> Camera:
    """Return the camera with another focal length."""
    return replace(camera, K=camera.K @ np.diag([factor, factor, 1.0]))


def focal_factor(camera: Camera, pairs: Sequence[Pair], sigma: float) -> tuple[float, float]:
    """Return the factor on the focal length with which rotations explain the points best.

    Args:
        pairs: of images turned against each other, each with as many points.

    Returns:
        The factor and its relative standard deviation; 1 and `sigma` without pairs.
    """
    if not pairs:
        return 1.0, sigma
    uv_a, uv_b = (np.stack(part) for part in zip(*pairs, strict=True))
    noise = 0.0

    def squares(log_factor: float) -> Array:
        own = with_focal(camera, float(np.exp(log_factor)))
        a, b = bearings(own, uv_a), bearings(own, uv_b)
        R = so3.nearest_rotation(np.swapaxes(a, -1, -2) @ b)
        b = b @ np.swapaxes(R, -1, -2)
        # In px: bearings towards the borders of a wider image would be closer together.
        off = np.linalg.norm(a[..., :2] / a[..., 2:] - b[..., :2] / b[..., 2:], axis=-1) * own.K[0, 0]
        return np.asarray(np.where(off < _HUBER, off**2, 2 * _HUBER * off - _HUBER**2))

    def cost(log_factor: float) -> float:
        return float(squares(log_factor).sum()) / noise / 2 / _CORRELATED + (log_factor / sigma) ** 2 / 2

    noise = max(float(np.median(squares(0.0))), 1e-4)
    for _ in range(2):  # the residual's size is that of the best focal length
        limit = float(np.log(_FACTOR))
        best = float(minimize_scalar(cost, bounds=(-limit, limit), method="bounded").x)
        noise = max(float(np.mean(squares(best))) / 2, 1e-4)
    step = 0.01
    curvature = (cost(best + step) - 2 * cost(best) + cost(best - step)) / step**2
    return float(np.exp(best)), min(sigma, float(np.hypot(1 / np.sqrt(max(curvature, sigma**-2)), _LENS)))
