"""Training recipe of each model: first weights, optimiser, learning rate and loss."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, exp, log, pi
from typing import ClassVar, Final

import torch
from torch import Tensor, nn
from torch.optim import Adam, AdamW, Optimizer

from lifting import losses
from lifting.body import Body
from lifting.data import Batch
from lifting.model import TemporalNetwork
from lifting.models import RAYS, VIDEOPOSE3D
from lifting.settings import TrainConfig
from lifting.windows import Estimate

USUAL_RADIUS: Final = 0.4
"""First estimate of the RMS distance of a person's joints from their mean across the line of sight, m."""
EPOCHS: Final = 60
"""Epochs of the published training; here an epoch is this share of the training."""
DECAY: Final = 0.95
"""Factor on the published learning rate from epoch to epoch."""
MOMENTUM: Final = (0.1, 0.001)
"""Published momentum of batch normalisation in the first epoch and after the last."""
NEAREST: Final = 0.2
"""Least depth for the weight of a root, m."""


class Recipe:
    """AdamW with warm-up and cosine, clipped gradients, a running mean of the weights."""

    regularised: ClassVar[bool] = True
    """Whether gradients are clipped and weights averaged."""

    def __init__(self, config: TrainConfig, network: TemporalNetwork, body: Body):
        """Set the first weights and make the optimiser."""
        self.config, self.network = config, network
        self.optimizer = self._prepare(body)

    def _prepare(self, body: Body) -> Optimizer:
        with torch.no_grad():
            self.network.shrink.bias.copy_(first_answer(body))
        config = self.config
        return AdamW(self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay)

    def set_rates(self, share: float) -> None:
        """Set the learning rate after a share of the training."""
        self._set_learning_rate(_cosine(share, self.config.warm_up))

    def _set_learning_rate(self, factor: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * factor

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """Return the loss to minimise."""
        return losses.lifting_loss(estimate, batch)

    def limit(self) -> None:
        """Clip the gradient."""
        if self.regularised:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)

    def memory(self, steps: int) -> float:
        """Return the factor of the running mean of the weights after a number of steps."""
        return min(self.config.ema, (1 + steps) / (10 + steps)) if self.regularised else 0.0


class Published(Recipe):
    """VideoPose3D's: Adam (amsgrad) with a rate and a momentum that fall from epoch to epoch."""

    regularised = False

    def _prepare(self, body: Body) -> Optimizer:  # noqa: ARG002, of the base
        return Adam(self.network.parameters(), self.config.learning_rate, amsgrad=True)

    def set_rates(self, share: float) -> None:
        """Set the learning rate and the momentum of batch normalisation."""
        epoch = min(int(share * EPOCHS), EPOCHS - 1)
        self._set_learning_rate(DECAY**epoch)
        first, last = MOMENTUM
        for layer in self.network.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.momentum = first * exp(-epoch / EPOCHS * log(first / last))

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """Return the mean joint distance plus that of the root weighted by 1 / depth."""
        joints = losses.mean_joint_distance(estimate.pose, batch.pose)
        return (joints + losses.root_distance(estimate.root, batch.root) / _depth(batch)).mean()


RECIPES: Final[Mapping[str, type[Recipe]]] = {RAYS: Recipe, VIDEOPOSE3D: Published}


def _depth(batch: Batch) -> Tensor:
    """Depth (B,) of the root in the camera's frame, m."""
    assert batch.windows.picture is not None
    forward = batch.windows.picture.R_camera_world[:, 2]
    return (forward * batch.root).sum(dim=1).clamp_min(NEAREST)


def _cosine(share: float, warm_up: float) -> float:
    """Factor on the learning rate: linear warm-up, then a cosine to 0."""
    if share < warm_up:
        return max(share / warm_up, 0.01)
    return 0.5 * (1 + cos(pi * min((share - warm_up) / (1 - warm_up), 1.0)))


def first_answer(body: Body) -> Tensor:
    """Return the output (outputs,) of the first weights: upright, at a usual distance, large spread."""
    J = len(body.names)
    parts = [torch.zeros(3 * J - 1), torch.tensor([log(USUAL_RADIUS)]), torch.full((2 * J,), -2.5)]
    if body.sensors:
        upright = torch.zeros(2, 3, J)
        upright[0, 0] = upright[1, 2] = 1.0
        parts += [upright.flatten(), torch.full((J,), -1.0)]
    return torch.cat(parts)
