"""Errors of a 2D detector, as batched torch operations.

Errors are in pixels of a camera with a focal length of 1250 px; divided by it they are errors of x/z
and y/z. A detector's error is mostly a bias of seconds and little white noise, so windows are of three
kinds: clean, white, or realistic (bias, slow drift, outliers, gaps, missing landmarks, image borders).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import torch
from torch import Tensor

from lifting.body import Body
from lifting.draws import Draw

FOCAL_PX: Final = 1250.0
HALF_WIDTH, HALF_HEIGHT = 960 / FOCAL_PX, 540 / FOCAL_PX
"""Half the image, in units of focal length."""
RATE_HZ: Final = 60.0


@dataclass(frozen=True)
class NoiseConfig:
    """Frequencies and sizes of errors; a realistic window scales bias and drift by its amplitude."""

    clean: float = 0.30
    """Share of windows without any error."""
    white: float = 0.20
    """Share of windows with white error only; the rest are realistic."""
    white_px: tuple[float, float] = (0.5, 6.0)
    """Range of the standard deviation per axis, px, of white windows."""
    amplitude: tuple[float, float] = (0.3, 1.5)
    """Range of the factor on the bias and drift of realistic windows."""
    bias_px: float = 6.0
    """Standard deviation of the constant error per joint and axis, px."""
    drift_px: float = 5.0
    """Standard deviation of the slow error per joint and axis, px."""
    drift_memory: float = 0.5
    """Correlation time of the drift, s."""
    wrist_memory: float = 0.3
    """Correlation time of the drift at the wrists, s."""
    jitter_px: float = 0.3
    """Standard deviation of the white error of realistic windows, px."""
    outlier_share: float = 0.04
    """Share of (frame, joint) that are outliers."""
    outlier_px: float = 60.0
    """Standard deviation per axis of an outlier, constant within its run, px."""
    missing_share: float = 0.05
    """Share of (frame, joint) missing in runs."""
    run_s: tuple[float, float] = (0.2, 1.0)
    """Range of the length of outlier and missing runs, s."""
    gap_share: float = 0.10
    """Share of realistic windows that lose the whole body for some frames."""
    poor_share: float = 0.15
    """Share of realistic windows whose detector lacks about a fifth of the joints throughout."""
    sparse_share: float = 0.10
    """Share of realistic windows whose detector has no point between hips and shoulders."""
    truncated_share: float = 0.30
    """Share of realistic windows in which what is outside the image is unseen."""


PERFECT: Final = NoiseConfig(clean=1.0, white=0.0)
TRAINING_NOISE: Final[Mapping[str, NoiseConfig]] = {
    "mixed": NoiseConfig(), "perfect": PERFECT, "realistic": NoiseConfig(clean=0.0, white=0.0),
}  # fmt: skip
"""Kinds of 2D that a lifter may be trained for. perfect: no errors, for projected ground truth (5-7 mm
better there, not usable with a detector). realistic: detectors alone. mixed: both, and white noise."""
VALIDATION_NOISE: Final = replace(
    NoiseConfig(), clean=0.0, white=0.0, amplitude=(1.0, 1.0), poor_share=0.0, sparse_share=0.0
)
"""Realistic noise at nominal amplitude."""


def add_noise(
    body: Body, config: NoiseConfig, xy: Tensor, seen: Tensor, draw: Draw, rate_hz: float = RATE_HZ
) -> tuple[Tensor, Tensor]:
    """Simulate detections; the first windows stay clean, the next are white, the rest realistic.

    Args:
        body: joints. config: frequencies and sizes.
        xy: (B, 2, W, J) exact x/z and y/z in the camera.
        seen: (B, W, J) bool.
        draw: random numbers. rate_hz: of the windows, Hz.

    Returns:
        Noisy xy (B, 2, W, J) and seen (B, W, J).
    """
    B = len(xy)
    clean = round(config.clean * B)
    white = clean + round(config.white * B)
    parts, masks = [xy[:clean]], [seen[:clean]]
    if white > clean:
        sigma = draw.between(config.white_px, white - clean, 1, 1, 1)
        parts.append(xy[clean:white] + sigma / FOCAL_PX * draw.normal(*xy[clean:white].shape))
        masks.append(seen[clean:white])
    if white < B:
        rest = replace(draw, batch=B - white)
        noisy, mask = _realistic(body, config, xy[white:], seen[white:], rest, rate_hz)
        parts.append(noisy)
        masks.append(mask)
    return torch.cat(parts), torch.cat(masks)


def _realistic(
    body: Body, config: NoiseConfig, xy: Tensor, seen: Tensor, draw: Draw, rate_hz: float
) -> tuple[Tensor, Tensor]:
    B, _, W, J = xy.shape
    bias = config.bias_px * draw.normal(B, 2, 1, J)
    drift = config.drift_px * _drift(body, config, W, draw, rate_hz)
    amplitude = draw.between(config.amplitude, B, 1, 1, 1)
    error = (bias + drift) * (amplitude * _joint_factors(body).to(xy))
    error += config.jitter_px * draw.normal(B, 2, W, J)
    outlier = runs(config.outlier_share, W, J, draw, rate_hz, config.run_s)
    error += outlier[:, None] * (config.outlier_px * draw.normal(B, 2, 1, J))
    noisy = xy + error / FOCAL_PX
    seen = seen & ~runs(config.missing_share, W, J, draw, rate_hz, config.run_s)
    seen &= ~_gaps(config, W, draw)[:, :, None]
    seen &= _landmark_set(body, config, draw)[:, None]
    truncated = draw.uniform(B, 1, 1) <= config.truncated_share
    inside = (noisy[:, 0].abs() < HALF_WIDTH) & (noisy[:, 1].abs() < HALF_HEIGHT)
    seen &= inside | ~truncated
    return noisy, seen


def _drift(body: Body, config: NoiseConfig, W: int, draw: Draw, rate_hz: float) -> Tensor:
    """Unit-variance Ornstein-Uhlenbeck paths (B, 2, W, J) from their leading eigenvectors."""
    slow, fast = (
        _drift_basis(W, rate_hz, memory).to(draw.device)
        for memory in (config.drift_memory, config.wrist_memory)
    )
    weights = draw.normal(draw.batch, 2, slow.shape[1], len(body.names))
    drift = torch.matmul(slow, weights)
    wrists = [arm[-1] for arm in body.arms]
    drift[..., wrists] = torch.matmul(fast, weights[..., wrists])
    return drift


@lru_cache(maxsize=8)
def _drift_basis(W: int, rate_hz: float, memory: float, rank: int = 8) -> Tensor:
    """(W, rank) whose product with white noise has approximately the covariance exp(-|t| / memory)."""
    time = torch.arange(W) / rate_hz
    covariance = torch.exp(-(time[:, None] - time).abs() / memory)
    values, vectors = torch.linalg.eigh(covariance)
    basis: Tensor = vectors[:, -rank:] * values[-rank:].clamp_min(0).sqrt()
    basis /= basis.norm(dim=1, keepdim=True)
    return basis


def _joint_factors(body: Body) -> Tensor:
    """(J,) factors on the error: larger at wrists and elbows, smaller at knees and ankles."""
    factor = torch.ones(len(body.names))
    for limbs, size in ((body.arms, 1.3), (body.legs, 0.8)):
        for limb in limbs:
            factor[limb[1:]] = size
    return factor


def runs(
    share: float, W: int, n: int, draw: Draw, rate_hz: float, seconds: tuple[float, float] = (0.2, 1.0)
) -> Tensor:
    """Draw a mask (B, W, n) of runs.

    Args:
        share: of all samples that are in a run.
        W: frames. n: channels. draw: random numbers. rate_hz: of the frames, Hz.
        seconds: range of the length of a run, s.
    """
    low, high = (s * rate_hz for s in seconds)
    length = draw.between((low, high), draw.batch, 1, n)
    start = -length + (W + length) * draw.uniform(draw.batch, 1, n)
    # A run of length L touches the window with probability proportional to W + L.
    there = draw.uniform(draw.batch, 1, n) < share * (W + length) / length
    frame = torch.arange(W, device=draw.device)[None, :, None]
    return there & (frame >= start) & (frame < start + length)


def _gaps(config: NoiseConfig, W: int, draw: Draw) -> Tensor:
    """(B, W) frames in which the whole body is unseen; never all of a window."""
    ends = draw.uniform(draw.batch, 2).sort(dim=1).values * W
    there = draw.uniform(draw.batch, 1) < config.gap_share
    frame = torch.arange(W, device=draw.device) + 0.5
    gap = there & (frame >= ends[:, :1]) & (frame < ends[:, 1:])
    return gap & ~gap.all(dim=1, keepdim=True)


def _landmark_set(body: Body, config: NoiseConfig, draw: Draw) -> Tensor:
    """(B, J) joints that the detector has at all."""
    rand = draw.uniform(draw.batch, len(body.names) + 1)
    which = rand[:, -1:]
    limbs = torch.zeros(len(body.names), dtype=torch.bool, device=draw.device)
    limbs[[j for limb in body.arms + body.legs for j in limb]] = True
    limbs[[j for j in range(len(body.names)) if j not in body.parents]] = True  # the head
    poor = which < config.poor_share
    sparse = (which >= config.poor_share) & (which < config.poor_share + config.sparse_share)
    return (~poor | (rand[:, :-1] > 0.2)) & (~sparse | limbs)
