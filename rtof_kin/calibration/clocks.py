"""Offset and drift between the clocks of a video and of sensors, or of two videos, from a person's motion.

Video and sensors are compared by angular velocities (`clock_scan`); the drift is the slope of the offsets of windows
along the recording. `find_clock` searches wide, `small_offset` about the clocks that a recording declares.

Two videos are lifted to 3D, each in a world of its own with z up, and the velocities of the joints about the root are
compared at every offset after the best rotation about the vertical: with

::

    H = sum_t sum_j v_1(t) v_2(t + offset)^T

the largest trace of R_z H over all headings is sqrt((H_xx + H_yy)^2 + (H_xy - H_yx)^2) + H_zz. Directions
make this sharper than speeds, and where the cameras stand has no effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import scipy

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.clock_scan import (
    SIGMA_LEAST,
    STEP,
    AngularVelocities,
    ClockScan,
    velocities_in_image,
    velocities_of_sensors,
)
from rtof_kin.calibration.offset_scan import APART, OffsetScan, repeated
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.orientation import log_with_orientation

SURE: Final = 4.0  # [nats] Least margin of an offset that is not in doubt; see `ClockEstimate.margin`
REPEATED: Final = 0.5  # [1] Gain of another offset, relative to the best one, from which the motion repeats itself
_AGREEING = 0.2  # [1] Least part of the image's motion that the sensors explain; of another motion up to 0.2 in 20 s
_STILL = 0.15  # [rad/s] 95th percentile of the angular speed of a sensor at rest
_WINDOW = 20.0  # [s] of the recording for one offset of the drift, of which `_WINDOWS` at least are needed
_WINDOWS: Final = 3
_WINDOW_REACH: Final = 0.2
_SIGMA_DRIFT = 60e-6  # [s/s] Standard deviation of clocks' drifts
REACH: Final = 0.5  # [s] Largest offset of `small_offset`
_SURE_NEAR = 2.0  # [nats] The same as `SURE` of an offset within `REACH`, of which fewer are tried
_PART, _MOST_PARTS = 2.6, 12  # [s] Length of its windows, and their number
_WRONG_DRIFT = 0.01  # [s/s] Standard deviation of the drift where rates may be declared wrongly
_SURE_DRIFT: Final = 2.5
"""Standard deviations from which a drift is sure; of 42 recordings with right clocks, 2.1 at most
(benchmarks/results/clock_offsets.md)."""
VIDEO_HZ: Final = 30.0  # [Hz] at which two videos are compared, and low-pass of their velocities against jitter
_CUTOFF_HZ: Final = 5.0
LEAST_COMMON: Final = 1.0  # [s] Least time that two videos have in common, with `_COMMON_SHARE` of the shorter one
_COMMON_SHARE: Final = 0.3
_SAMPLES_HZ = 10.0  # [Hz] Independent samples of the correlation; they make its gain comparable over different overlaps
_APART_VIDEOS = 0.3  # [s] Least distance of another offset of two videos
_RIVAL = 0.75  # Gain of another offset of two videos relative to the best, from which the offset is in doubt
_LEAST_CORRELATION = 0.5  # Correlation below which two videos may not show the same motion
_UNSHARP = 0.03  # [s] Standard deviation of an offset of two videos found alone, from planted ones


@dataclass(frozen=True)
class ClockEstimate:
    """Clock of a video relative to sensors: ``t_video = t_sensor + offset + drift (t_sensor - middle)``."""

    offset: float  # [s] At `middle`
    drift: float  # [s/s] 0 where the recording is too short to tell
    sigma: float
    """[s] Standard deviation of the offset; of one in doubt by `find_clock`, the way to the furthest of the
    next best."""
    margin: float
    """[nats] of the best offset to the next one, per independent sensor and with allowance for correlated errors."""
    doubt: str = ""  # What may be wrong and what to do, in a sentence; empty if the offset is sure
    sigma_drift: float = _SIGMA_DRIFT  # [s/s] Standard deviation of the drift
    middle: float = 0.0  # [s] Middle of the common time, on the sensors' clock
    candidates: tuple[float, ...] = ()  # [s] Other offsets that explain the motion nearly as well, the best first
    joints: dict[str, str] = field(default_factory=dict)
    """Segment of each sensor that moves most like it at this offset, or the one given."""
    explained: float = np.nan  # [1] Part of the image's motion that the sensors explain
    likely_drift: float = 0.0  # [s/s] Drift that windows show, sure or not

    def at(self, times: Array) -> Array:
        """Return the offset (T,), s, at times (T,) of the video."""
        return self.offset + self.drift * (times - self.offset - self.middle)

    def apply(self, log: SensorLog) -> SensorLog:
        """Return sensors on the video's clock."""
        moved = (replace(s, times=s.times + self.offset + self.drift * (s.times - self.middle)) for s in log.streams)
        return replace(log, streams=tuple(moved))


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

    A detector's delay counts as part of the offset, as nothing tells one from the other. `UnknownNameError`: an unknown
    sensor or segment; `CalibrationError`: no sensor moves, no person is seen for long enough, or no offset has an
    overlap; `InvalidInputError`: a sensor has neither orientation nor what it is estimated from.

    Args:
        log: sensors on their own clock, at any rates; orientation is estimated where a stream has none.
        joints: sensor -> segment that carries it; other sensors are ignored. None: unknown, all are used.
        around, reach: offsets from around - reach to around + reach are searched, s.
    """
    seen = velocities_in_image(poses, keypoints, skeleton)
    log = log if joints is None else log.select(list(joints))
    usual = sorted({joint for joint, _ in skeleton.sensors.values()}, key=skeleton.names.index)
    carriers = usual if joints is None else list(joints.values())
    log = _within(log, poses.times[0] - around - reach, poses.times[-1] - around + reach)
    sensed = velocities_of_sensors(log_with_orientation(log))
    speed = np.linalg.norm(sensed.w_world, axis=-1)
    known = np.isfinite(speed).any(axis=1)
    fastest = float(np.nanpercentile(np.nanmax(speed[known], axis=1), 95)) if known.any() else 0.0
    if fastest < _STILL:
        raise CalibrationError(
            f"no sensor turns faster than {np.degrees(fastest):.1f} deg/s: they do not move, so that nothing "
            "relates them to the video; check that these are the sensors worn in it"
        )
    seen = seen.of(skeleton.index(*carriers))
    scan = ClockScan.of(seen, sensed, around, reach, joints is not None)
    worn = np.flatnonzero(scan.segments >= 0)
    segments = scan.segments[worn]
    line = _line(seen.of(segments), sensed.of(worn), scan.peaks[0][0])
    doubt = _doubt(scan, around, reach)
    others = [abs(offset - scan.peaks[0][0]) for offset, _ in scan.peaks[1:]]
    return replace(
        line,
        sigma=max([line.sigma, *others]) if doubt else line.sigma,
        margin=scan.margin,
        doubt=doubt,
        candidates=scan.rivals(REPEATED),
        explained=scan.explained,
        joints={log.names[s]: carriers[j] for s, j in zip(worn, segments, strict=True)},
    )


def _within(log: SensorLog, start: float, stop: float) -> SensorLog:
    kept = []
    for stream in log.streams:
        part = stream.between(start, stop)
        if part is None:
            raise CalibrationError(
                f"sensor {stream.name} has no samples from {start:.0f} to {stop:.0f} s, where the video "
                "could be: search further (reach), or check that both are of the same time"
            )
        kept.append(part)
    return replace(log, streams=tuple(kept))


def small_offset(seen: AngularVelocities, sensed: AngularVelocities) -> ClockEstimate:
    """Estimate offset and drift of clocks that agree within `REACH`; 0 drift unless it is sure.
    `CalibrationError`: they have too little in common.
    """
    scan = ClockScan.of(seen, sensed, 0.0, REACH)
    offset, sigma = scan.scan.best, scan.sigma
    middle = sum(_common(seen, sensed, offset)) / 2
    line = ClockEstimate(
        offset,
        0.0,
        sigma,
        scan.margin,
        _doubt(scan, 0.0, REACH, _SURE_NEAR),
        np.inf,
        middle - offset,
        scan.rivals(REPEATED),
        explained=scan.explained,
    )
    around = replace(line, offset=0.0, middle=middle)
    for _ in range(3):  # of a large drift, only the windows near the middle are found at first
        found = _windows(seen, sensed, around, _PART, _MOST_PARTS, REACH)
        if len(found) < _WINDOWS:
            return line
        fitted = _fitted(found, middle, _WRONG_DRIFT)
        if abs(fitted.drift) < _SURE_DRIFT * fitted.sigma_drift:
            break
        around = fitted
    if abs(fitted.drift) < _SURE_DRIFT * fitted.sigma_drift:
        return replace(line, sigma_drift=fitted.sigma_drift, likely_drift=fitted.drift)
    return replace(fitted, margin=line.margin, explained=float(np.mean(found[:, 3])))


def _line(seen: AngularVelocities, sensed: AngularVelocities, best: float) -> ClockEstimate:
    """Offset and drift from the offsets of windows, or from the whole where it is short."""
    scan = ClockScan.of(seen, sensed, best, 2 * APART)
    offset, sigma = scan.scan.best, scan.sigma
    start, stop = _common(seen, sensed, offset)
    middle = (start + stop) / 2
    whole = ClockEstimate(offset, 0.0, sigma, 0.0, middle=middle - offset)
    if stop - start < _WINDOWS * _WINDOW:
        return whole
    found = _windows(seen, sensed, whole, _WINDOW, 10**6, _WINDOW_REACH)
    return whole if len(found) < _WINDOWS else _fitted(found, middle)


def _common(seen: AngularVelocities, sensed: AngularVelocities, offset: float) -> tuple[float, float]:
    ends = [len(one.w_world) * STEP + one.start for one in (seen, sensed)]
    return max(seen.start, sensed.start + offset), min(ends[0], ends[1] + offset)


def _windows(
    seen: AngularVelocities, sensed: AngularVelocities, line: ClockEstimate, seconds: float, most: int, reach: float
) -> Array:
    """Offsets (K, 4) of windows in which the motion agrees: time from the middle of the video, offset, its standard
    deviation, part explained; `reach`: s.
    """
    start, stop = _common(seen, sensed, line.offset)
    count, found = min(int((stop - start) / seconds), most), list[tuple[float, ...]]()
    for k in range(count):
        at = start + (k + 0.5) * (stop - start) / count
        around, half = float(line.at(np.array(at))), (stop - start) / count / 2
        v, s = _cut(seen, at, half), _cut(sensed, at - around, half + reach)
        if v.known.any() and s.known.any():
            part = ClockScan.of(v, s, around, reach)
            best = part.scan.best
            if part.explained > _AGREEING and abs(best - around) < reach - STEP:
                found.append((at - (start + stop) / 2, best, part.sigma, part.explained))
    return np.array(found).reshape(-1, 4)


def _fitted(found: Array, middle: float, sigma_drift: float = _SIGMA_DRIFT) -> ClockEstimate:
    """Robust line through offsets (K, 4) of `_windows`, with a drift of a standard deviation."""
    at, offsets, sigmas, _ = found.T
    A = np.stack([np.ones_like(at), at], axis=1)
    weights, prior = 1 / sigmas**2, np.diag([0.0, 1 / sigma_drift**2])
    solution, covariance = np.zeros(2), np.eye(2)
    for _ in range(20):
        covariance = np.linalg.inv(A.T @ (weights[:, None] * A) + prior)
        solution = covariance @ (A.T @ (weights * offsets))
        square = ((offsets - A @ solution) / sigmas) ** 2
        weights = 4 / (3 + square) / sigmas**2  # Student's t with 3 degrees of freedom
    sigma, after = np.sqrt(np.diag(covariance))
    return ClockEstimate(
        float(solution[0]),
        float(solution[1]),
        float(np.hypot(sigma, SIGMA_LEAST)),
        0.0,
        sigma_drift=float(after),
        middle=middle - float(solution[0]),
    )


def _cut(turning: AngularVelocities, middle: float, half: float) -> AngularVelocities:
    a = max(0, round((middle - half - turning.start) / STEP))
    b = max(a, round((middle + half - turning.start) / STEP))
    return turning[a:b]


def _doubt(scan: ClockScan, around: float, reach: float, sure: float = SURE) -> str:
    best = scan.peaks[0][0]
    if scan.explained < _AGREEING:
        return (
            f"image and sensors move differently at every offset within {reach:g} s of {around:g} s: check "
            "that they are of the same person and time and which sensor is where, or search further (reach)"
        )
    if rivals := scan.rivals(REPEATED):
        return (
            f"{repeated(best, *rivals)}; give the start times of video and sensors (around, reach), or begin with "
            "a stamp, a turn or an arm raise"
        )
    if scan.margin < sure:
        return (
            f"the offset of {best:+.2f} s is the best one, but the motion is too short or too slow to "
            "be sure; give the start times of video and sensors (around, reach), or record a turn"
        )
    return ""


def find_video_offset(first: PoseSequence, second: PoseSequence, around: float | None = None) -> ClockEstimate:
    """Return the offset, to be added to the times of the second video, at which two lifts of one person agree.
    `InvalidInputError`: they have too little in common at every offset.

    Args:
        first, second: (T, J) and (T', J) poses of the same joints, at even times, each in its own world.
        around: [s] search within a second of this offset only.
    """
    v_1, v_2 = _velocities(first), _velocities(second)
    K, M = len(v_1), len(v_2)
    ones = scipy.signal.fftconvolve(np.ones(K), np.ones(M))
    E_1 = scipy.signal.fftconvolve(np.einsum("tji,tji->t", v_1, v_1), np.ones(M))
    E_2 = scipy.signal.fftconvolve(np.ones(K), np.einsum("tji,tji->t", v_2, v_2)[::-1])
    flat_1, flat_2 = v_1.reshape(K, -1, 3), v_2[::-1].reshape(M, -1, 3)
    H = np.zeros((K + M - 1, 3, 3))
    for a, b in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2)):
        H[:, a, b] = scipy.signal.fftconvolve(flat_1[..., a], flat_2[..., b], axes=0).sum(axis=1)
    alike = np.hypot(H[:, 0, 0] + H[:, 1, 1], H[:, 0, 1] - H[:, 1, 0]) + H[:, 2, 2]
    correlation = np.clip(alike / np.sqrt(np.maximum(E_1 * E_2, 1e-12)), 0.0, 0.999)
    gains = -0.5 * ones / VIDEO_HZ * _SAMPLES_HZ * np.log1p(-(correlation**2))
    # Sample k of the convolution compares second[m] with first[k - (M - 1) + m].
    offsets = (np.arange(K + M - 1) - (M - 1)) / VIDEO_HZ + first.times[0] - second.times[0]
    common = max(LEAST_COMMON, _COMMON_SHARE * min(K, M) / VIDEO_HZ)
    gains[ones < common * VIDEO_HZ] = -np.inf
    if around is not None:
        gains[np.abs(offsets - around) > 1.0] = -np.inf
    if not np.isfinite(gains).any():
        raise InvalidInputError(
            f"the two videos have less than {common:.1f} s in common; record both for the whole motion"
        )
    scan = OffsetScan(offsets, gains, _APART_VIDEOS)
    r, (rival, gain) = float(correlation[scan.peak]), scan.rival
    doubt = ""
    if r < _LEAST_CORRELATION:
        doubt = (
            f"the joints move differently in the two videos at every offset (correlation {r:.2f}); check that both "
            "show the same person at the same time"
        )
    elif gain > _RIVAL * scan.gain:
        doubt = f"{repeated(scan.best, rival)}; clap or raise an arm once in view of both cameras"
    return ClockEstimate(scan.best, 0.0, _UNSHARP, scan.gain - gain, doubt, explained=r**2)


def _velocities(poses: PoseSequence) -> Array:
    """(K, J, 3) of the joints about the root, m/s, low-pass filtered, at `VIDEO_HZ`."""
    p = poses.p_world_joint - poses.p_world_joint[:, :1]
    times = np.arange(poses.times[0], poses.times[-1] + 1e-9, 1 / VIDEO_HZ)
    if len(times) < LEAST_COMMON * VIDEO_HZ:
        raise InvalidInputError(f"a video is shorter than {LEAST_COMMON:g} s; record for longer")
    even = signals.interpolate(poses.times, p[:, 1:], np.minimum(times, poses.times[-1]))
    return np.gradient(signals.low_pass(even, VIDEO_HZ, _CUTOFF_HZ), 1 / VIDEO_HZ, axis=0)
