"""Triangulation of points from several calibrated cameras, and bundle adjustment of the camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera

Array = NDArray[np.float64]
FEWEST = 2
"""Minimum number of cameras of a point."""
ROBUST_PX = 12.0
"""Scale of the Cauchy loss of the reprojection error."""
_ROUNDS = 8


@dataclass(frozen=True)
class AdjustSettings:
    """Prior standard deviations of a bundle adjustment."""

    sigma_px: float = 6.0
    """[px] of a detection, per axis."""
    sigma_turn: float = np.radians(1.5)
    """[rad] of a camera's orientation in its file, per axis."""
    sigma_move: float = 0.05
    """[m] of its position, per axis."""
    iterations: int = 40


def triangulate(cameras: Sequence[Camera], uv_px: Array, weight: Array) -> tuple[Array, Array]:
    """Triangulate points.

    Weighted linear triangulation (Hartley and Zisserman 2004, 12.2), then Gauss-Newton on the
    reprojection error with a Cauchy loss (iteratively reweighted).

    Args:
        cameras: C cameras. uv_px: (C, ..., 2), NaN where unobserved. weight: (C, ...) inverse variances
            up to a factor, 0 where unobserved.

    Returns:
        Points (..., 3) in world, m, NaN where fewer than `FEWEST` cameras observe them, and
        reprojection errors (C, ..., 2), px, NaN where unobserved.
    """
    shape = uv_px.shape[1:-1]
    uv, given = uv_px.reshape(len(cameras), -1, 2), weight.reshape(len(cameras), -1)
    given = np.where(np.isfinite(uv).all(axis=-1), given, 0.0)
    given = np.where((given > 0).sum(axis=0) >= FEWEST, given, 0.0)
    known = (given > 0).any(axis=0)
    p = np.full((uv.shape[1], 3), np.nan)
    xy = _plane(cameras, uv)[:, known]
    p[known] = _linear(cameras, xy, given[:, known])
    for _ in range(_ROUNDS):
        error, J = _residuals(cameras, xy, p[known])
        w = (given[:, known] * _robust(error, ROBUST_PX))[..., None]
        H = np.einsum("cnki,cnkj,cnk->nij", J, J, np.broadcast_to(w, error.shape))
        g = np.einsum("cnki,cnk->ni", J, w * error)
        p[known] -= np.linalg.solve(H + 1e-9 * np.eye(3), g[..., None])[..., 0]
    seen = np.stack([camera.project(p) for camera in cameras]) - uv
    seen[given == 0] = np.nan
    return p.reshape(*shape, 3), seen.reshape(uv_px.shape)


def adjust_cameras(
    cameras: Sequence[Camera], uv_px: Array, weight: Array, settings: AdjustSettings | None = None
) -> list[Camera]:
    """Adjust orientations and positions of the cameras; intrinsics stay.

    Bundle adjustment with the points eliminated (Triggs et al. 2000) and a Cauchy loss. Position,
    orientation and scale of the whole are unobserved and stay at the mean of the cameras' files through
    the priors of the settings.

    Args:
        cameras, uv_px, weight: as for `triangulate`; weights up to 1. settings: default where None.
    """
    settings = settings or AdjustSettings()
    C = len(cameras)
    uv, weight = uv_px.reshape(C, -1, 2), weight.reshape(C, -1)
    weight = np.where(np.isfinite(uv).all(axis=-1), weight, 0.0)
    kept = (weight > 0).sum(axis=0) > FEWEST  # two cameras hardly constrain each other
    uv, weight = uv[:, kept], weight[:, kept]
    p, _ = triangulate(cameras, uv, weight)
    prior = np.tile(1 / np.r_[[settings.sigma_turn] * 3, [settings.sigma_move] * 3] ** 2, C)
    start, now, x = list(cameras), list(cameras), np.zeros(6 * C)
    for _ in range(settings.iterations):
        step, dp = _bundle_step(now, _plane(now, uv), weight, p, prior, x, settings.sigma_px)
        x, p = x + step, p + dp
        now = [_moved(camera, part) for camera, part in zip(start, x.reshape(C, 6), strict=True)]
        if np.all(np.abs(step) < 1e-7):
            break
    return now


def _bundle_step(
    cameras: Sequence[Camera], xy: Array, weight: Array, p: Array, prior: Array, x: Array, sigma: float
) -> tuple[Array, Array]:
    """Return one Gauss-Newton step of cameras (6 C,) and points (N, 3)."""
    C = len(cameras)
    error, J_point = _residuals(cameras, xy, p)
    J_camera = np.empty((*error.shape, 6))
    for c, camera in enumerate(cameras):
        J_camera[c, ..., :3] = np.einsum("nkj,njl->nkl", J_point[c], so3.skew(p - camera.center_world))
        J_camera[c, ..., 3:] = -J_point[c]
    w = weight * _robust(error, 2 * sigma) / sigma**2
    H_cc, g_c = np.diag(prior), prior * x
    H_pp = np.einsum("cnki,cnkj,cn->nij", J_point, J_point, w) + 1e-6 * np.eye(3)
    g_p = np.einsum("cnki,cnk,cn->ni", J_point, error, w)
    H_cp = np.einsum("cnki,cnkj,cn->cinj", J_camera, J_point, w).reshape(6 * C, -1, 3)
    for c in range(C):
        own = slice(6 * c, 6 * c + 6)
        H_cc[own, own] += np.einsum("nki,nkj,n->ij", J_camera[c], J_camera[c], w[c])
        g_c[own] += np.einsum("nki,nk,n->i", J_camera[c], error[c], w[c])
    to_points = np.linalg.solve(H_pp, H_cp.transpose(1, 2, 0))  # (N, 3, 6 C)
    free = np.linalg.solve(H_pp, g_p[..., None])[..., 0]
    schur = H_cc - np.einsum("anj,njb->ab", H_cp, to_points)
    step: Array = np.linalg.solve(schur, -g_c + np.einsum("anj,nj->a", H_cp, free))
    return step, -free - np.einsum("nja,a->nj", to_points, step)


def _moved(camera: Camera, change: Array) -> Camera:
    """Return the camera rotated by change[:3] (rotation vector) and moved by change[3:], m, in world."""
    R = camera.R_camera_world @ so3.exp(-change[:3])
    return replace(camera, R_camera_world=R, t_camera_world=-R @ (camera.center_world + change[3:]))


def _robust(error: Array, size: float) -> Array:
    """Return weights (C, N) of a Cauchy loss of errors (C, N, 2); arbitrary where unobserved."""
    return np.asarray(1 / (1 + np.sum(np.nan_to_num(error) ** 2, axis=-1) / size**2))


def _plane(cameras: Sequence[Camera], uv: Array) -> Array:
    """Return undistorted directions x/z, y/z (C, N, 2); zero where unobserved."""
    return np.stack([np.nan_to_num(c.normalise(seen)) for c, seen in zip(cameras, uv, strict=True)])


def _residuals(cameras: Sequence[Camera], xy: Array, p: Array) -> tuple[Array, Array]:
    """Return undistorted reprojection errors (C, N, 2), px, and Jacobians by the points (C, N, 2, 3)."""
    errors, jacobians = [], []
    for camera, seen in zip(cameras, xy, strict=True):
        at = camera.to_camera(p)
        depth = np.maximum(at[:, 2:], 0.1)
        flat = at[:, :2] / depth
        focal = np.array([camera.K[0, 0], camera.K[1, 1]])
        R = camera.R_camera_world
        errors.append(focal * (flat - seen))
        J = (R[None, :2] - flat[..., None] * R[2]) / depth[..., None]
        jacobians.append(focal[:, None] * J)
    return np.stack(errors), np.stack(jacobians)


def _linear(cameras: Sequence[Camera], xy: Array, weight: Array) -> Array:
    """Return the linear least-squares points (N, 3)."""
    rows, right = [], []
    for camera, seen, w in zip(cameras, xy, np.sqrt(weight), strict=True):
        R, t = camera.R_camera_world, camera.t_camera_world
        rows.append(w[:, None, None] * (R[None, :2] - seen[..., None] * R[2]))
        right.append(w[:, None] * (seen * t[2] - t[:2]))
    A, b = np.concatenate(rows, axis=1), np.concatenate(right, axis=1)
    H, g = np.einsum("nki,nkj->nij", A, A), np.einsum("nki,nk->ni", A, b)
    return np.asarray(np.linalg.solve(H, g[..., None])[..., 0])
