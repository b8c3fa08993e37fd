"""Offset and drift between the clocks of a video and of sensors, from angular velocities over everything.

A sensor and the segment that carries it have the same angular velocity in world, whatever the mounting. In
the sensor's own reference it is that in world but for the heading h, unknown but constant. With w_v of the
image, w_s of the sensor and sums over the common time at an offset, the best heading gives

    c = max_h sum w_v . Rz(h) w_s = |sum conj(x_v + i y_v) (x_s + i y_s)| + sum z_v z_s,

so all offsets at once take a few FFTs. The sensor then explains ``2 g c - g^2 sum |w_s|^2`` of the image's
sum of squares, with a factor g = c / sum |w_s|^2, limited as the image cannot show more than there is. The
gain of an offset is the log-likelihood ratio of this regression to none, the image's whole duration counted
at every offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy import fft
from scipy.optimize import linear_sum_assignment

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import orientation_rate
from rtof_kin.inertial.orientation import log_with_orientation

STEP: Final = 0.02
"""[s] of the scan."""
_COARSE: Final = 2
"""Steps of the scan over segments."""
_CUTOFF_HZ: Final = 5.0
_FASTEST: Final = 6.0
"""[rad/s] Faster turns are shortened to it: in the image they are mostly exchanged limbs."""
_LONGEST_GAP: Final = 0.2
_LARGEST_FACTOR: Final = 1.3
_MEMORY: Final = 0.25
"""[s] Correlation time of the image's errors."""
_UNSEEN: Final = 0.15
"""[rad/s] per axis: motion that the image cannot tell from none."""
_STILL: Final = 0.15
"""[rad/s] 95th percentile of the angular speed of a sensor at rest."""
_LEAST_COMMON: Final = 2.0
"""[s] Least overlap, or half of the shorter recording."""
_APART: Final = 0.35
"""[s] Least distance of another offset."""
SURE: Final = 4.0
"""[nats] Least margin of an offset that is not in doubt; see `ClockEstimate.margin`."""
_RIVAL: Final = 0.5
"""[1] Gain of another offset, relative to the best one, from which the motion repeats itself."""
_AGREEING: Final = 0.2
"""[1] Least part of the image's motion that the sensors explain; of another motion up to 0.2 in 20 s."""
_BELIEF: Final = 0.1
"""[1] Weight of a log-likelihood, as errors are autocorrelated and model errors common to all offsets."""
_CANDIDATES: Final = 5
_ASSIGNED: Final = 40
"""Offsets for which sensors of unknown places are assigned one to one."""
_WINDOW: Final = 20.0
"""[s] of the recording for one offset of the drift, of which `_WINDOWS` at least are needed."""
_WINDOWS: Final = 3
_WINDOW_REACH: Final = 0.2
_SIGMA_DRIFT: Final = 60e-6
"""[s/s] Standard deviation of clocks' drifts."""
_SIGMA_FACTOR: Final = 1.5
"""[1] Actual errors of offsets relative to the width of the likelihood's peak."""
_SIGMA_LEAST: Final = 0.002


@dataclass(frozen=True)
class ClockEstimate:
    """Clock of a video relative to sensors: ``t_video = t_sensor + offset + drift (t_sensor - middle)``."""

    offset: float
    """[s] At `middle`."""
    drift: float
    """[s/s] 0 where the recording is too short to tell."""
    sigma: float
    """[s] Standard deviation of the offset."""
    margin: float
    """[nats] of the best offset to the next one, per independent sensor and with allowance for correlated
    errors."""
    doubt: str = ""
    """What may be wrong and what to do, in a sentence; empty if the offset is sure."""
    sigma_drift: float = _SIGMA_DRIFT
    """[s/s] Standard deviation of the drift."""
    middle: float = 0.0
    """[s] Middle of the common time, on the sensors' clock."""
    candidates: tuple[float, ...] = ()
    """[s] Other offsets that explain the motion nearly as well, the best first."""
    joints: dict[str, str] = field(default_factory=dict)
    """Segment of each sensor that moves most like it at this offset, or the one given."""

    def apply(self, log: SensorLog) -> SensorLog:
        """Return sensors on the video's clock.

        Args:
            log: on the sensors' clock.
        """
        moved = (
            replace(s, times=s.times + self.offset + self.drift * (s.times - self.middle))
            for s in log.streams
        )
        return replace(log, streams=tuple(moved))


@dataclass(frozen=True)
class Turning:
    """Angular velocities at even times, `STEP` apart."""

    start: float
    """[s] Time of the first sample."""
    w_world: Array
    """(T, N, 3) rad/s in world, or in each sensor's own reference; NaN where missing."""

    @property
    def known(self) -> Array:
        """(T, N) 1 where known, else 0."""
        return np.asarray(np.isfinite(self.w_world[..., 0]), dtype=float)

    def __getitem__(self, frames: slice) -> Turning:
        return Turning(self.start + STEP * (frames.start or 0), self.w_world[frames])

    def of(self, columns: Index | list[int]) -> Turning:
        """Return some of the N.

        Args:
            columns: their indices.
        """
        return replace(self, w_world=self.w_world[:, columns])


def find_clock(
    poses: PoseSequence,
    keypoints: KeypointSequence,
    log: SensorLog,
    skeleton: SkeletonModel,
    joints: Mapping[str, str] | None = None,
    *,
    around: float = 0.0,
    reach: float = 600.0,
) -> ClockEstimate:
    """Estimate the clock of a video relative to sensors.

    A detector's delay counts as part of the offset, as nothing tells one from the other.

    Args:
        poses: lifted from the keypoints, at their times. keypoints: T frames. skeleton: of the poses.
        log: sensors on their own clock, at any rates; orientation is estimated where a stream has none.
        joints: sensor -> segment that carries it; other sensors are ignored. None: unknown, all are used.
        around, reach: offsets from around - reach to around + reach are searched, s.

    Raises:
        UnknownNameError: an unknown sensor or segment.
        CalibrationError: no sensor moves, nobody is seen for long enough, or no offset has an overlap.
        InvalidInputError: a sensor has neither orientation nor what it is estimated from.
    """
    seen = image_turning(poses, keypoints, skeleton)
    if joints is not None:
        log = log.select(list(joints))
    carriers = _carriers(skeleton, joints)
    log = _within(log, poses.times[0] - around - reach, poses.times[-1] - around + reach)
    sensed = _moving(sensor_turning(log_with_orientation(log)))
    seen = seen.of(skeleton.index(*carriers))
    chosen = None if joints is None else np.arange(len(carriers))
    scan = _Scan.of(seen, sensed, around, reach, chosen)
    worn = np.flatnonzero(scan.pairs >= 0)
    pairs = scan.pairs[worn]
    seen, sensed = seen.of(pairs), sensed.of(worn)
    if joints is None:  # now at the full resolution, with the segments found
        found = _Scan.of(seen, sensed, scan.best, 2 * _APART, np.arange(len(pairs)))
        scan = replace(scan, offsets=found.offsets, gains=found.gains)
    line = _line(seen, sensed, scan)
    return replace(
        line,
        margin=scan.margin,
        doubt=_doubt(scan, around, reach),
        candidates=tuple(float(o) for o, gain in scan.others if gain > _RIVAL * scan.gain),
        joints={log.names[s]: carriers[j] for s, j in zip(worn, pairs, strict=True)},
    )


def image_turning(poses: PoseSequence, keypoints: KeypointSequence, skeleton: SkeletonModel) -> Turning:
    """Return the segments' angular velocities in world as an image shows them.

    Args:
        poses: lifted, at the keypoints' times. keypoints: T frames. skeleton: of the poses.

    Raises:
        CalibrationError: nobody is seen for two seconds.
    """
    skeleton.check_joints(poses.names)
    shown = poses.valid.any(axis=1) & (keypoints.seen.mean(axis=1) > 0)
    R = np.where(shown[:, None, None, None], poses.R_world_bone, np.nan)
    out = _turning(poses.times, R)
    seconds = STEP * float(out.known.any(axis=1).sum())
    if seconds < _LEAST_COMMON:
        raise CalibrationError(
            f"the video shows a person for {seconds:.1f} s, too short to find the sensors' clock by; "
            "check the detections, or use a longer video"
        )
    return out


def sensor_turning(log: SensorLog) -> Turning:
    """Return sensors' angular velocities (T, S, 3), each in its own reference.

    Args:
        log: with orientation.
    """
    first = min(stream.times[0] for stream in log.streams)
    last = max(stream.times[-1] for stream in log.streams)
    grid = np.arange(first, last + STEP / 2, STEP)
    columns = []
    for stream in log.streams:
        assert stream.R_inertial_sensor is not None
        columns.append(_turning(stream.times, stream.R_inertial_sensor[:, None], grid).w_world)
    return Turning(float(first), np.concatenate(columns, axis=1))


def _turning(times: Array, R: Array, grid: Array | None = None) -> Turning:
    """Angular velocities of orientations (T, N, 3, 3) on a grid."""
    grid = np.arange(times[0], times[-1] + STEP / 2, STEP) if grid is None else grid
    R = signals.interpolate_rotations(times, R, grid, _LONGEST_GAP)
    w = np.stack(
        [np.einsum("tij,tj->ti", one, orientation_rate(grid, one)) for one in R.swapaxes(0, 1)], axis=1
    )
    w *= np.minimum(1.0, _FASTEST / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-9))
    smooth = [signals.low_pass_known(grid, one, _CUTOFF_HZ) for one in w.swapaxes(0, 1)]
    return Turning(float(grid[0]), np.stack(smooth, axis=1))


def _carriers(skeleton: SkeletonModel, joints: Mapping[str, str] | None) -> list[str]:
    """Segments that carry sensors, or may."""
    if joints is None:
        return sorted({joint for joint, _ in skeleton.sensors.values()}, key=skeleton.names.index)
    indices_of("segment", list(joints.values()), skeleton.names)
    return list(joints.values())


def _within(log: SensorLog, start: float, stop: float) -> SensorLog:
    """The part of a log that can overlap with the video."""
    kept = []
    for stream in log.streams:
        a, b = np.searchsorted(stream.times, [start, stop])
        if b - a < 2:
            raise CalibrationError(
                f"sensor {stream.name} has no samples from {start:.0f} to {stop:.0f} s, where the video "
                "could be: search further (reach), or check that both are of the same time"
            )
        arrays = {name: getattr(stream, name)[a:b] for name in ("times", *stream.holds)}
        kept.append(replace(stream, **arrays, quaternion_norm=None))
    return replace(log, streams=tuple(kept))


def _moving(sensed: Turning) -> Turning:
    speed = np.linalg.norm(sensed.w_world, axis=-1)
    known = np.isfinite(speed).any(axis=1)
    fastest = float(np.nanpercentile(np.nanmax(speed[known], axis=1), 95)) if known.any() else 0.0
    if fastest < _STILL:
        raise CalibrationError(
            f"no sensor turns faster than {np.degrees(fastest):.1f} deg/s: they do not move, so that nothing "
            "relates them to the video; check that these are the sensors worn in it"
        )
    return sensed


@dataclass(frozen=True)
class _Scan:
    """Gains of all offsets."""

    offsets: Array
    """(K,) [s]."""
    gains: Array
    """(K,) [nats] of all sensors."""
    pairs: Index
    """(S,) segment of each sensor at the best offset; -1 for none, where there are more sensors."""
    peaks: tuple[tuple[float, float], ...]
    """Best offsets, `_APART` from each other, and their gains, the best first."""
    explained: float
    """[1] Mean part of the image's motion explained at the best offset."""

    @classmethod
    def of(cls, seen: Turning, sensed: Turning, around: float, reach: float, pairs: Index | None) -> _Scan:
        """Scan offsets.

        Args:
            seen, sensed: video and sensors. around, reach: of the offsets.
            pairs: (S,) segment of each sensor; None: the best ones at each offset.
        """
        every = 1 if pairs is not None else _COARSE
        offsets, inside = _offsets(seen, sensed, around, reach, every)
        S = sensed.w_world.shape[1]
        gains, explained = [], []
        for s in range(S):
            own = slice(None) if pairs is None else [int(pairs[s])]
            v, w = seen.w_world[::every, own], sensed.w_world[::every, [s]]
            gain, part = _gains(v, w, every * STEP)
            gains.append(gain[inside].astype(np.float32))
            explained.append(part[inside].astype(np.float32))
        total = np.sum([gain.max(axis=1) for gain in gains], axis=0, dtype=float)
        peaks = []
        for k in _peaks(offsets, total, _CANDIDATES if pairs is not None else _ASSIGNED):
            table = np.array([gain[k] for gain in gains], dtype=float)
            own = _assigned(table) if pairs is None else np.zeros(S, dtype=np.intp)
            sensors = np.flatnonzero(own >= 0)
            peaks.append((float(table[sensors, own[sensors]].sum()), k, own))
        gain, k, own = max(peaks, key=lambda peak: peak[0])
        parts = [explained[s][k, j] for s, j in enumerate(own) if j >= 0]
        order = sorted(((float(offsets[k]), gain) for gain, k, _ in peaks), key=lambda peak: -peak[1])
        pairs = own if pairs is None else pairs
        return cls(offsets, total, pairs, tuple(order[:_CANDIDATES]), float(np.mean(parts)))

    @property
    def best(self) -> float:
        return self.peaks[0][0]

    @property
    def gain(self) -> float:
        return self.peaks[0][1]

    @property
    def others(self) -> tuple[tuple[float, float], ...]:
        return self.peaks[1:]

    @property
    def margin(self) -> float:
        second = self.peaks[1][1] if len(self.peaks) > 1 else 0.0
        return float(_BELIEF * (self.gain - second) / np.sqrt(len(self.pairs)))

    @property
    def peak(self) -> tuple[float, float]:
        """Best offset by a parabola, and its standard deviation, s."""
        return _parabola(self.offsets, self.gains, self.best)


def _assigned(table: Array) -> Index:
    """Segment (S,) of each sensor with the largest sum of gains (S, N), each taken once; -1 for none."""
    out = np.full(len(table), -1, dtype=np.intp)
    rows, columns = linear_sum_assignment(-table)
    out[rows] = columns
    return out


def _offsets(seen: Turning, sensed: Turning, around: float, reach: float, every: int) -> tuple[Array, Index]:
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


def _gains(seen: Array, sensed: Array, step: float) -> tuple[Array, Array]:
    """Gain and part explained (n, N) at each lag (modulo n) of seen (Tv, N, 3) by sensed (Ts, 1 or N, 3)."""
    n = fft.next_fast_len(len(seen) + len(sensed))
    known_v = np.isfinite(seen).all(axis=-1).astype(float)
    v, s = np.nan_to_num(seen), np.nan_to_num(sensed)

    def sums(a: Array, b: Array) -> Array:
        return np.asarray(fft.ifft(np.conj(fft.fft(a, n, axis=0)) * fft.fft(b, n, axis=0), axis=0))

    level = sums(v[..., 0] + 1j * v[..., 1], s[..., 0] + 1j * s[..., 1])
    alike = np.abs(level) + sums(v[..., 2], s[..., 2]).real
    own = np.maximum(sums(known_v, (s**2).sum(axis=-1)).real, 1e-3)
    factor = np.clip(alike / own, 0, _LARGEST_FACTOR)
    count = known_v.sum(axis=0)
    whole = (v**2).sum(axis=(0, 2)) + 3 * _UNSEEN**2 * count + 1e-9
    explained = np.clip((2 * factor * alike - factor**2 * own) / whole, 0, 0.999)
    return -1.5 * count * step / _MEMORY * np.log1p(-explained), explained


def _peaks(offsets: Array, gains: Array, most: int) -> list[int]:
    """Places of the largest gains, `_APART` from each other."""
    left, out = gains.copy(), []
    while len(out) < most and np.isfinite(left.max()):
        k = int(np.argmax(left))
        out.append(k)
        left[np.abs(offsets - offsets[k]) < _APART] = -np.inf
    return out


def _parabola(offsets: Array, gains: Array, best: float) -> tuple[float, float]:
    """Vertex of the parabola through a maximum and its neighbours, and its standard deviation, s."""
    k = int(np.argmin(np.abs(offsets - best)))
    if not 0 < k < len(gains) - 1:
        return float(offsets[k]), STEP
    before, most, after = gains[k - 1 : k + 2]
    step = offsets[k + 1] - offsets[k]
    curvature = min(float(before - 2 * most + after), -1e-6)
    vertex = offsets[k] + step * np.clip((before - after) / (2 * curvature), -1, 1)
    return float(vertex), float(np.hypot(_SIGMA_FACTOR * abs(step) / np.sqrt(-curvature), _SIGMA_LEAST))


def _line(seen: Turning, sensed: Turning, scan: _Scan) -> ClockEstimate:
    """Offset and drift from the offsets of windows, or from the whole where it is short."""
    offset, sigma = scan.peak
    ends = [len(one.w_world) * STEP + one.start for one in (seen, sensed)]
    start, stop = max(seen.start, sensed.start + offset), min(ends[0], ends[1] + offset)
    middle = (start + stop) / 2
    windows = int((stop - start) / _WINDOW)
    found = []
    for k in range(windows if windows >= _WINDOWS else 0):
        at = start + (k + 0.5) * (stop - start) / windows
        v = _cut(seen, at, _WINDOW / 2)
        s = _cut(sensed, at - offset, _WINDOW / 2 + _WINDOW_REACH)
        try:
            part = _Scan.of(v, s, offset, _WINDOW_REACH, np.arange(v.w_world.shape[1]))
        except CalibrationError:
            continue
        vertex, own = part.peak
        if part.explained > _AGREEING and abs(vertex - offset) < _WINDOW_REACH - STEP:
            found.append((at - middle, vertex, own))
    if len(found) < _WINDOWS:
        return ClockEstimate(offset, 0.0, sigma, 0.0, middle=middle - offset)
    return _fitted(np.array(found), middle)


def _fitted(found: Array, middle: float) -> ClockEstimate:
    """Robust line through offsets (K, 3): time from the middle of the video, offset, standard deviation."""
    at, offsets, sigmas = found.T
    A = np.stack([np.ones_like(at), at], axis=1)
    weights, prior = 1 / sigmas**2, np.diag([0.0, 1 / _SIGMA_DRIFT**2])
    solution, covariance = np.zeros(2), np.eye(2)
    for _ in range(20):
        covariance = np.linalg.inv(A.T @ (weights[:, None] * A) + prior)
        solution = covariance @ (A.T @ (weights * offsets))
        square = ((offsets - A @ solution) / sigmas) ** 2
        weights = 4 / (3 + square) / sigmas**2  # Student's t with 3 degrees of freedom
    sigma, sigma_drift = np.sqrt(np.diag(covariance))
    return ClockEstimate(
        float(solution[0]), float(solution[1]), float(np.hypot(sigma, _SIGMA_LEAST)), 0.0,
        sigma_drift=float(sigma_drift), middle=middle - float(solution[0]),
    )  # fmt: skip


def _cut(turning: Turning, middle: float, half: float) -> Turning:
    a = max(0, round((middle - half - turning.start) / STEP))
    b = max(a, round((middle + half - turning.start) / STEP))
    return turning[a:b]


def _doubt(scan: _Scan, around: float, reach: float) -> str:
    if scan.explained < _AGREEING:
        return (
            f"image and sensors move differently at every offset within {reach:g} s of {around:g} s: check "
            "that they are of the same person and time and which sensor is where, or search further (reach)"
        )
    rivals = [f"{offset:+.2f} s" for offset, gain in scan.others if gain > _RIVAL * scan.gain]
    if rivals:
        return (
            f"the motion repeats itself: offsets of {', '.join(rivals)} explain it nearly as well as "
            f"{scan.best:+.2f} s; give the start times of video and sensors (around, reach), or record a "
            "turn or an arm raise"
        )
    if scan.margin < SURE:
        return (
            f"the offset of {scan.best:+.2f} s is the best one, but the motion is too short or too slow to "
            "be sure; give the start times of video and sensors (around, reach), or record a turn"
        )
    return ""
