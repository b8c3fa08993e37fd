"""What is wrong with a detector's keypoints and with an IMU, as random processes.

Sizes come from measurements on real detectors and on one recording of thirteen real IMUs: errors of a
detector are mostly a constant bias per joint and a slow drift, hardly white, and its confidence does
not tell them; errors of an IMU's orientation are slow slip and a wobble with the soft tissue, mostly
about the bone. Every parameter is drawn anew for each recording (log-normal, `parameter_spread`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ORIENTATION_MEDIAN_DEG = {
    "Head": 2.0, "Hips": 3.0, "Spine3": 3.9, "LeftFoot": 2.2, "RightFoot": 8.4,
    "LeftArm": 5.3, "RightArm": 5.8, "LeftForeArm": 7.4, "RightForeArm": 10.0,
    "LeftUpLeg": 6.7, "RightUpLeg": 5.4, "LeftLeg": 4.6, "RightLeg": 5.8,
}  # fmt: skip
"""Median angle between a real IMU, under its best constant calibration, and the segment, degrees."""
_OTHER_MEDIAN_DEG = 5.0
_MEDIAN_NORM = 0.816
"""Median norm of a normal vector with standard deviations 1, 0.3, 0.3."""
_SWING_SHARE = 0.3
_POSTURE_SCALE, _RATE_SCALE = 0.3, 1.0
"""Motion of a segment at which its wobble is as large as it gets, rad and rad/s."""
_CYCLE = ((1, 2), (2, 0), (0, 1))
_ARMS = ("LeftForeArm", "LeftHand", "RightForeArm", "RightHand")
_LEGS = ("LeftLeg", "LeftFoot", "RightLeg", "RightFoot")
_WRISTS = ("LeftHand", "RightHand")


def _varied(noise: Any, rng: Generator, fields: Sequence[str]) -> dict[str, Any]:
    """The fields named, each times a log-normal factor."""
    factors = np.exp(noise.parameter_spread * rng.standard_normal(len(fields)))
    return {f: getattr(noise, f) * float(k) for f, k in zip(fields, factors, strict=True)}


@dataclass(frozen=True)
class KeypointNoise:
    """Errors of a detector, in px for a person about 500 px tall (f = 1250 px, 4 m away)."""

    bias_px: float = 6.0  # [px] per axis, constant per joint
    drift_px: float = 5.0  # [px] per axis, coloured
    drift_memory: float = 0.5  # [s] correlation time of the drift
    wrist_memory: float = 0.3  # [s] the same at the wrists
    white_px: float = 0.3  # [px] per axis, from frame to frame
    arms_factor: float = 1.3  # [-] on all of these, wrists and elbows
    legs_factor: float = 0.8  # [-] the same, knees and ankles
    outlier_share: tuple[float, float] = (0.03, 0.05)  # [-] of frames of a joint, drawn in between
    outlier_px: float = 80.0  # [px] median length of an outlier's displacement
    outlier_duration: tuple[float, float] = (0.2, 1.0)  # [s] drawn in between
    gap_duration: tuple[float, float] = (0.5, 5.0)  # [s] least time unseen once out of the image
    hides_outside: bool = True  # whether landmarks outside the image are unseen
    confidence: float = 0.8  # [-] mean of what the detector reports
    confidence_spread: float = 0.1  # [-] its standard deviation, which has little to do with errors
    parameter_spread: float = 0.25  # [-] of the log-normal factor each number is drawn with

    @classmethod
    def perfect(cls) -> Self:
        """Exact projections of everything in front of the camera."""
        return cls(
            bias_px=0, drift_px=0, white_px=0, outlier_share=(0, 0), gap_duration=(0, 0),
            hides_outside=False, confidence=1, confidence_spread=0, parameter_spread=0,
        )  # fmt: skip

    @classmethod
    def white(cls, sigma_px: float = 5.0) -> Self:
        """Only independent normal errors on each coordinate."""
        return replace(cls.perfect(), white_px=sigma_px, arms_factor=1.0, legs_factor=1.0)

    @classmethod
    def realistic(cls) -> Self:
        """A detector as they are."""
        return cls()

    def drawn(self, rng: Generator) -> Self:
        """The same kind of detector with parameters of its own."""
        scales = ("bias_px", "drift_px", "drift_memory", "wrist_memory", "white_px", "arms_factor",
                  "legs_factor", "outlier_px", "confidence_spread")  # fmt: skip
        share = float(rng.uniform(*self.outlier_share))
        return replace(self, **_varied(self, rng, scales), outlier_share=(share, share))

    def factor(self, joint: str) -> float:
        """How much larger errors are at one joint."""
        return self.arms_factor if joint in _ARMS else self.legs_factor if joint in _LEGS else 1.0


@dataclass(frozen=True)
class ImuNoise:
    """Errors of IMUs on a body: `ORIENTATION_MEDIAN_DEG` scaled, and of the accelerometer."""

    misalignment_deg: float = 2.0  # [deg] per axis, constant per sensor
    orientation_factor: float = 1.0  # [-] on the medians of each segment; 0 for none
    drift_memory: float = 20.0  # [s] correlation time of the slip
    wobble_share: float = 0.3  # [-] of the variance, that follows the segment's motion
    white: float = 0.4  # [m/s^2] per axis and sample, at rest
    white_per_acceleration: float = 0.2  # [-] more of it, per m/s^2 of true acceleration
    coloured: float = 0.5  # [m/s^2] per axis
    coloured_memory: float = 0.2  # [s] its correlation time
    bias: float = 0.1  # [m/s^2] per axis, constant per sensor
    parameter_spread: float = 0.25  # [-] of the log-normal factor each number is drawn with

    @classmethod
    def perfect(cls) -> Self:
        """Sensors that tell the truth."""
        return cls(
            misalignment_deg=0, orientation_factor=0, white=0, white_per_acceleration=0, coloured=0,
            bias=0, parameter_spread=0,
        )  # fmt: skip

    @classmethod
    def realistic(cls) -> Self:
        """Sensors as they are."""
        return cls()

    def drawn(self, rng: Generator) -> Self:
        """The same kind of sensor with parameters of its own."""
        scales = ("misalignment_deg", "orientation_factor", "drift_memory", "wobble_share", "white",
                  "white_per_acceleration", "coloured", "coloured_memory", "bias")  # fmt: skip
        drawn = replace(self, **_varied(self, rng, scales))
        return replace(drawn, wobble_share=min(drawn.wobble_share, 1.0))


def coloured_noise(rng: Generator, times: Array, memory: ArrayLike, size: Sequence[int]) -> Array:
    """A stationary Ornstein-Uhlenbeck process of unit variance, (T, *size), at given times.

    Args:
        memory: correlation time, s; a number, or one for each element (broadcasts to `size`).
    """
    steps = np.diff(times).reshape(-1, *(1 for _ in size))
    share = np.exp(-steps / np.asarray(memory, dtype=float))
    kicks = np.sqrt(1 - share**2)
    out = rng.standard_normal((len(times), *size))
    for t in range(1, len(times)):
        out[t] = share[t - 1] * out[t - 1] + kicks[t - 1] * out[t]
    return out


def smooth_noise(
    rng: Generator, times: Array, memory: float, size: Sequence[int], smoothing: float = 0.5
) -> Array:
    """`coloured_noise` of unit variance through a first-order low-pass of time `smoothing`, s."""
    raw = coloured_noise(rng, times, memory, size)
    share = np.exp(-np.diff(times) / smoothing)
    for t in range(1, len(times)):
        raw[t] = share[t - 1] * raw[t - 1] + (1 - share[t - 1]) * raw[t]
    return np.asarray(raw * np.sqrt((memory + smoothing) / memory))


# --- keypoints -----------------------------------------------------------------------------------


def keypoint_errors(rng: Generator, times: Array, joints: Sequence[str], noise: KeypointNoise) -> Array:
    """Errors in px (T, L, 2) of landmarks that sit on the joints named; `noise` as drawn."""
    T, L = len(times), len(joints)
    memory = [noise.wrist_memory if j in _WRISTS else noise.drift_memory for j in joints]
    bias = noise.bias_px * rng.standard_normal((L, 2))
    drift = coloured_noise(rng, times, np.array(memory)[:, None], (L, 2))
    white = noise.white_px * rng.standard_normal((T, L, 2))
    factor = np.array([noise.factor(joint) for joint in joints])
    errors = factor[:, None] * (bias + noise.drift_px * drift + white)
    return errors + _outliers(rng, times, L, noise)


def _outliers(rng: Generator, times: Array, L: int, noise: KeypointNoise) -> Array:
    """Constant displacements (T, L, 2), px, during episodes that cover a share of the frames.

    Episodes start at random at the rate ``-log(1 - share) / mean duration`` and may overlap, which
    covers exactly that share in expectation.
    """
    out = np.zeros((len(times), L, 2))
    shortest, longest = noise.outlier_duration
    rate = -np.log1p(-noise.outlier_share[0]) / ((shortest + longest) / 2)
    first = times[0] - longest
    for joint in range(L):
        for _ in range(rng.poisson(rate * (times[-1] - first))):
            start = rng.uniform(first, times[-1])
            during = (times >= start) & (times < start + rng.uniform(shortest, longest))
            angle = rng.uniform(0, 2 * np.pi)
            length = noise.outlier_px * np.exp(0.5 * rng.standard_normal())
            out[during, joint] = length * np.array([np.cos(angle), np.sin(angle)])
    return out


def unseen(rng: Generator, times: Array, inside: Mask, noise: KeypointNoise) -> Mask:
    """Landmarks (T, L) that the detector does not find, from those that lie inside the image.

    A landmark outside the image is unseen. When less than half of the person is inside, the detector
    loses the person as a whole, for some time at least.
    """
    if not noise.hides_outside:
        return np.zeros_like(inside)
    out = ~inside
    for start, stop in signals.runs(inside.mean(axis=1) < 0.5):
        end = times[start] + rng.uniform(*noise.gap_duration)
        out[start:stop] = True
        out[(times >= times[start]) & (times < end)] = True
    return out


def confidences(rng: Generator, times: Array, errors: Array, noise: KeypointNoise) -> Array:
    """What the detector reports (T, L) in (0, 1]: mostly moods of its own."""
    mood = coloured_noise(rng, times, noise.drift_memory, errors.shape[1:2])
    size = np.linalg.norm(errors, axis=-1) / noise.outlier_px
    spread = noise.confidence_spread
    reported = noise.confidence + spread * (mood - np.minimum(size, 1.0))
    return np.asarray(np.clip(reported, 0.05, 1.0))


# --- IMUs ----------------------------------------------------------------------------------------


def mounting_errors(
    rng: Generator, times: Array, joint: str, axis: Array, R_parent_bone: Array, noise: ImuNoise
) -> Array:
    """How a sensor sits turned against its usual place on a segment, as rotations (T, 3, 3).

    Args:
        axis: (3,) direction of the bone in its link frame, about which most of the slip happens.
        R_parent_bone: (T, 3, 3) the segment against its parent, whose motion the wobble follows.
        noise: as drawn.

    Returns:
        Rotations in the link frame; their mean over long times is the identity.
    """
    median_deg = ORIENTATION_MEDIAN_DEG.get(joint, _OTHER_MEDIAN_DEG) * noise.orientation_factor
    median_deg *= float(np.exp(noise.parameter_spread * rng.standard_normal()))
    drift = smooth_noise(rng, times, noise.drift_memory, (3,))
    wobble = _wobble(rng, times, R_parent_bone)
    share = noise.wobble_share
    mixed = np.sqrt(1 - share) * drift + np.sqrt(share) * wobble
    twist = np.outer(axis, axis)
    spread = (1 - _SWING_SHARE) * twist + _SWING_SHARE * np.eye(3)
    return so3.exp(np.radians(median_deg) / _MEDIAN_NORM * mixed @ spread)


def _wobble(rng: Generator, times: Array, R_parent_bone: Array) -> Array:
    """A random linear map (T, 3) of posture and turning rate; unit variance if there is motion."""
    R_mean_bone = so3.nearest_rotation(R_parent_bone.mean(axis=0)).T @ R_parent_bone
    # The sine of the turn times its axis, which stays smooth through half a turn.
    posture = np.stack([R_mean_bone[:, k, j] - R_mean_bone[:, j, k] for j, k in _CYCLE], -1) / 2
    steps = so3.log(np.swapaxes(R_parent_bone[:-1], -1, -2) @ R_parent_bone[1:])
    turning = np.concatenate([steps[:1], steps]) / np.median(np.diff(times))
    parts = []
    for values, scale in ((posture, _POSTURE_SCALE), (turning, _RATE_SCALE)):
        centred = values - values.mean(axis=0)
        parts.append(centred / np.maximum(centred.std(axis=0), scale))
    mixing = so3.unit(rng.standard_normal((3, 6)))
    return np.asarray(np.concatenate(parts, axis=1) @ mixing.T)


def accelerometer_errors(rng: Generator, times: Array, a_world: Array, noise: ImuNoise) -> Array:
    """Errors in sensor axes (T, 3), m/s^2, of a sensor that moves with a_world (T, 3)."""
    size = np.linalg.norm(a_world, axis=-1, keepdims=True)
    white = noise.white + noise.white_per_acceleration * size
    return np.asarray(
        white * rng.standard_normal((len(times), 3))
        + noise.coloured * coloured_noise(rng, times, noise.coloured_memory, (3,))
        + noise.bias * rng.standard_normal(3)
    )
