"""Features of sensors' motion by which segments differ, free of mounting and heading.

Of each sensor: sizes and spectra of turning and acceleration, changes of inclination, how planar it turns,
and how its vertical turning goes with the rest (which mirrors with the side of the body). Of two sensors:
ratios, correlations, and how well one point, fixed to both, explains the accelerations of both: the common
joint of neighbouring segments, after Seel, Schauer and Raisch (2012), here with orientations, so that it is
linear least squares at every difference of headings.

Ideas: Weenk et al. (2013), statistics by correlation and rank; Graurock, Schauer and Seel (2016), gait;
Zimmermann, Taetz and Bleser (2018), learned from motion capture.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.setup.sensor_motion import RATE_HZ, SensorMotions

_LEVER = 0.2  # [m] usual distance of a sensor from a joint of its segment
_NOISE = 0.3  # [m/s^2] of an acceleration
_HEADINGS: Final = 24
"""Differences of headings tried, evenly from 0."""
_W0, _A0 = 0.05, 0.1  # [rad/s], [m/s^2] added to sizes: rest


def single_features(motions: SensorMotions) -> Array:
    """Return features (S, F) of each sensor."""
    w, a = motions.w, motions.a
    w_h, w_z, a_h, a_z = np.hypot(w[..., 0], w[..., 1]), w[..., 2], np.hypot(a[..., 0], a[..., 1]), a[..., 2]
    speed, size = np.linalg.norm(w, axis=-1), np.linalg.norm(a, axis=-1)
    jerk = np.linalg.norm(np.gradient(a, axis=0), axis=-1) * RATE_HZ
    turning = np.linalg.norm(np.gradient(w, axis=0), axis=-1) * RATE_HZ
    up = motions.R[:, :, 2, :]
    tilt = 1 - np.linalg.norm(up.mean(axis=0), axis=-1)
    tilts = _shares(up - up.mean(axis=0))
    about = _shares(np.einsum("tsji,tsj->tsi", motions.R, w))
    dot = np.sum(w[..., :2] * a[..., :2], axis=-1)
    cross = w[..., 0] * a[..., 1] - w[..., 1] * a[..., 0]
    even = [
        np.log(_rms(w_z) + _W0),
        np.log(_rms(w_h) + _W0),
        np.log(_rms(a_z) + _A0),
        np.log(_rms(a_h) + _A0),
        np.log(_rms(turning) / (_rms(speed) + _W0) + 0.1),
        np.log(_rms(jerk) / (_rms(size) + _A0) + 0.1),
        np.log(tilt + 1e-3),
        tilts[:, 0],
        tilts[:, 1],
        about[:, 0],
        about[:, 1],
        np.log(_rms(speed**2) / (_rms(speed) ** 2 + _W0**2)),
        np.log(_rms(size**2) / (_rms(size) ** 2 + _A0**2)),
        np.log((np.quantile(speed, 0.2, axis=0) + 0.02) / (_rms(speed) + _W0)),
        np.log((np.quantile(size, 0.2, axis=0) + 0.05) / (_rms(size) + _A0)),
        _skewness(a_z),
        _correlation(a_z, speed),
        _correlation(a_z, size),
        _correlation(speed, size),
        _mean_ratio(cross, w_h * a_h),
        _correlation(np.abs(w_z), w_h),
        np.log(_rms(np.gradient(a_z, axis=0) * RATE_HZ) / (_rms(a_z) + _A0) + 0.1),
    ]
    return np.stack([*even, *_odd(w_z, dot, w_h, a_z, speed, size)], axis=-1)


def _odd(w_z: Array, dot: Array, w_h: Array, a_z: Array, speed: Array, size: Array) -> list[Array]:
    rise = np.gradient(speed, axis=0)
    return [
        _skewness(w_z),
        _correlation(w_z, w_h),
        _correlation(w_z, a_z),
        _correlation(w_z, size),
        _correlation(w_z, rise),
        _correlation(dot, w_h),
        _correlation(dot, a_z),
        _mean_ratio(dot, speed * size),
    ]


def pair_features(motions: SensorMotions) -> Array:
    """Return features (S, S, G) of ordered pairs of sensors; those of a sensor with itself mean nothing."""
    w, a = motions.w, motions.a
    speed, size = np.linalg.norm(w, axis=-1), np.linalg.norm(a, axis=-1)
    rise = np.gradient(speed, axis=0)
    w_c, a_c = w[..., 0] + 1j * w[..., 1], a[..., 0] + 1j * a[..., 1]
    turn, push = _coherence(w_c), _coherence(a_c)
    joint, gain, arm, heading = _common_joint(motions)
    both = [
        _correlations(speed, speed),
        _correlations(size, size),
        _correlations(w[..., 2], w[..., 2]),
        _correlations(a[..., 2], a[..., 2]),
        np.abs(turn),
        np.abs(push),
        gain,
        *_relative_turning(motions, heading),
        np.cos(np.angle(turn) - heading) * np.abs(turn),
        np.cos(np.angle(push) - heading) * np.abs(push),
        _lagged(speed),
        np.sin(np.angle(turn) - heading) * np.abs(turn),
    ]
    ordered = [
        joint,
        joint.T,
        arm,
        arm.T,
        _correlations(a[..., 2], speed),
        _correlations(speed, a[..., 2]),
        _correlations(w[..., 2], speed),
        _correlations(speed, w[..., 2]),
        _correlations(w[..., 2], rise),
        _correlations(rise, w[..., 2]),
        _correlations(w[..., 2], a[..., 2]),
        _correlations(a[..., 2], w[..., 2]),
        _correlations(w[..., 2], size),
        _correlations(size, w[..., 2]),
    ]
    return np.stack([*both, *ordered], axis=-1)


def _common_joint(motions: SensorMotions) -> tuple[Array, Array, Array, Array]:
    """Fit the point that two sensors have in common.

    Returns:
        For pairs (S, S): log of the unexplained acceleration over that of the first sensor; log of it over
        what a point at rest leaves of both; log distance, m, of the point from the first sensor; heading of
        the second sensor's reference in the first's, rad.
    """
    S, T = len(motions.names), len(motions)
    X = np.concatenate([motions.D, motions.a[..., None]], axis=-1)  # (T, S, 3, 4)
    x, y, z = (X[:, :, i].reshape(T, -1) / np.sqrt(T) for i in range(3))
    level, cross, upright = x.T @ x + y.T @ y, x.T @ y - y.T @ x, z.T @ z
    level, cross, upright = (G.reshape(S, 4, S, 4).transpose(0, 2, 1, 3) for G in (level, cross, upright))
    own = np.stack([level[s, s] + upright[s, s] for s in range(S)])
    size = own[:, 3, 3] + _NOISE**2
    ridge = (_NOISE / _LEVER) ** 2 * np.eye(6)
    arm = np.linalg.solve(own[:, :3, :3] + ridge[:3, :3], own[:, :3, 3:])[..., 0]
    alone = size - np.einsum("si,si->s", arm, own[:, :3, 3])
    a, b = np.triu_indices(S, 1)
    angles = 2 * np.pi / _HEADINGS * np.arange(_HEADINGS)
    cos, sin = np.cos(angles)[:, None, None, None], np.sin(angles)[:, None, None, None]
    C = cos * level[a, b] - sin * cross[a, b] + upright[a, b]
    M = np.empty((_HEADINGS, len(a), 6, 6))
    M[..., :3, :3], M[..., 3:, 3:] = own[a, :3, :3], own[b, :3, :3]
    M[..., :3, 3:], M[..., 3:, :3] = -C[..., :3, :3], -np.swapaxes(C[..., :3, :3], -1, -2)
    v = np.concatenate([C[..., :3, 3] - own[a, :3, 3], C[..., 3, :3] - own[b, :3, 3]], axis=-1)
    r = np.linalg.solve(M + ridge, v[..., None])[..., 0]
    rest = size[a] + size[b] - 2 * C[..., 3, 3] - np.einsum("hpi,hpi->hp", r, v)
    pick = (rest.argmin(axis=0), np.arange(len(a)))
    least = np.maximum(rest[pick], _NOISE**2)
    out = np.zeros((4, S, S))
    out[0, a, b], out[0, b, a] = np.log(least / size[a]), np.log(least / size[b])
    out[1, a, b] = out[1, b, a] = np.log(least / np.maximum(alone[a] + alone[b], _NOISE**2))
    out[2, a, b], out[2, b, a] = np.log(np.linalg.norm(r[pick].reshape(-1, 2, 3), axis=-1).T + 0.03)
    out[3, a, b], out[3, b, a] = angles[pick[0]], -angles[pick[0]]
    return out[0], out[1], out[2], out[3]


def _relative_turning(motions: SensorMotions, heading: Array) -> list[Array]:
    """Return log share and planarity (S, S) of the relative angular velocity at those headings."""
    S = len(motions.names)
    share, plane = np.zeros((2, S, S))
    every = motions.select(slice(None, None, 2))
    power = np.sum(every.w**2, axis=-1).mean(axis=0)
    for a in range(S):
        for b in range(a + 1, S):
            c, s = np.cos(heading[a, b]), np.sin(heading[a, b])
            x, y, z = every.w[:, b].T
            off = every.w[:, a] - np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
            of_off = np.sum(off**2, axis=-1).mean()
            share[a, b] = share[b, a] = np.log((of_off + _W0**2) / (power[a] + power[b] + 2 * _W0**2))
            own = np.einsum("tji,tj->ti", every.R[:, a], off)
            largest = np.linalg.eigvalsh(own.T @ own)
            plane[a, b] = plane[b, a] = largest[-1] / max(largest.sum(), 1e-9)
    return [share, plane]


def _lagged(speed: Array) -> Array:
    """Return the gain in correlation of speeds (T, S) when either is delayed by 0.2 to 0.8 s."""
    out = np.full((speed.shape[1], speed.shape[1]), -1.0)
    for lag in range(round(0.2 * RATE_HZ), round(0.8 * RATE_HZ) + 1, round(0.1 * RATE_HZ)):
        if lag < len(speed) // 2:
            late = _correlations(speed[lag:], speed[:-lag])
            out = np.maximum(out, np.maximum(late, late.T))
    return out - _correlations(speed, speed)


def _coherence(values: Array) -> Array:
    """Return (S, S) the complex correlation of (T, S) complex values; angle: first less second."""
    G = values.T @ values.conj()
    size = np.sqrt(np.abs(np.diag(G)) + 1e-9)
    return np.asarray(G / np.outer(size, size))


def _correlations(x: Array, y: Array) -> Array:
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    size = [np.linalg.norm(v, axis=0) + 1e-6 for v in (x, y)]
    return np.asarray(x.T @ y / np.outer(*size))


def _correlation(x: Array, y: Array) -> Array:
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    size = np.linalg.norm(x, axis=0) * np.linalg.norm(y, axis=0)
    return np.asarray(np.sum(x * y, axis=0) / (size + 1e-6))


def _mean_ratio(x: Array, size: Array) -> Array:
    return np.asarray(x.mean(axis=0) / (np.abs(size).mean(axis=0) + 1e-6))


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def _skewness(x: Array) -> Array:
    x = x - x.mean(axis=0)
    return np.asarray(np.cbrt(np.mean(x**3, axis=0)) / (_rms(x) + 1e-3))


def _shares(vectors: Array) -> Array:
    """Return (S, 3) shares of the principal axes in the power of vectors (T, S, 3), falling."""
    power = np.einsum("tsi,tsj->sij", vectors, vectors)
    values = np.linalg.eigvalsh(power)[:, ::-1]
    return np.asarray(values / (values.sum(axis=-1, keepdims=True) + 1e-9))
