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
from scipy.special import gammaln

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import orientation_rate
from rtof_kin.setup.sensor_motion import RATE_HZ, SensorMotions

_ACROSS, _ALONG = np.radians([12.0, 35.0])  # of a lifted bone's orientation: its direction, its twist
_RATE, _RATE_SHARE, _RATE_ALONG = 0.5, 0.35, 3.0  # [rad/s], [-], [-] of its angular velocity; larger along it
_CUTOFF_HZ = 3.0  # of angular velocities
_MEMORY, _RATE_MEMORY = 2.0, 0.4  # [s] correlation times of the two errors
_FREEDOM = 4.0  # of Student's t
_EVERY = 3  # sample used of so many
_COARSE, _FINE = 24, 11  # headings all around, and between two of these
_LEAST_SECONDS = 2.0
_LONGEST_GAP: Final = 0.2  # [s] of the poses that is bridged


def image_scores(
    motions: SensorMotions, poses: PoseSequence, skeleton: SkeletonModel, segments: Sequence[str]
) -> Array:
    """Return the log-likelihood (S, K), nats, of each sensor's motion on each segment, up to a constant.

    Args:
        motions: on the poses' clock. poses: lifted. skeleton: theirs. segments: K names of joints.

    Raises:
        InvalidInputError: poses and sensors have no two seconds in common.
    """
    skeleton.check_joints(poses.names)
    index = list(skeleton.index(*segments))
    R_bone = signals.interpolate_rotations(
        poses.times, np.where(poses.valid[:, index, None, None], poses.R_world_bone[:, index], np.nan),
        motions.times, _LONGEST_GAP,
    )  # fmt: skip
    # In the axes of a limb the last is along it.
    along = [so3.minimal_rotation(np.array([0.0, 0.0, 1.0]), so3.unit(skeleton.table.joints[j].end)) for j in index]
    R_bone = R_bone @ np.stack(along)
    known = np.isfinite(R_bone).all(axis=(1, 2, 3))
    if known.sum() < _LEAST_SECONDS * RATE_HZ:
        raise InvalidInputError(
            f"video and sensors have {known.sum() / RATE_HZ:.1f} s of a visible person in common; put the "
            "sensors on the video's clock (rtof_kin.setup.clocks), or give no poses"
        )
    w_bone = np.stack([_turning(motions.times, R_bone[:, k]) for k in range(len(index))], axis=1)
    w = signals.low_pass_known(motions.times, motions.w.reshape(len(motions), -1), _CUTOFF_HZ).reshape(motions.w.shape)
    rows = np.flatnonzero(known & np.isfinite(w_bone).all(axis=(1, 2)))[::_EVERY]
    return _scores(R_bone[rows], w_bone[rows], motions.R[rows], w[rows])


def _turning(times: Array, R: Array) -> Array:
    """Return the low-passed angular velocity (T, 3) in world."""
    w = np.einsum("tij,tj->ti", R, orientation_rate(times, R))
    return signals.low_pass_known(times, w, _CUTOFF_HZ)


def _scores(R_bone: Array, w_bone: Array, R_sensor: Array, w_sensor: Array) -> Array:
    """Return (S, K) from samples (T, K or S, ...)."""
    step = _EVERY / RATE_HZ
    precision = np.array([1 / _ACROSS**2 - 0.5 / _ALONG**2] * 2 + [0.5 / _ALONG**2])
    precision[2], precision[:2] = 1 / _ACROSS**2 - 0.5 / _ALONG**2, 0.5 / _ALONG**2
    G = np.einsum("tkac,tsbd->skabcd", R_bone * precision, R_sensor, optimize=True) * step / _MEMORY
    wide = _RATE**2 + _RATE_SHARE**2 * np.mean(np.sum(w_sensor**2, axis=-1), axis=0)
    H = np.einsum("tka,tsb->skab", w_bone, w_sensor) * (step / _RATE_MEMORY) / wide[:, None, None, None]
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
            sigma = np.sqrt(_RATE**2 + _RATE_SHARE**2 * np.sum(w_sensor[:, s] ** 2, axis=-1))
            out[s, k] = np.sum(_student(off / [_ACROSS, _ACROSS, _ALONG])) * step / _MEMORY
            out[s, k] += np.sum(_student(off_w / np.multiply.outer(sigma, [1, 1, _RATE_ALONG]))) * step / _RATE_MEMORY
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


def _student(off: Array) -> Array:
    """Return (T,) log densities, up to a constant, of scaled deviations (T, 3)."""
    return np.asarray(-(_FREEDOM + 3) / 2 * np.log1p(np.sum(off**2, axis=-1) / _FREEDOM))
