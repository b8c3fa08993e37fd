"""How each model is trained: first weights, optimiser, learning rate, loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import cos, exp, log, pi

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

USUAL_RADIUS = 0.4
"""RMS distance of a person's joints from their mean across the line of sight, m: where distance
estimates start."""
EPOCHS = 60
"""Of the published training; here an epoch is this share of whatever the training lasts."""
DECAY = 0.95
"""Factor on the published learning rate from epoch to epoch."""
MOMENTUM = (0.1, 0.001)
"""Published momentum of batch normalisation, in the first epoch and after the last."""
NEAREST = 0.2
"""Depth below which a root weighs no more, m: nearer ones are not in view."""


class Recipe(ABC):
    """How a network is trained, step after step."""

    def __init__(self, config: TrainConfig):
        self.config = config

    @abstractmethod
    def prepare(self, network: TemporalNetwork, body: Body) -> None:
        """Set the first weights where torch's are not wanted."""

    @abstractmethod
    def optimizer(self, network: TemporalNetwork) -> Optimizer:
        """A fresh one."""

    @abstractmethod
    def set_rates(self, network: TemporalNetwork, optimizer: Optimizer, share: float) -> None:
        """Set what changes over the training, `share` of which is done."""

    @abstractmethod
    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """What is minimised."""

    def limit(self, network: TemporalNetwork) -> None:  # noqa: B027, as most recipes have none
        """Bound the gradient, where the recipe does."""

    def memory(self, steps: int) -> float:
        """Of the running mean of the weights after so many steps; 0 where there is none."""
        return 0.0


class Rays(Recipe):
    """AdamW with warm-up and cosine, clipped gradients, a running mean of the weights."""

    def prepare(self, network: TemporalNetwork, body: Body) -> None:
        """Begin with `first_answer`."""
        with torch.no_grad():
            network.shrink.bias.copy_(first_answer(body))

    def optimizer(self, network: TemporalNetwork) -> Optimizer:
        config = self.config
        return AdamW(network.parameters(), config.learning_rate, weight_decay=config.weight_decay)

    def set_rates(self, network: TemporalNetwork, optimizer: Optimizer, share: float) -> None:
        for group in optimizer.param_groups:
            group["lr"] = self.config.learning_rate * cosine(share, self.config.warm_up)

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        return losses.lifting_loss(estimate, batch)

    def limit(self, network: TemporalNetwork) -> None:
        nn.utils.clip_grad_norm_(network.parameters(), self.config.clip)

    def memory(self, steps: int) -> float:
        """Shorter at the beginning."""
        return min(self.config.ema, (1 + steps) / (10 + steps))


class Published(Recipe):
    """VideoPose3D's: Adam (amsgrad), a rate and a momentum that fall from epoch to epoch.

    Mirrored copies are drawn with the windows (`AugmentConfig.mirror`), edges replicated by the bank.
    """

    def prepare(self, network: TemporalNetwork, body: Body) -> None:
        """Nothing."""

    def optimizer(self, network: TemporalNetwork) -> Optimizer:
        return Adam(network.parameters(), self.config.learning_rate, amsgrad=True)

    def set_rates(self, network: TemporalNetwork, optimizer: Optimizer, share: float) -> None:
        epoch = min(int(share * EPOCHS), EPOCHS - 1)
        for group in optimizer.param_groups:
            group["lr"] = self.config.learning_rate * DECAY**epoch
        first, last = MOMENTUM
        for layer in network.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.momentum = first * exp(-epoch / EPOCHS * log(first / last))

    def loss(self, estimate: Estimate, batch: Batch) -> Tensor:
        """Mean joint distance, and that of the root weighted by 1 / depth."""
        joints = losses.mean_joint_distance(estimate.pose, batch.pose)
        return (joints + losses.root_distance(estimate.root, batch.root) / depth(batch)).mean()


RECIPES: dict[str, type[Recipe]] = {RAYS: Rays, VIDEOPOSE3D: Published}


def depth(batch: Batch) -> Tensor:
    """(B,) of the root in the camera's frame, m."""
    assert batch.windows.picture is not None
    forward = batch.windows.picture.R_camera_world[:, 2]
    return (forward * batch.root).sum(dim=1).clamp_min(NEAREST)


def cosine(share: float, warm_up: float) -> float:
    """Factor on the learning rate: linear warm-up, then a cosine to 0."""
    if share < warm_up:
        return max(share / warm_up, 0.01)
    return 0.5 * (1 + cos(pi * min((share - warm_up) / (1 - warm_up), 1.0)))


def first_answer(body: Body) -> Tensor:
    """(outputs,) that a training starts from: someone upright, at a usual distance, hardly known."""
    J = len(body.names)
    parts = [torch.zeros(3 * J - 1), torch.tensor([log(USUAL_RADIUS)]), torch.full((2 * J,), -2.5)]
    if body.sensors:
        upright = torch.zeros(2, 3, J)
        upright[0, 0] = upright[1, 2] = 1.0
        parts += [upright.flatten(), torch.full((J,), -1.0)]
    return torch.cat(parts)
