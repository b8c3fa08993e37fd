"""The network alone: VideoPose3D's temporal convolutions with residual blocks.

Pavllo, Feichtenhofer, Grangier, Auli: 3D human pose estimation in video with temporal convolutions
and semi-supervised training, CVPR 2019, section 3. Every convolution is written as one matrix
product over the frames it sees (channels last), so the two forms share their weights by construction:
*strided* computes one frame from a window of exactly `receptive_field` frames, *dilated* all frames of
a sequence at once. What holds for a whole window enters once, as a shift of the first layer.
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
    constants: int
    """Features that hold for a whole window."""
    outputs: int
    """Values per estimated frame."""
    filter_widths: tuple[int, ...] = (3, 3, 3)
    """Frames seen by each temporal convolution; odd. Their product is the receptive field."""
    channels: int = 256
    """Width of every hidden layer."""
    dropout: float = 0.0
    """Share of hidden values dropped in training."""
    causal: bool = False
    """Whether the last frame of a window is estimated, and not the middle one."""
    model: str = "rays"
    """What its inputs and outputs mean: one of `lifting.models.MODELS`."""


class TemporalNetwork(nn.Module):
    """Residual temporal convolutions: (B, T, inputs) -> (B, T - receptive_field + 1, outputs)."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        widths, channels = config.filter_widths, config.channels
        self.expand = _Layer(widths[0] * config.inputs, channels, config.dropout)
        self.constant = nn.Linear(config.constants, channels, bias=False) if config.constants else None
        self.temporal = nn.ModuleList(
            _Layer(width * channels, channels, config.dropout) for width in widths[1:]
        )
        self.pointwise = nn.ModuleList(_Layer(channels, channels, config.dropout) for _ in widths[1:])
        self.shrink = nn.Linear(channels, config.outputs)

    def receptive_field(self) -> int:
        """Frames that one output frame depends on."""
        return prod(self.config.filter_widths)

    def estimated(self) -> int:
        """Index of the frame of a window that is estimated."""
        return self.receptive_field() - 1 if self.config.causal else self.receptive_field() // 2

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        """Dilated form: all frames of sequences.

        Args:
            features: (B, T, inputs) with T >= receptive_field.
            constants: (B, constants).

        Returns:
            (B, T - receptive_field + 1, outputs); the first belongs to frame `estimated`.
        """
        return self._run(features, constants, strided=False)

    def forward_windows(self, features: Tensor, constants: Tensor) -> Tensor:
        """Strided form: the estimated frame of each window.

        Args:
            features: (B, receptive_field, inputs).
            constants: (B, constants).

        Returns:
            (B, outputs).
        """
        if features.shape[1] != self.receptive_field():
            raise ValueError(
                f"windows of {features.shape[1]} frames; this network sees {self.receptive_field()}"
            )
        return self._run(features, constants, strided=True)[:, 0]

    def _run(self, x: Tensor, constants: Tensor, strided: bool) -> Tensor:
        width, dilation, causal = self.config.filter_widths[0], 1, self.config.causal
        shift = self.constant(constants) if self.constant is not None else None
        x = self.expand(_fold(x, width, dilation, strided), shift)
        for temporal, pointwise, wide in zip(
            self.temporal, self.pointwise, self.config.filter_widths[1:], strict=True
        ):
            dilation *= width
            width = wide
            residual = _kept(x, width, width - 1 if causal else width // 2, dilation, strided)
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

    def forward(self, x: Tensor, shift: Tensor | None = None) -> Tensor:
        """(B, T, n_out); a shift (B, n_out) is added to what is normalised."""
        y = self.linear(x)
        if shift is not None:
            y = y + shift[:, None]
        out: Tensor = self.dropout(torch.relu(self.norm(y.flatten(0, 1))))
        return out.reshape(*x.shape[:2], -1)


def _fold(x: Tensor, width: int, dilation: int, strided: bool) -> Tensor:
    """The frames each output sees, side by side: (B, T, C) -> (B, T', width * C)."""
    if strided:
        return x.reshape(x.shape[0], x.shape[1] // width, width * x.shape[2])
    length = x.shape[1] - (width - 1) * dilation
    return torch.cat([x[:, k * dilation : k * dilation + length] for k in range(width)], dim=-1)


def _kept(x: Tensor, width: int, which: int, dilation: int, strided: bool) -> Tensor:
    """One of those frames, by its number: (B, T, C) -> (B, T', C)."""
    if strided:
        return x[:, which::width]
    length = x.shape[1] - (width - 1) * dilation
    return x[:, which * dilation : which * dilation + length]
