"""Training loss: distances in m, angles times a lever arm, and the likelihood of spreads; validation.

Spreads (see `windows.SIGMA_ALONG`) are learnt from detached errors, so that positions and orientations
minimise the mean distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import sqrt
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import normalize

from lifting.body import Body
from lifting.model import FoldedNetwork
from lifting.training.corpus import Corpus
from lifting.training.data import AugmentConfig, Batch, MotionBank, plain
from lifting.training.noise import SENSED_TRUNK, VALIDATION_NOISE, SensorConfig
from lifting.windows import Estimate, decode, encode, rotations

ROOT_WEIGHT: Final = 0.3  #: Weight of the root's distance relative to the mean joint distance
TURN_WEIGHT: Final = 0.1  #: Weight of an angle of 1 rad relative to a mean joint distance of 1 m
SPREAD_WEIGHT: Final = 0.02  #: Weight of a negative log-likelihood relative to a mean joint distance of 1 m


def lifting_loss(estimate: Estimate, batch: Batch) -> Tensor:
    """Return the mean total loss of a batch."""
    loss = position_loss(estimate, batch)
    loss = loss + SPREAD_WEIGHT * spread_of_positions(estimate, batch)
    if estimate.axes is not None and estimate.log_turn is not None:
        angle = turn_angles(estimate.axes, batch.axes)
        loss = loss + TURN_WEIGHT * angle.mean()
        spread = likelihood(angle.detach(), estimate.log_turn, 3)
        loss = loss + SPREAD_WEIGHT * spread.mean()
    return loss


def position_loss(estimate: Estimate, batch: Batch) -> Tensor:
    """Return the batch mean of joint distance + `ROOT_WEIGHT` x root distance, m."""
    joints = (estimate.pose - batch.pose)[:, :, 1:].norm(dim=1).mean(dim=1)
    distance: Tensor = (joints + ROOT_WEIGHT * (estimate.root - batch.root).norm(dim=1)).mean()
    return distance


def turn_angles(axes: Tensor, truth: Tensor) -> Tensor:
    """Return angles (B, J) between segments with axes (B, 3, 2, J), as chords of the unit circle, rad."""
    chord: Tensor = (rotations(axes) - rotations(truth)).flatten(1, 2).norm(dim=1) / sqrt(2)
    return chord


def errors_by_direction(estimate: Estimate, batch: Batch) -> Tensor:
    """Return lengths (B, 2, J) of errors across and along the ray to the root, m; see `log_spread`."""
    distance = batch.root.norm(dim=1)[:, None]
    ray = normalize(batch.root)
    error = estimate.pose - batch.pose
    error = torch.cat([((estimate.root - batch.root) / distance)[..., None], error[..., 1:]], dim=2)
    along = torch.einsum("bc,bcj->bj", ray, error)
    across = (error - ray[..., None] * along[:, None]).norm(dim=1)
    return torch.stack([across, along.abs()], dim=1)


def spread_of_positions(estimate: Estimate, batch: Batch) -> Tensor:
    """Return the mean negative log-likelihood of position errors under their spreads."""
    across, along = errors_by_direction(estimate, batch).detach().unbind(dim=1)
    log_across, log_along = estimate.log_spread.unbind(dim=1)
    return (likelihood(across, log_across, 2) + likelihood(along, log_along, 1)).mean()


def likelihood(length: Tensor, log_scale: Tensor, dimensions: int) -> Tensor:
    """Return the negative log-likelihood, up to a constant, of the length of an error."""
    return length * (-log_scale).exp() + dimensions * log_scale


SEED = 20_000
_SENSED = SensorConfig(
    none=0.0, limbs=0.0, limbs_and_trunk=0.0, ends=0.0, every=0.0, amplitude=(1.0, 1.0), lag=(1.0, 3.0), missing=0.0
)


class Validation:
    """Fixed windows of the validation subjects; none if the corpus has no such subjects."""

    def __init__(self, corpus: Corpus, window: int, device: torch.device, count: int = 4096, causal: bool = False):
        """Draw the windows. window: frames per window. count: windows of each kind, evenly over the motion."""
        self.body = corpus.body()
        self.batches: dict[str, Batch] = {}
        clips = corpus.clips("validation", required=False)
        if not clips:
            return
        bank = MotionBank(corpus, clips, device)
        frames = torch.linspace(0, len(bank) - 1, count, device=device).long()
        for name, config in _kinds(bool(self.body.sensors)).items():
            generator = torch.Generator(device).manual_seed(SEED)
            self.batches[name] = bank.draw(count, window, config, generator, frames, causal)

    def measure(self, network: FoldedNetwork) -> dict[str, dict[str, float]]:
        """Return errors by kind of 2D: mean per joint position error, root-relative (with the root's 0) and
        absolute, mm, and for a body with sensors the angles of pelvis and upper trunk, deg.
        """
        return {name: _errors(self.body, self._estimate(network, batch), batch) for name, batch in self.batches.items()}

    def _estimate(self, network: FoldedNetwork, batch: Batch) -> Estimate:
        encoded = encode(self.body, batch.windows)
        return decode(self.body, network(encoded.features, encoded.constants), encoded)


def _kinds(sensed: bool) -> dict[str, AugmentConfig]:
    """Settings of each kind, by name."""
    realistic = plain(VALIDATION_NOISE["realistic"])
    kinds = {
        "perfect": plain(),
        "realistic": realistic,
        "independent": plain(VALIDATION_NOISE["independent"]),
        "perfect, bones unknown": replace(plain(), hide_bones=1.0),
        "realistic, floor known": replace(realistic, hide_height=0.0),
    }
    if sensed:
        worn = {"8": replace(_SENSED, limbs=1.0), "10": replace(_SENSED, limbs_and_trunk=1.0)}
        for name, sensors in worn.items():
            kinds[f"realistic, {name} sensors"] = replace(realistic, sensors=sensors)
    return kinds


def _errors(body: Body, estimate: Estimate, batch: Batch) -> dict[str, float]:
    error = estimate.pose - batch.pose
    absolute = error + (estimate.root - batch.root)[:, :, None]

    def mean(x: Tensor, unit: Callable[[Tensor], Tensor] = lambda x: 1000 * x) -> float:
        return round(float(unit(x.mean())), 2)

    errors = {"rr_mm": mean(error.norm(dim=1)), "abs_mm": mean(absolute.norm(dim=1))}
    if estimate.axes is not None:
        chord = turn_angles(estimate.axes, batch.axes)
        angle = 2 * torch.asin((chord / 2).clamp(max=1))
        for name, key in zip(SENSED_TRUNK, ("pelvis_deg", "upper_trunk_deg"), strict=True):
            errors[key] = mean(angle[:, body.names.index(name)], torch.rad2deg)
    return errors
