"""What a detector does to 2D landmarks, as batched torch operations.

Errors are in pixels of a camera with a focal length of 1250 px; divided by it they are errors of x/z
and y/z. A detector's error is mostly a bias that stays for seconds; little of it is white. So windows
get one of three kinds: clean, white, or realistic (bias, slow drift, outliers, gaps, a landmark set
that lacks some joints, the edges of the image).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from lifting.body import Body
from rtof_kin.core.errors import UnknownNameError

FOCAL_PX = 1250.0
HALF_WIDTH, HALF_HEIGHT = 960 / FOCAL_PX, 540 / FOCAL_PX
"""Half the image, in units of focal length."""
RATE_HZ = 60.0


@dataclass(frozen=True)
class NoiseConfig:
    """How often and how much; the realistic kind is multiplied by an amplitude drawn per window."""

    clean: float = 0.30
    """Share of windows without any error."""
    white: float = 0.20
    """Share of windows with white error only; the rest are realistic."""
    white_px: tuple[float, float] = (0.5, 6.0)
    """Range of the standard deviation per axis, px, of white windows."""
    amplitude: tuple[float, float] = (0.3, 1.5)
    """Range of the factor on the bias and drift of realistic windows."""
    bias_px: float = 6.0
    """Constant error per joint and axis, px."""
    drift_px: float = 5.0
    """Slowly changing error per joint and axis, px."""
    drift_memory: float = 0.5
    """Correlation time of the drift, s."""
    wrist_memory: float = 0.3
    """The same at the wrists, s."""
    jitter_px: float = 0.3
    """White error of realistic windows, px."""
    outlier_share: float = 0.04
    """Share of (frame, joint) that are outliers."""
    outlier_px: float = 60.0
    """Size per axis of an outlier, px, constant while it lasts."""
    missing_share: float = 0.05
    """Share of (frame, joint) missing in runs."""
    run_s: tuple[float, float] = (0.2, 1.0)
    """How long outliers and missing runs last, s."""
    gap_share: float = 0.10
    """Share of realistic windows that lose the whole body for some frames."""
    poor_share: float = 0.15
    """Share of realistic windows whose detector lacks about a fifth of the joints throughout."""
    sparse_share: float = 0.10
    """Share of realistic windows whose detector has no point between hips and shoulders."""
    truncated_share: float = 0.30
    """Share of realistic windows in which what is outside the image is unseen."""


TRAINING_NOISE = {
    "mixed": NoiseConfig(),
    "perfect": NoiseConfig(clean=1.0, white=0.0),
    "realistic": NoiseConfig(clean=0.0, white=0.0),
}
"""What 2D a lifter may be trained for, by name. perfect: no errors, for projected ground truth; 5-7 mm
better there, and no good with a detector. realistic: detectors alone. mixed: both, and white noise."""


def training_noise(kind: str) -> NoiseConfig:
    """One of `TRAINING_NOISE`.

    Raises:
        UnknownNameError: there is none of that name.
    """
    if kind not in TRAINING_NOISE:
        raise UnknownNameError("noise of the keypoints", [kind], list(TRAINING_NOISE))
    return TRAINING_NOISE[kind]


def perfect() -> NoiseConfig:
    """No errors at all."""
    return NoiseConfig(clean=1.0, white=0.0)


def realistic() -> NoiseConfig:
    """Only the realistic kind, at its nominal amplitude: what validation reports."""
    return replace(NoiseConfig(), clean=0.0, white=0.0, amplitude=(1.0, 1.0), poor_share=0.0,
                   sparse_share=0.0)  # fmt: skip


def add_noise(
    body: Body,
    config: NoiseConfig,
    xy: Tensor,
    seen: Tensor,
    generator: torch.Generator,
    rate_hz: float = RATE_HZ,
) -> tuple[Tensor, Tensor]:
    """Detections made from exact image coordinates.

    The first rows of the batch stay clean, the next get white noise, the rest are realistic.

    Args:
        body: the joints.
        config: how often and how much.
        xy: (B, 2, W, J) exact x/z and y/z in the camera.
        seen: (B, W, J) bool.
        generator: source of randomness, on the device of `xy`.
        rate_hz: frames per second of the windows.

    Returns:
        Noisy xy (B, 2, W, J) and seen (B, W, J).
    """
    B = len(xy)
    clean = round(config.clean * B)
    white = clean + round(config.white * B)
    parts, masks = [xy[:clean]], [seen[:clean]]
    if white > clean:
        sigma = _uniform((white - clean, 1, 1, 1), config.white_px, xy, generator)
        noise = torch.randn(xy[clean:white].shape, generator=generator, device=xy.device)
        parts.append(xy[clean:white] + sigma / FOCAL_PX * noise)
        masks.append(seen[clean:white])
    if white < B:
        noisy, mask = _realistic(body, config, xy[white:], seen[white:], generator, rate_hz)
        parts.append(noisy)
        masks.append(mask)
    return torch.cat(parts), torch.cat(masks)


def _realistic(
    body: Body, config: NoiseConfig, xy: Tensor, seen: Tensor, generator: torch.Generator, rate_hz: float
) -> tuple[Tensor, Tensor]:
    B, _, W, J = xy.shape

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, device=xy.device)

    factor = _joint_factors(body).to(xy)
    bias = config.bias_px * normal(B, 2, 1, J)
    drift = config.drift_px * _drift(body, config, W, normal, xy, rate_hz)
    amplitude = _uniform((B, 1, 1, 1), config.amplitude, xy, generator)
    error = (bias + drift) * (amplitude * factor)
    error += config.jitter_px * normal(B, 2, W, J)
    outlier = runs(config.outlier_share, (B, W, J), xy, generator, rate_hz, config.run_s)
    error += outlier[:, None] * (config.outlier_px * normal(B, 2, 1, J))
    noisy = xy + error / FOCAL_PX
    lost = runs(config.missing_share, (B, W, J), xy, generator, rate_hz, config.run_s)
    seen = seen & ~lost
    seen &= ~_gaps(config, (B, W), xy, generator)[:, :, None]
    seen &= _landmark_set(body, config, B, xy, generator)[:, None]
    rand = torch.rand((B, 1, 1), generator=generator, device=xy.device)
    inside = (noisy[:, 0].abs() < HALF_WIDTH) & (noisy[:, 1].abs() < HALF_HEIGHT)
    seen &= inside | (rand > config.truncated_share)
    return noisy, seen


def _drift(
    body: Body, config: NoiseConfig, W: int, normal: Callable[..., Tensor], like: Tensor, rate_hz: float
) -> Tensor:
    """Unit-variance Ornstein-Uhlenbeck paths (B, 2, W, J), from their leading eigenvectors."""
    B, J = len(like), len(body.names)
    slow = _drift_basis(W, rate_hz, config.drift_memory).to(like)
    fast = _drift_basis(W, rate_hz, config.wrist_memory).to(like)
    weights = normal(B, 2, slow.shape[1], J)
    drift = torch.matmul(slow, weights)
    wrists = [arm[-1] for arm in body.arms]
    drift[..., wrists] = torch.matmul(fast, weights[..., wrists])
    return drift


@lru_cache(maxsize=8)
def _drift_basis(W: int, rate_hz: float, memory: float, rank: int = 8) -> Tensor:
    """(W, rank) whose product with white noise has nearly the covariance exp(-|t| / memory)."""
    time = torch.arange(W) / rate_hz
    covariance = torch.exp(-(time[:, None] - time).abs() / memory)
    values, vectors = torch.linalg.eigh(covariance)
    basis: Tensor = vectors[:, -rank:] * values[-rank:].clamp_min(0).sqrt()
    basis /= basis.norm(dim=1, keepdim=True)
    return basis


def _joint_factors(body: Body) -> Tensor:
    """(J,) errors are larger at wrists and elbows, smaller at knees and ankles."""
    factor = torch.ones(len(body.names))
    for limbs, size in ((body.arms, 1.3), (body.legs, 0.8)):
        for limb in limbs:
            factor[limb[1:]] = size
    return factor


def runs(
    share: float,
    shape: tuple[int, int, int],
    like: Tensor,
    generator: torch.Generator,
    rate_hz: float,
    seconds: tuple[float, float] = (0.2, 1.0),
) -> Tensor:
    """(B, W, J) bool: runs of so many seconds that cover `share` of all samples."""
    B, W, J = shape
    low, high = (s * rate_hz for s in seconds)
    length = _uniform((B, 1, J), (low, high), like, generator)
    start = -length + (W + length) * torch.rand((B, 1, J), generator=generator, device=like.device)
    # A run of length L touches the window with probability proportional to W + L.
    chance = share * (W + length) / length
    there = torch.rand((B, 1, J), generator=generator, device=like.device) < chance
    frame = torch.arange(W, device=like.device)[None, :, None]
    return there & (frame >= start) & (frame < start + length)


def _gaps(config: NoiseConfig, shape: tuple[int, int], like: Tensor, generator: torch.Generator) -> Tensor:
    """(B, W) bool: frames in which the whole body is unseen; never all of a window."""
    B, W = shape
    ends = torch.rand((B, 2), generator=generator, device=like.device).sort(dim=1).values * W
    there = torch.rand((B, 1), generator=generator, device=like.device) < config.gap_share
    frame = torch.arange(W, device=like.device) + 0.5
    gap = there & (frame >= ends[:, :1]) & (frame < ends[:, 1:])
    return gap & ~gap.all(dim=1, keepdim=True)


def _landmark_set(
    body: Body, config: NoiseConfig, B: int, like: Tensor, generator: torch.Generator
) -> Tensor:
    """(B, J) bool: the joints a detector has at all."""
    rand = torch.rand((B, len(body.names) + 1), generator=generator, device=like.device)
    which = rand[:, -1:]
    limbs = torch.zeros(len(body.names), dtype=torch.bool, device=like.device)
    limbs[[j for limb in body.arms + body.legs for j in limb]] = True
    limbs[[j for j in range(len(body.names)) if j not in body.parents]] = True  # the head
    poor = which < config.poor_share
    sparse = (which >= config.poor_share) & (which < config.poor_share + config.sparse_share)
    return (~poor | (rand[:, :-1] > 0.2)) & (~sparse | limbs)


def _uniform(
    shape: tuple[int, ...], bounds: tuple[float, float], like: Tensor, generator: torch.Generator
) -> Tensor:
    low, high = bounds
    return low + (high - low) * torch.rand(shape, generator=generator, device=like.device)
