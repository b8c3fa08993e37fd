"""The network: VideoPose3D's temporal convolutions with residual blocks.

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
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lifting.body import Body
from lifting.windows import EncodedWindows, mirror_features, mirror_output


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


_Map = tuple[Tensor, Tensor]
"""Bias (outputs,) and weight (inputs, outputs) for `torch.addmm`; this layout is faster for few rows."""


@torch.no_grad()
def answer(body: Body, network: TemporalNetwork, encoded: EncodedWindows, flip: bool) -> Tensor:
    """Return the output (B, outputs) of a network; `flip` averages it with that of the mirrored windows."""
    output: Tensor = network(encoded.features, encoded.constants)
    if flip:
        mirrored = network(mirror_features(body, encoded.features), encoded.constants)
        output = (output + mirror_output(body, mirrored)) / 2
    return output


class FoldedNetwork:
    """Fused copy of a trained network, without gradients: what `answer` computes, up to rounding in half the time.

    Batch normalisation is fused into the linear maps. The mirrored scene costs one extra half: mirroring is a
    permutation with signs, so each feature and its counterpart have an even part (their sum) and an odd part (their
    difference). The first map of the scene is that of the even part plus that of the odd part, the map of the mirrored
    scene is their difference. The last map includes mirroring back and averaging. It is not an `nn.Module`: for a
    single window, module calls take as long as the arithmetic.
    """

    def __init__(self, body: Body, network: TemporalNetwork, flip: bool = True):
        assert network.constant is not None
        config, expand, shrink = network.config, network.expand, network.shrink
        self._width, *widths = config.filter_widths
        self._constant = _map(fuse_linear_bn_eval(network.constant, expand.norm))
        self._parity = _Parity(body, self._width, config.inputs) if flip else None
        first = fuse_linear_bn_eval(expand.linear, expand.norm).weight.detach()
        firsts = self._parity.split_weight(first) if self._parity else (first,)
        self._firsts = [_transposed(part) for part in firsts]
        temporal, pointwise = map(_maps, (network.temporal, network.pointwise))
        kept = [width - 1 if config.causal else width // 2 for width in widths]
        self._blocks = list(zip(temporal, pointwise, widths, kept, strict=True))
        out = torch.cat([shrink.weight, shrink.bias[:, None]], dim=1).detach()
        if flip:
            mirrored = mirror_output(body, out.T).T
            out = torch.cat([out[:, :-1], mirrored[:, :-1], out[:, -1:] + mirrored[:, -1:]], dim=1) / 2
        self._shrink = out[:, -1].clone(), _transposed(out[:, :-1])

    def __call__(self, features: Tensor, constants: Tensor) -> Tensor:
        """Return the output (B, outputs) of features (B, receptive_field, inputs) and constants (B, constants)."""
        x = self._first(features, torch.addmm(self._constant[0], constants, self._constant[1])[:, None])
        for temporal, pointwise, width, which in self._blocks:
            kept = x[:, which::width]
            hidden = torch.addmm(temporal[0], x.reshape(-1, width * x.shape[2]), temporal[1]).relu_()
            x = torch.addmm(pointwise[0], hidden, pointwise[1]).relu_().reshape(kept.shape).add_(kept)
        x = x[:, 0]
        if self._parity:
            x = torch.cat(x.chunk(2), dim=1)
        return torch.addmm(self._shrink[0], x, self._shrink[1])

    def _first(self, features: Tensor, shift: Tensor) -> Tensor:
        """First layer (B, T, channels), or (2 B, T, channels) with the mirrored windows last."""
        B, frames, inputs = features.shape
        x = features.reshape(-1, self._width * inputs)
        parts = self._parity.split(x) if self._parity else (x,)
        first, *odd = (
            (part @ weight).reshape(B, frames // self._width, -1)
            for part, weight in zip(parts, self._firsts, strict=True)
        )
        first.add_(shift)
        return (torch.cat([first + odd[0], first - odd[0]]) if odd else first).relu_()


def _map(linear: nn.Linear) -> _Map:
    return linear.bias.detach(), _transposed(linear.weight)


def _maps(layers: nn.ModuleList) -> list[_Map]:
    return [_map(fuse_linear_bn_eval(each.linear, each.norm)) for each in layers if isinstance(each, Layer)]


def _transposed(weight: Tensor) -> Tensor:
    return weight.detach().t().clone(memory_format=torch.contiguous_format)


class _Parity:
    """Split of the features of a few frames into even and odd part under mirroring."""

    def __init__(self, body: Body, frames: int, inputs: int):
        n = frames * inputs
        # Row i of the mirrored identity has the sign at the counterpart of i.
        matrix = mirror_features(body, torch.eye(n).reshape(n, frames, inputs)).flatten(1)
        other, sign, index = matrix.abs().argmax(dim=0), matrix.sum(dim=0), torch.arange(n)
        first = index[other > index]
        even, odd = (index[(other == index) & (sign == s)] for s in (1.0, -1.0))
        self._sizes = [len(first), len(even), len(first), len(odd)]
        self._order = torch.cat([first, even, other[first], odd])
        self._signs = sign[first]

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Even and odd part (n, even), (n, odd) of features (n, frames * inputs)."""
        one, even, other, odd = torch.split(x.index_select(1, self._order), self._sizes, dim=1)
        other = other * self._signs
        return torch.cat([one + other, even], dim=1), torch.cat([one - other, odd], dim=1)

    def split_weight(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (m, even), (m, odd) of both parts from a weight (m, frames * inputs)."""
        even, odd = self.split(weight)
        n = self._sizes[0]
        even[:, :n] /= 2
        odd[:, :n] /= 2
        return even, odd
