"""How well each sensor's motion agrees with each segment's in lifted poses, mounting and heading unknown.

A sensor on a segment has ``Rz(h) R_inertial_sensor(t) R_sensor_bone = R_world_bone(t)`` for one heading h and
one mounting R_sensor_bone, and both turn alike, ``Rz(h) w_inertial(t) = w_world(t)``, for any mounting. At
each heading the best mounting follows in closed form from a singular value decomposition (Wahba 1965), and
the heading from a grid, refined once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import angular_velocity
from rtof_kin.setup.sensor_motion import RATE_HZ, SensorMotions

_FACTORS: Final = {"Foot": (1.5, 0.8), "Head": (0.9, 1.1), "": (1.0, 1.6)}
"""Actual over stated errors of a lifted segment's direction and of its twist, by the end of its name."""
_LEAST, _USUAL = np.radians([4.0, 12.0])  # errors beside the stated one; stated, where the poses state none
_RATE, _RATE_ALONG, _RATE_SHARE = (4.0, 1.2, 0.2)  # [1/s] of the direction's, [rad/s], [-] of angular velocities
_CUTOFF_HZ = 3.0  # of angular velocities
_MEMORY, _RATE_MEMORY = 1.0, 0.3  # [s] correlation times of the two errors
_FREEDOM = 4.0  # of Student's t
_EVERY = 3  # sample used of so many
_COARSE, _FINE = 24, 11  # headings all around, and between two of these
_LEAST_SECONDS = 2.0
_LONGEST_GAP: Final = 0.2  # [s] of the poses that is bridged


def image_scores(
    motions: SensorMotions, poses: PoseSequence, skeleton: SkeletonModel, segments: Sequence[str]
) -> Array:
    """Return the log-likelihood (S, K), nats, of each sensor's motion on each segment, up to a constant.

    Raises:
        InvalidInputError: poses and sensors have no two seconds in common.
    """
    skeleton.check_joints(poses.names)
    index = list(skeleton.index(*segments))
    R_bone = signals.interpolate_rotations(
        poses.times,
        np.where(poses.valid[:, index, None, None], poses.R_world_bone[:, index], np.nan),
        motions.times,
        _LONGEST_GAP,
    )
    # In the axes of a limb the last is along it.
    along = [so3.minimal_rotation(np.array([0.0, 0.0, 1.0]), so3.unit(skeleton.table.joints[j].end)) for j in index]
    R_bone = R_bone @ np.stack(along)
    known = np.isfinite(R_bone).all(axis=(1, 2, 3))
    if known.sum() < _LEAST_SECONDS * RATE_HZ:
        raise InvalidInputError(
            f"video and sensors have {known.sum() / RATE_HZ:.1f} s of a visible person in common; put the "
            "sensors on the video's clock (rtof_kin.calibration.clocks), or give no poses"
        )
    w_bone = np.stack([_turning(motions.times, R_bone[:, k]) for k in range(len(index))], axis=1)
    w = signals.low_pass_known(motions.times, motions.w.reshape(len(motions), -1), _CUTOFF_HZ).reshape(motions.w.shape)
    rows = np.flatnonzero(known & np.isfinite(w_bone).all(axis=(1, 2)))[::_EVERY]
    sigma = _sigma(poses, index, segments, motions.times[rows])
    return _scores(R_bone[rows], w_bone[rows], sigma, motions.R[rows], w[rows])


def _sigma(poses: PoseSequence, index: Sequence[int], segments: Sequence[str], times: Array) -> Array:
    """Return errors (T, K, 3), rad, of lifted segments about two axes across and the one along."""
    stated = np.where(np.isfinite(poses.sigma_rad[:, index]), poses.sigma_rad[:, index], _USUAL)
    stated = signals.interpolate(poses.times, stated, times)
    factors = [next(f for end, f in _FACTORS.items() if name.endswith(end)) for name in segments]
    across, along = np.array(factors).T
    return np.asarray(np.hypot(np.stack([across * stated, across * stated, along * stated], axis=-1), _LEAST))


def _turning(times: Array, R: Array) -> Array:
    """Return the low-passed angular velocity (T, 3) in world."""
    return signals.low_pass_known(times, angular_velocity(times, R), _CUTOFF_HZ)


def _scores(R_bone: Array, w_bone: Array, sigma: Array, R_sensor: Array, w_sensor: Array) -> Array:
    """Return (S, K) from samples (T, K or S, ...)."""
    step = _EVERY / RATE_HZ
    # Weights of a bone's axes: a rotation about one is resisted by the other two.
    twist = 0.5 / sigma[..., 2] ** 2
    weights = np.stack([twist, twist, np.maximum(1 / sigma[..., 0] ** 2 - twist, 0)], axis=-1)
    G = np.einsum("tkac,tsbd->skabcd", R_bone * weights[:, :, None], R_sensor, optimize=True) * step / _MEMORY
    wide = np.mean((_RATE * sigma[..., 0]) ** 2, axis=0)
    wide = wide + _RATE_SHARE**2 * np.mean(np.sum(w_sensor**2, axis=-1), axis=0)[:, None]
    H = np.einsum("tka,tsb->skab", w_bone, w_sensor) * (step / _RATE_MEMORY) / wide[..., None, None]
    spread = 2 * np.pi / _COARSE
    angles = np.broadcast_to(spread * np.arange(_COARSE), (*G.shape[:2], _COARSE))
    for _ in range(2):
        gain, mounting = _at_headings(G, H, angles)
        best = gain.argmax(axis=-1)[..., None]
        heading = np.take_along_axis(angles, best, axis=-1)[..., 0]
        R_sensor_bone = np.take_along_axis(mounting, best[..., None, None], axis=2)[:, :, 0]
        angles = heading[..., None] + spread * np.linspace(-0.5, 0.5, _FINE)
    out = np.empty(G.shape[:2])
    for s in range(out.shape[0]):
        for k in range(out.shape[1]):
            turn = so3.about_axis("z", heading[s, k])
            off = so3.log(np.swapaxes(R_bone[:, k], -1, -2) @ turn @ R_sensor[:, s] @ R_sensor_bone[s, k])
            w = turn @ w_sensor[:, s, :, None]
            off_w = (np.swapaxes(R_bone[:, k], -1, -2) @ (w - w_bone[:, k, :, None]))[..., 0]
            share = _RATE_SHARE * np.linalg.norm(w_sensor[:, s], axis=-1, keepdims=True)
            of_w = np.hypot(np.where([True, True, False], _RATE * sigma[:, k], _RATE_ALONG), share)
            out[s, k] = _student(off, sigma[:, k]) * step / _MEMORY
            out[s, k] += _student(off_w, of_w) * step / _RATE_MEMORY
    return out


def _at_headings(G: Array, H: Array, angles: Array) -> tuple[Array, Array]:
    """Return gain (S, K, N) and best mounting (S, K, N, 3, 3) at headings (S, K, N)."""
    c, s = np.cos(angles)[..., None, None], np.sin(angles)[..., None, None]
    C = G[:, :, None]
    K = c * (C[..., 0, 0, :, :] + C[..., 1, 1, :, :]) + s * (C[..., 1, 0, :, :] - C[..., 0, 1, :, :])
    K = K + C[..., 2, 2, :, :]
    U, size, Vt = np.linalg.svd(K)
    sign = np.sign(np.linalg.det(U @ Vt))
    size[..., 2] *= sign
    U[..., 2] *= sign[..., None]
    turning = np.cos(angles) * (H[..., 0, 0] + H[..., 1, 1])[..., None]
    turning += np.sin(angles) * (H[..., 1, 0] - H[..., 0, 1])[..., None]
    return size.sum(axis=-1) + turning, np.swapaxes(U @ Vt, -1, -2)


def _student(off: Array, sigma: Array) -> float:
    """Return the sum of log densities, up to a constant, of deviations (T, 3) with errors (T, 3)."""
    square = np.sum((off / sigma) ** 2, axis=-1)
    density = -(_FREEDOM + 3) / 2 * np.log1p(square / _FREEDOM) - np.log(sigma).sum(axis=-1)
    return float(density.sum())
