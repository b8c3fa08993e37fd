"""Gains of all offsets between the clocks of a video and of sensors.

The angular velocity of a sensor in its own reference is that of its segment in world but for the heading h,
unknown but constant. With w_v of the image, w_s of the sensor and sums over the common time at an offset, the
best heading gives

    c = max_h sum w_v . Rz(h) w_s = |sum conj(x_v + i y_v) (x_s + i y_s)| + sum z_v z_s,

so all offsets at once take a few FFTs. The sensor then explains ``2 g c - g^2 sum |w_s|^2`` of the image's sum of
squares, with a factor g = c / sum |w_s|^2, limited as the image cannot show more than there is. The gain of an offset
is the log-likelihood ratio of this regression to none, the image's whole duration counted at every offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import scipy
from scipy import fft

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import angular_velocity

STEP: Final = 0.02  # [s] between samples
LEAST_SECONDS: Final = 2.0  # [s] Least time that a person is seen
_CUTOFF_HZ: Final = 5.0
_FASTEST = 6.0  # [rad/s] Faster turns are shortened to it: in the image they are mostly exchanged limbs
_LONGEST_GAP: Final = 0.2


@dataclass(frozen=True)
class AngularVelocities:
    """Angular velocities at even times, `STEP` apart."""

    start: float  # [s] Time of the first sample
    w_world: Array  # (T, N, 3) rad/s in world, or in each sensor's own reference; NaN where missing

    @property
    def known(self) -> Array:
        """(T, N) 1 where known, else 0."""
        return np.asarray(np.isfinite(self.w_world[..., 0]), dtype=float)

    def __getitem__(self, frames: slice) -> AngularVelocities:
        return AngularVelocities(self.start + STEP * (frames.start or 0), self.w_world[frames])

    def of(self, columns: Index | Sequence[int]) -> AngularVelocities:
        """Return some of the N."""
        return replace(self, w_world=self.w_world[:, columns])


def velocities_in_image(poses: PoseSequence, keypoints: KeypointSequence, skeleton: SkeletonModel) -> AngularVelocities:
    """Return the segments' angular velocities in world as an image shows them. `CalibrationError`: no person is seen
    for two seconds.
    """
    skeleton.check_joints(poses.names)
    shown = poses.valid.any(axis=1) & (keypoints.seen.mean(axis=1) > 0)
    R = np.where(shown[:, None, None, None], poses.R_world_bone, np.nan)
    out = angular_velocities(poses.times, R)
    seconds = STEP * float(out.known.any(axis=1).sum())
    if seconds < LEAST_SECONDS:
        raise CalibrationError(
            f"the video shows a person for {seconds:.1f} s, too short to find the sensors' clock by; "
            "check the detections, or use a longer video"
        )
    return out


def velocities_of_sensors(log: SensorLog) -> AngularVelocities:
    """Return sensors' angular velocities (T, S, 3), each in its own reference."""
    first = min(stream.times[0] for stream in log.streams)
    last = max(stream.times[-1] for stream in log.streams)
    grid = _grid(first, last)
    columns = []
    for stream in log.streams:
        assert stream.R_inertial_sensor is not None
        columns.append(angular_velocities(stream.times, stream.R_inertial_sensor[:, None], grid).w_world)
    return AngularVelocities(float(grid[0]), np.concatenate(columns, axis=1))


def joined(parts: Sequence[AngularVelocities]) -> AngularVelocities:
    """Return parts of one recording on one grid; NaN between them."""
    if len(parts) == 1:
        return parts[0]
    start = min(part.start for part in parts)
    firsts = [round((part.start - start) / STEP) for part in parts]
    stop = max(first + len(part.w_world) for first, part in zip(firsts, parts, strict=True))
    out = np.full((stop, *parts[0].w_world.shape[1:]), np.nan)
    for first, part in zip(firsts, parts, strict=True):
        out[first : first + len(part.w_world)] = part.w_world
    return AngularVelocities(start, out)


def _grid(first: float, last: float) -> Array:
    """Multiples of `STEP` from one time to another."""
    return np.asarray(STEP * np.arange(np.ceil(first / STEP - 1e-6), last / STEP + 1e-6))


def angular_velocities(times: Array, R: Array, grid: Array | None = None) -> AngularVelocities:
    """Return angular velocities of R (T, N, 3, 3) at times (T,) on a grid of `STEP`; default: all multiples of it."""
    grid = _grid(float(times[0]), float(times[-1])) if grid is None else grid
    R = signals.interpolate_rotations(times, R, grid, _LONGEST_GAP)
    w = np.stack([angular_velocity(grid, one) for one in R.swapaxes(0, 1)], axis=1)
    w *= np.minimum(1.0, _FASTEST / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-9))
    smooth = [signals.low_pass_known(grid, one, _CUTOFF_HZ) for one in w.swapaxes(0, 1)]
    return AngularVelocities(float(grid[0]), np.stack(smooth, axis=1))


_COARSE = 2  # Samples per step where segments are unknown
_LEAST_COMMON = 2.0  # [s] Least overlap, or half of the shorter recording
_LARGEST_FACTOR: Final = 1.3
_MEMORY = 0.25  # [s] Correlation time of the image's errors
_UNSEEN = 0.15  # [rad/s] per axis: motion that the image cannot tell from none
_CANDIDATES: Final = 5
_ASSIGNED = 40  # Offsets for which sensors of unknown places are assigned one to one
_BELIEF = 0.1  # [1] Weight of a log-likelihood, as errors are autocorrelated and model errors common to all offsets
_SIGMA_FACTOR = 1.5  # [1] Actual errors of offsets relative to the width of the likelihood's peak
SIGMA_LEAST: Final = 0.002  # [s] Least standard deviation of an offset


@dataclass(frozen=True)
class ClockScan:
    """Gains of all offsets, nats of all sensors, and what follows at the best one."""

    scan: OffsetScan
    segments: Index  # (S,) segment of each sensor at the best offset; -1 for none, where there are more sensors
    peaks: tuple[tuple[float, float], ...]  # Best offsets, s, `APART` from each other, and their gains, the best first
    explained: float  # [1] Mean part of the image's motion explained at the best offset, of the common time

    @classmethod
    def of(
        cls, seen: AngularVelocities, sensed: AngularVelocities, around: float, reach: float, known: bool = True
    ) -> Self:
        """Scan the offsets from around - reach to around + reach. `CalibrationError`: no offset has enough overlap.

        Args:
            seen: (T, N) segments. sensed: (T', S) sensors. around, reach: s.
            known: sensors are on the segments in their order; else on the best ones at each offset.
        """
        S, every = sensed.w_world.shape[1], 1 if known else _COARSE
        offsets, lags = _offsets(seen, sensed, around, reach, every)
        tables = []
        for s in range(S):
            own = [s] if known else slice(None)
            v, w = seen.w_world[::every, own], sensed.w_world[::every, [s]]
            tables.append(_gains(v, w, every * STEP)[:, lags].astype(np.float32))
        scan = OffsetScan(offsets, np.sum([gain.max(axis=-1) for gain, _ in tables], axis=0, dtype=float))
        found = []
        for k in scan.peaks(_CANDIDATES if known else _ASSIGNED):
            table = np.array([gain[k] for gain, _ in tables], dtype=float)
            segments = np.full(S, 0 if known else -1)
            if not known:  # each segment is taken once
                rows, columns = scipy.optimize.linear_sum_assignment(-table)
                segments[rows] = columns
            worn = np.flatnonzero(segments >= 0)
            found.append((float(table[worn, segments[worn]].sum()), k, segments))
        found.sort(key=lambda peak: -peak[0])
        _, best, segments = found[0]
        parts = [tables[s][1][best, j] for s, j in enumerate(segments) if j >= 0]
        peaks = tuple((float(offsets[k]), gain) for gain, k, _ in found[:_CANDIDATES])
        segments = np.arange(S) if known else segments
        return cls(replace(scan, peak=best), segments, peaks, float(np.mean(parts)))

    @property
    def margin(self) -> float:
        """[nats] of the best offset to the next one; see `ClockEstimate.margin`."""
        gains = [gain for _, gain in self.peaks] + [0.0]
        return float(_BELIEF * (gains[0] - gains[1]) / np.sqrt(np.sum(self.segments >= 0)))

    def rivals(self, share: float) -> tuple[float, ...]:
        """Return other offsets whose gains are larger than a share of the best one's, s, the best first."""
        return tuple(offset for offset, gain in self.peaks[1:] if gain > share * self.peaks[0][1])

    @property
    def sigma(self) -> float:
        """[s] Standard deviation of the best offset."""
        return float(np.hypot(_SIGMA_FACTOR * self.scan.sigma, SIGMA_LEAST))


def _offsets(
    seen: AngularVelocities, sensed: AngularVelocities, around: float, reach: float, every: int
) -> tuple[Array, Index]:
    """Offsets within reach with enough overlap, and their places in the result of `_gains`."""
    Tv, Ts = len(seen.w_world[::every]), len(sensed.w_world[::every])
    lags = np.arange(-(Tv - 1), Ts)  # video frame i beside sensor sample i + lag
    common = every * STEP * (np.minimum(Tv + lags, Ts) - np.maximum(lags, 0))
    offsets = seen.start - sensed.start - every * STEP * lags
    least = min(_LEAST_COMMON, every * STEP * min(Tv, Ts) / 2)
    kept = (common >= least) & (np.abs(offsets - around) <= reach)
    if not kept.any():
        raise CalibrationError(
            f"video and sensors have no {least:.1f} s in common at any offset within {reach:g} s of "
            f"{around:g} s; search further (reach), or check that they are of the same time"
        )
    return offsets[kept], lags[kept]


def _gains(seen: Array, sensed: Array, step: float) -> Array:
    """Gain and part of the common motion explained (2, n, N) of seen (Tv, N, 3) by sensed (Ts, 1, 3).

    The places along n are lags modulo n.
    """
    n = fft.next_fast_len(len(seen) + len(sensed))
    known_v, known_s = (np.isfinite(w).all(axis=-1).astype(float) for w in (seen, sensed))
    v, s = np.nan_to_num(seen), np.nan_to_num(sensed)

    def sums(a: Array, b: Array) -> Array:
        return np.asarray(fft.ifft(np.conj(fft.fft(a, n, axis=0)) * fft.fft(b, n, axis=0), axis=0))

    level = sums(v[..., 0] + 1j * v[..., 1], s[..., 0] + 1j * s[..., 1])
    alike = np.abs(level) + sums(v[..., 2], s[..., 2]).real
    own = np.maximum(sums(known_v, (s**2).sum(axis=-1)).real, 1e-3)
    factor = np.clip(alike / own, 0, _LARGEST_FACTOR)
    shown = (v**2).sum(axis=-1) + 3 * _UNSEEN**2 * known_v
    explained = 2 * factor * alike - factor**2 * own
    of_all = np.clip(explained / (shown.sum(axis=0) + 1e-9), 0, 0.999)
    of_common = explained / np.maximum(sums(shown, known_s).real, 1e-3)
    return np.stack([-1.5 * known_v.sum(axis=0) * step / _MEMORY * np.log1p(-of_all), of_common])
