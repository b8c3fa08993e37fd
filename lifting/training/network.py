"""The network as it is trained; `lifting.model` has the same one for predictions."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lifting.model import NetworkConfig


class TemporalNetwork(nn.Module):
    """Residual temporal convolutions over windows: (B, receptive_field, inputs) -> (B, outputs)."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        widths, channels = config.filter_widths, config.channels
        self.expand = Layer(widths[0] * config.inputs, channels, config.dropout)
        self.constant = nn.Linear(config.constants, channels, bias=False)
        self.temporal = nn.ModuleList(Layer(width * channels, channels, config.dropout) for width in widths[1:])
        self.pointwise = nn.ModuleList(Layer(channels, channels, config.dropout) for _ in widths[1:])
        self.shrink = nn.Linear(channels, config.outputs)

    def weights(self) -> dict[str, NDArray[Any]]:
        """Return copies of the weights and running statistics by name."""
        return {name: value.detach().cpu().numpy().copy() for name, value in self.state_dict().items()}

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        """Return the output (B, outputs) of features (B, receptive_field, inputs) and constants (B, constants)."""
        if features.shape[1] != (size := self.config.receptive_field()):
            raise ValueError(f"windows of {features.shape[1]} frames; this network sees {size}")
        first, *widths = self.config.filter_widths
        x = self.expand(_fold(features, first), self.constant(constants))
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
