"""Errors of a detector's keypoints that are independent of each other and of the pose.

The sizes were measured on real detectors: mostly a constant bias per joint and a slow drift, hardly white, and not
correlated with its confidence. Every parameter is drawn for each recording from a log-normal distribution
(`parameter_spread`). Real detectors' errors are correlated and depend on the view: `DetectorErrors` of the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.random import Generator

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.simulation.noise import coloured_noise, varied
from rtof_kin.simulation.simulate import SimulationSettings

_ARMS = ("LeftForeArm", "LeftHand", "RightForeArm", "RightHand")
_LEGS = ("LeftLeg", "LeftFoot", "RightLeg", "RightFoot")
_WRISTS = ("LeftHand", "RightHand")


def white(sigma_px: float = 5.0) -> SimulationSettings:
    """White noise on the 2D, on the IMUs' clock, with realistic IMUs; sigma_px: standard deviation, px."""
    return replace(SimulationSettings.perfect(), keypoints=KeypointNoise.white(sigma_px))


def independent() -> SimulationSettings:
    """Joints with a constant bias, a slow drift and outliers, late by 1 to 4 frames, and realistic IMUs."""
    return SimulationSettings(keypoints=KeypointNoise(), video_lag_frames=(1.0, 4.0))


@dataclass(frozen=True)
class KeypointNoise:
    """Errors of a detector, for a person about 500 px tall (f = 1250 px, 4 m away)."""

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
        """Return no errors: exact projections of everything in front of the camera."""
        return cls(
            bias_px=0,
            drift_px=0,
            white_px=0,
            outlier_share=(0, 0),
            gap_duration=(0, 0),
            hides_outside=False,
            confidence=1,
            confidence_spread=0,
            parameter_spread=0,
        )

    @classmethod
    def white(cls, sigma_px: float = 5.0) -> Self:
        """Return independent normal errors of each coordinate only; sigma_px: standard deviation, px."""
        return replace(cls.perfect(), white_px=sigma_px, arms_factor=1.0, legs_factor=1.0)

    def drawn(self, rng: Generator) -> Self:
        """Return a detector with randomly drawn parameters."""
        share = float(rng.uniform(*self.outlier_share))
        return replace(self, **varied(self, rng, "confidence"), outlier_share=(share, share))

    def factor(self, joint: str) -> float:
        """Return the factor on the errors of one joint."""
        return self.arms_factor if joint in _ARMS else self.legs_factor if joint in _LEGS else 1.0

    def __call__(
        self, rng: Generator, times: Array, joints: Sequence[str], uv_px: Array, inside: Mask
    ) -> tuple[Array, Array]:
        """Return what is found (T, L, 2), px, and its confidences (T, L); see `SimulationSettings.keypoints`."""
        noise = self.drawn(rng)
        errors = keypoint_errors(rng, times, joints, noise)
        confidence = confidences(rng, times, errors, noise)
        return np.where(unseen(rng, times, inside, noise)[..., None], np.nan, uv_px + errors), confidence


def keypoint_errors(rng: Generator, times: Array, joints: Sequence[str], noise: KeypointNoise) -> Array:
    """Return errors (T, L, 2) of landmarks, px; times: (T,) s."""
    T, L = len(times), len(joints)
    memory = [noise.wrist_memory if j in _WRISTS else noise.drift_memory for j in joints]
    bias = noise.bias_px * rng.standard_normal((L, 2))
    drift = coloured_noise(rng, times, np.array(memory)[:, None], (L, 2))
    white = noise.white_px * rng.standard_normal((T, L, 2))
    factor = np.array([noise.factor(joint) for joint in joints])
    errors = factor[:, None] * (bias + noise.drift_px * drift + white)
    return errors + _outliers(rng, times, L, noise)


def _outliers(rng: Generator, times: Array, L: int, noise: KeypointNoise) -> Array:
    """Return constant displacements (T, L, 2), px, in random episodes that cover a share of the frames. They start at
    the rate ``-log(1 - share) / mean duration`` and may overlap, so that the expected share is exact.
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
    """Return which landmarks (T, L) the detector misses. A landmark outside the image is missed. When less than half of
    the person is inside, the whole person is lost for some time.
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
    """Return the confidences (T, L) in (0, 1] that the detector reports, mostly independent of its errors (T, L, 2),
    px.
    """
    mood = coloured_noise(rng, times, noise.drift_memory, errors.shape[1:2])
    size = np.linalg.norm(errors, axis=-1) / noise.outlier_px
    spread = noise.confidence_spread
    reported = noise.confidence + spread * (mood - np.minimum(size, 1.0))
    return np.asarray(np.clip(reported, 0.05, 1.0))
