"""Training loss: distances in m, angles times a lever arm, and the likelihood of spreads.

Spreads (see `windows.SIGMA_ALONG`) are learnt from detached errors, so that positions and orientations
minimise the mean distance.
"""

from __future__ import annotations

from math import sqrt
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import normalize

from lifting.data import Batch
from lifting.windows import Estimate, rotations

ROOT_WEIGHT: Final = 0.3
"""Weight of the root's distance relative to the mean joint distance."""
TURN_WEIGHT: Final = 0.1
"""Weight of an angle of 1 rad relative to a mean joint distance of 1 m."""
SPREAD_WEIGHT: Final = 0.02
"""Weight of a negative log-likelihood relative to a mean joint distance of 1 m."""


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
    joints = mean_joint_distance(estimate.pose, batch.pose)
    return (joints + ROOT_WEIGHT * root_distance(estimate.root, batch.root)).mean()


def mean_joint_distance(pose: Tensor, truth: Tensor) -> Tensor:
    """Return the mean distance (B,) of root-relative joints (B, 3, J) without the root, m."""
    distance: Tensor = (pose - truth)[:, :, 1:].norm(dim=1)
    return distance.mean(dim=1)


def root_distance(root: Tensor, truth: Tensor) -> Tensor:
    """Return the distance (B,) of root positions (B, 3), m."""
    distance: Tensor = (root - truth).norm(dim=1)
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
