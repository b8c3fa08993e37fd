"""The network alone: VideoPose3D's temporal convolutions with residual blocks.

Pavllo, Feichtenhofer, Grangier, Auli: 3D human pose estimation in video with temporal convolutions
and semi-supervised training, CVPR 2019, section 3, in its strided form: one frame is estimated from a
window of `receptive_field` frames. A convolution is one matrix product over the frames it sees (channels
last). Features of a whole window are a shift of the first layer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network."""

    inputs: int  #: Features per frame
    constants: int  #: Features per window
    outputs: int  #: Values per estimated frame
    filter_widths: tuple[int, ...] = (3, 3, 3)
    """Frames seen by each temporal convolution, odd; their product is the receptive field."""
    channels: int = 256  #: Width of every hidden layer
    dropout: float = 0.0  #: Share of hidden values dropped in training
    causal: bool = False  #: Whether the last frame of a window is estimated, not the middle one
    model: str = "rays"  #: One of `lifting.models.MODELS`: the meaning of inputs and outputs


class TemporalNetwork(nn.Module):
    """Residual temporal convolutions over windows: (B, receptive_field, inputs) -> (B, outputs)."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        widths, channels = config.filter_widths, config.channels
        self.expand = Layer(widths[0] * config.inputs, channels, config.dropout)
        self.constant = nn.Linear(config.constants, channels, bias=False) if config.constants else None
        self.temporal = nn.ModuleList(Layer(width * channels, channels, config.dropout) for width in widths[1:])
        self.pointwise = nn.ModuleList(Layer(channels, channels, config.dropout) for _ in widths[1:])
        self.shrink = nn.Linear(channels, config.outputs)

    def receptive_field(self) -> int:
        """Return the number of frames of a window."""
        return prod(self.config.filter_widths)

    def estimated(self) -> int:
        """Return the index of the estimated frame in a window."""
        return self.receptive_field() - 1 if self.config.causal else self.receptive_field() // 2

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        """Return the output (B, outputs) of features (B, receptive_field, inputs) and constants (B, constants)."""
        if features.shape[1] != self.receptive_field():
            raise ValueError(f"windows of {features.shape[1]} frames; this network sees {self.receptive_field()}")
        first, *widths = self.config.filter_widths
        shift = self.constant(constants) if self.constant is not None else None
        x = self.expand(_fold(features, first), shift)
        for temporal, pointwise, width in zip(self.temporal, self.pointwise, widths, strict=True):
            kept = x[:, (width - 1 if self.config.causal else width // 2) :: width]
            x = kept + pointwise(temporal(_fold(x, width)))
        out: Tensor = self.shrink(x)
        return out[:, 0]


class Layer(nn.Module):
    """Linear map, batch normalisation, rectifier and dropout of (B, T, n_in) -> (B, T, n_out)."""

    def __init__(self, n_in: int, n_out: int, dropout: float):
        super().__init__()
        self.linear = nn.Linear(n_in, n_out, bias=False)
        self.norm = nn.BatchNorm1d(n_out)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, shift: Tensor | None = None) -> Tensor:
        """Return (B, T, n_out); a shift (B, n_out) is added before normalisation."""
        y = self.linear(x)
        if shift is not None:
            y = y + shift[:, None]
        out: Tensor = self.dropout(torch.relu(self.norm(y.flatten(0, 1))))
        return out.reshape(*x.shape[:2], -1)


def _fold(x: Tensor, width: int) -> Tensor:
    """Concatenate each `width` frames: (B, T, C) -> (B, T / width, width * C)."""
    return x.reshape(x.shape[0], x.shape[1] // width, width * x.shape[2])


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Limit torch to `count` threads inside; a second one costs more than it gains on small windows."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
