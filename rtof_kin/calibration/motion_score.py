"""Learned scores of which segments sensors are on, ``models/assignment.npz``, in NumPy.

A network of one hidden layer scores each sensor on each segment, another each pair of sensors on each pair of
segments; ``models/build_assignment.py`` trains them. The sum of the scores of an assignment is its
log-probability up to a constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.over_time import OverTime
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import angular_velocity
from rtof_kin.inertial.orientation import with_orientation

RATE_HZ: Final = 50.0  # Of `SensorMotions`
_SIGNALS_HZ = 6.0  # of all signals
_BRIDGED = 0.1  # [s] that is interpolated
_LEAST_COMMON = 1.0  # of common time
_TILTED_DEG = 10.0  # [deg] of the mean specific force from up, from which an orientation is not believed


@dataclass(frozen=True, eq=False)
class SensorMotions(OverTime):
    """Motion of S sensors at T times, each in its own inertial reference with z up."""

    names: tuple[str, ...]  # S sensors
    times: Array  # (T,) s, on the log's clock; steps of 1 / `RATE_HZ` but where recordings were joined
    R: Array  # (T, S, 3, 3) R_inertial_sensor
    w: Array  # (T, S, 3) angular velocity, rad/s
    a: Array  # (T, S, 3) acceleration, m/s^2; NaN where the sensor has none
    D: Array  # (T, S, 3, 3) second derivative of R, 1/s^2: a point r of the sensor's body accelerates by a + D r
    rows = ("R", "w", "a", "D")

    @property
    def accelerated(self) -> bool:
        """Whether every sensor measured accelerations."""
        return bool(np.isfinite(self.a).all())


def sensor_motions(log: SensorLog) -> SensorMotions:
    """Return the motion of the sensors over the time that all of them recorded. `InvalidInputError`: no common time, or
    a sensor without orientation that has no raw samples either.
    """
    if not log.streams:
        raise InvalidInputError(f"{log.path} has no sensor; name a file or folder with sensor data")
    start, stop = max(s.times[0] for s in log.streams), min(s.times[-1] for s in log.streams)
    if stop - start < _LEAST_COMMON:
        raise InvalidInputError(
            f"the {len(log.streams)} sensors of {log.path} have {max(stop - start, 0):.1f} s in common; "
            f"{_LEAST_COMMON:g} s at least are needed: record them together, on one clock"
        )
    times = np.arange(start, stop, 1 / RATE_HZ)
    parts = [_motion(_oriented(stream), times) for stream in log.streams]
    R, w, a, D = (np.stack(field, axis=1) for field in zip(*parts, strict=True))
    motions = SensorMotions(log.names, times, R, w, a, D)
    accelerated = [np.isfinite(a[:, s]).any() for s in range(len(log.names))]
    known = np.isfinite(D).all(axis=(1, 2, 3)) & np.isfinite(w).all(axis=(1, 2))
    known &= np.isfinite(a[:, accelerated]).all(axis=(1, 2))
    if known.sum() < _LEAST_COMMON * RATE_HZ:
        raise InvalidInputError(
            f"the sensors of {log.path} have samples together for {known.sum() / RATE_HZ:.1f} s only; "
            "rtof-kin inspect lists their gaps"
        )
    return motions[np.flatnonzero(known)]


def _oriented(stream: SensorStream) -> SensorStream:
    """Return the stream with an orientation that agrees with gravity, estimated where the file has none."""
    f, R = stream.f_sensor, stream.R_inertial_sensor
    raw = f is not None and stream.w_sensor is not None
    if R is None:
        return with_orientation(stream)
    if f is not None and raw:
        up = np.nanmean(np.einsum("tij,tj->ti", R, f), axis=0)
        if np.degrees(np.arccos(np.clip(so3.unit(up)[2], -1, 1))) > _TILTED_DEG:
            return with_orientation(stream)
    return stream


def _motion(stream: SensorStream, times: Array) -> tuple[Array, Array, Array, Array]:
    assert stream.R_inertial_sensor is not None
    R = signals.interpolate_rotations(stream.times, stream.R_inertial_sensor[:, None], times, _BRIDGED)
    flat = signals.low_pass_known(times, R.reshape(len(times), 9), _SIGNALS_HZ)
    smooth = flat.reshape(len(times), 3, 3)
    D, w = np.full_like(smooth, np.nan), np.full((len(times), 3), np.nan)
    D[1:-1] = (smooth[2:] - 2 * smooth[1:-1] + smooth[:-2]) * RATE_HZ**2
    turn = (smooth[2:] - smooth[:-2]) * (RATE_HZ / 2) @ np.swapaxes(smooth[1:-1], -1, -2)
    w[1:-1] = (
        np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1)
        / 2
    )
    if stream.f_sensor is None:
        return R[:, 0], w, np.full((len(times), 3), np.nan), D
    f = np.asarray(np.einsum("tij,tj->ti", stream.R_inertial_sensor, stream.f_sensor))
    f = signals.low_pass_known(stream.times, f, min(3 * _SIGNALS_HZ, 0.45 * stream.rate_hz))
    a = signals.interpolate(stream.times, f, times, _BRIDGED) + GRAVITY_WORLD
    return R[:, 0], w, signals.low_pass_known(times, a, _SIGNALS_HZ), D


_LEVER = 0.2  # [m] usual distance of a sensor from a joint of its segment
_NOISE = 0.3  # [m/s^2] of an acceleration
_HEADINGS = 24  # Differences of headings tried, evenly from 0
_W0, _A0 = 0.05, 0.1  # [rad/s], [m/s^2] added to sizes: rest
_LEAST = 1e-30  # Ratio of a sensor that does not move at all


def single_features(motions: SensorMotions) -> Array:
    """Return features (S, F) of each sensor.

    Sizes and spectra of angular velocity and acceleration, changes of inclination, how planar the rotation is, and how
    its vertical part goes with the rest (odd features: they mirror with the side of the body). Ideas: Weenk et al.
    (2013), statistics by correlation and rank; Graurock, Schauer and Seel (2016), gait; Zimmermann, Taetz and Bleser
    (2018), learned from motion capture.
    """
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
        *(np.log(_rms(x) + rest) for x, rest in ((w_z, _W0), (w_h, _W0), (a_z, _A0), (a_h, _A0))),
        np.log(_rms(turning) / (_rms(speed) + _W0) + 0.1),
        np.log(_rms(jerk) / (_rms(size) + _A0) + 0.1),
        np.log(tilt + 1e-3),
        *(shares[:, i] for shares in (tilts, about) for i in (0, 1)),
        np.log(np.maximum(_rms(speed**2) / (_rms(speed) ** 2 + _W0**2), _LEAST)),
        np.log(np.maximum(_rms(size**2) / (_rms(size) ** 2 + _A0**2), _LEAST)),
        np.log((np.quantile(speed, 0.2, axis=0) + 0.02) / (_rms(speed) + _W0)),
        np.log((np.quantile(size, 0.2, axis=0) + 0.05) / (_rms(size) + _A0)),
        _skewness(a_z),
        *(_correlation(x, y) for x, y in ((a_z, speed), (a_z, size), (speed, size))),
        _mean_ratio(cross, w_h * a_h),
        _correlation(np.abs(w_z), w_h),
        np.log(_rms(np.gradient(a_z, axis=0) * RATE_HZ) / (_rms(a_z) + _A0) + 0.1),
    ]
    rise = np.gradient(speed, axis=0)
    odd = [
        _skewness(w_z),
        *(_correlation(w_z, x) for x in (w_h, a_z, size, rise)),
        *(_correlation(dot, x) for x in (w_h, a_z)),
        _mean_ratio(dot, speed * size),
    ]
    return np.stack([*even, *odd], axis=-1)


def pair_features(motions: SensorMotions) -> Array:
    """Return features (S, S, G) of ordered pairs of sensors; those of a sensor with itself mean nothing."""
    w, a = motions.w, motions.a
    speed, size = np.linalg.norm(w, axis=-1), np.linalg.norm(a, axis=-1)
    rise = np.gradient(speed, axis=0)
    w_c, a_c = w[..., 0] + 1j * w[..., 1], a[..., 0] + 1j * a[..., 1]
    turn, push = _coherence(w_c), _coherence(a_c)
    joint, gain, arm, heading = _common_joint(motions)
    w_z, a_z = w[..., 2], a[..., 2]
    # The gain in correlation of speeds (T, S) when either is delayed by 0.2 to 0.8 s.
    lagged = np.full((speed.shape[1], speed.shape[1]), -1.0)
    for lag in range(round(0.2 * RATE_HZ), round(0.8 * RATE_HZ) + 1, round(0.1 * RATE_HZ)):
        if lag < len(speed) // 2:
            late = _correlations(speed[lag:], speed[:-lag])
            lagged = np.maximum(lagged, np.maximum(late, late.T))
    both = [
        *(_correlations(x, x) for x in (speed, size, w_z, a_z)),
        np.abs(turn),
        np.abs(push),
        gain,
        *_relative_turning(motions, heading),
        np.cos(np.angle(turn) - heading) * np.abs(turn),
        np.cos(np.angle(push) - heading) * np.abs(push),
        lagged - _correlations(speed, speed),
        np.sin(np.angle(turn) - heading) * np.abs(turn),
    ]
    crossed = ((a_z, speed), (w_z, speed), (w_z, rise), (w_z, a_z), (w_z, size))
    ordered = [joint, joint.T, arm, arm.T, *(_correlations(*way) for x, y in crossed for way in ((x, y), (y, x)))]
    return np.stack([*both, *ordered], axis=-1)


def _common_joint(motions: SensorMotions) -> tuple[Array, Array, Array, Array]:
    """Fit the point that two sensors have in common, the joint of neighbouring segments.

    After Seel, Schauer and Raisch (2012): one point fixed to both explains the accelerations of both. With orientations
    this is linear least squares at every difference of headings.

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
    every = motions[::2]
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


_LARGEST = 4.0  # [standard deviations] to which features are cut


@dataclass(frozen=True, eq=False)
class MotionScore:
    """Scores of sensors on segments by their motion."""

    segments: tuple[str, ...]  # K segments that the scores know
    weights: Mapping[str, Array]  # Layers and scales of features by name

    @classmethod
    def load(cls, path: str | Path | None = None) -> MotionScore:
        """Read a file of ``models/build_assignment.py``, by default the shipped one; `FileFormatError` for another
        file.
        """
        arrays = read_npz_as_saved(model_path("assignment.npz") if path is None else Path(path), kinds="fiubU")
        segments = tuple(str(name) for name in arrays.pop("segments"))
        return cls(segments, {name: values.astype(np.float64) for name, values in arrays.items()})

    def tables(self, motions: SensorMotions, segments: Sequence[str]) -> tuple[Array, Array]:
        """Return scores, nats, of sensors (S, K) and of ordered pairs (S, S, K, K), 0 of one with itself;
        `UnknownNameError` for a segment that is not known.
        """
        keep = indices_of("segment", segments, self.segments)
        f = self._scaled("single", single_features(motions))
        g = self._scaled("pair", pair_features(motions))
        S, K = len(f), len(self.segments)
        both = [np.broadcast_to(f[:, None], (S, *f.shape)), np.broadcast_to(f, (S, *f.shape)), g]
        pair = self._layers("pair", np.concatenate(both, axis=-1)).reshape(S, S, K, K)
        pair = (pair + pair.transpose(1, 0, 3, 2)) / 2
        pair[np.arange(S), np.arange(S)] = 0.0
        return self._layers("single", f)[:, keep], pair[..., keep, :][..., keep]

    def _scaled(self, name: str, features: Array) -> Array:
        off = (features - self.weights[f"{name}_mean"]) / self.weights[f"{name}_sd"]
        return np.asarray(np.clip(off, -_LARGEST, _LARGEST))

    def _layers(self, name: str, x: Array) -> Array:
        w = self.weights
        hidden = np.maximum(x @ w[f"{name}_weight0"].T + w[f"{name}_bias0"], 0)
        return np.asarray(hidden @ w[f"{name}_weight1"].T + w[f"{name}_bias1"])


@cache
def shipped_score() -> MotionScore:
    """Return the shipped scores, read once."""
    return MotionScore.load()


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

    On a segment it has ``Rz(h) R_inertial_sensor(t) R_sensor_bone = R_world_bone(t)`` for one heading h and one
    mounting, and ``Rz(h) w_inertial(t) = w_world(t)`` for any mounting. At each heading the best mounting follows in
    closed form (Wahba 1965), and the heading from a grid, refined once. `InvalidInputError`: poses and sensors have no
    two seconds in common.
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
    smooth = partial(signals.low_pass_known, motions.times, cutoff_hz=_CUTOFF_HZ)
    w_bone = np.stack([smooth(angular_velocity(motions.times, R)) for R in R_bone.swapaxes(0, 1)], axis=1)
    w = smooth(motions.w.reshape(len(motions), -1)).reshape(motions.w.shape)
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
