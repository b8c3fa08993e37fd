"""The network alone: VideoPose3D's temporal convolutions with residual blocks.

Pavllo, Feichtenhofer, Grangier, Auli: 3D human pose estimation in video with temporal convolutions
and semi-supervised training, CVPR 2019, section 3. Every convolution is written as one matrix
product over the frames it sees (channels last), so the two forms share their weights by construction:
*strided* computes one frame from a window of exactly `receptive_field` frames, *dilated* all frames of
a sequence at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network."""

    inputs: int
    """Features per frame."""
    outputs: int
    """Values per estimated frame."""
    filter_widths: tuple[int, ...] = (3, 3, 3)
    """Frames seen by each temporal convolution; odd. Their product is the receptive field."""
    channels: int = 256
    """Width of every hidden layer."""
    dropout: float = 0.0
    """Share of hidden values dropped in training."""


class TemporalNetwork(nn.Module):
    """Residual temporal convolutions: (B, T, inputs) -> (B, T - receptive_field + 1, outputs)."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        widths, channels = config.filter_widths, config.channels
        self.expand = _Layer(widths[0] * config.inputs, channels, config.dropout)
        self.temporal = nn.ModuleList(
            _Layer(width * channels, channels, config.dropout) for width in widths[1:]
        )
        self.pointwise = nn.ModuleList(
            _Layer(channels, channels, config.dropout) for _ in widths[1:]
        )
        self.shrink = nn.Linear(channels, config.outputs)

    def receptive_field(self) -> int:
        """Frames that one output frame depends on."""
        return prod(self.config.filter_widths)

    def forward(self, features: Tensor) -> Tensor:
        """Dilated form: all frames of sequences.

        Args:
            features: (B, T, inputs) with T >= receptive_field.

        Returns:
            (B, T - receptive_field + 1, outputs); the first belongs to the middle of the first window.
        """
        return self._run(features, strided=False)

    def forward_windows(self, features: Tensor) -> Tensor:
        """Strided form: the middle frame of each window.

        Args:
            features: (B, receptive_field, inputs).

        Returns:
            (B, outputs).
        """
        if features.shape[1] != self.receptive_field():
            raise ValueError(
                f"windows of {features.shape[1]} frames; this network sees {self.receptive_field()}"
            )
        return self._run(features, strided=True)[:, 0]

    def _run(self, x: Tensor, strided: bool) -> Tensor:
        width, dilation = self.config.filter_widths[0], 1
        x = self.expand(_fold(x, width, dilation, strided))
        for temporal, pointwise, wide in zip(
            self.temporal, self.pointwise, self.config.filter_widths[1:], strict=True
        ):
            dilation *= width
            width = wide
            residual = _centre(x, width, dilation, strided)
            x = residual + pointwise(temporal(_fold(x, width, dilation, strided)))
        out: Tensor = self.shrink(x)
        return out


class _Layer(nn.Module):
    """Linear map, batch normalisation, rectifier and dropout of (B, T, n_in) -> (B, T, n_out)."""

    def __init__(self, n_in: int, n_out: int, dropout: float):
        super().__init__()
        self.linear = nn.Linear(n_in, n_out, bias=False)
        self.norm = nn.BatchNorm1d(n_out)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        flat = self.norm(self.linear(x.flatten(0, 1)))
        out: Tensor = self.dropout(torch.relu(flat))
        return out.reshape(*x.shape[:2], -1)


def _fold(x: Tensor, width: int, dilation: int, strided: bool) -> Tensor:
    """The frames each output sees, side by side: (B, T, C) -> (B, T', width * C)."""
    if strided:
        return x.reshape(x.shape[0], x.shape[1] // width, width * x.shape[2])
    length = x.shape[1] - (width - 1) * dilation
    return torch.cat([x[:, k * dilation : k * dilation + length] for k in range(width)], dim=-1)


def _centre(x: Tensor, width: int, dilation: int, strided: bool) -> Tensor:
    """The middle one of those frames: (B, T, C) -> (B, T', C)."""
    if strided:
        return x[:, width // 2 :: width]
    margin = (width // 2) * dilation
    return x[:, margin : x.shape[1] - margin]
