"""The available models: network, encoding of its input and decoding of its output.

Inference form of the lifter's network: the same answer up to rounding in less than half the time. Batch normalisation
is fused into the linear maps. The mirrored scene costs one extra half: mirroring is a permutation with signs, so each
feature and its counterpart have an even part (their sum) and an odd part (their difference). The first map of the scene
is that of the even part plus that of the odd part, the map of the mirrored scene is their difference. The last map
includes mirroring back and averaging.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lifting import videopose3d, windows
from lifting.body import Body
from lifting.model import Layer, NetworkConfig, TemporalNetwork
from lifting.windows import Encoded, Estimate, Windows, mirror_features, mirror_output
from rtof_kin.core.errors import UnknownNameError

RAYS: Final = "rays"
VIDEOPOSE3D: Final = "videopose3d"


@dataclass(frozen=True)
class Model:
    """A way from windows to estimates."""

    sizes: Callable[[Body], tuple[int, int, int]]  #: Numbers of inputs, constants and outputs of the network
    network: Callable[[NetworkConfig], TemporalNetwork]  #: Network with random weights
    encode: Callable[[Body, Windows], Encoded]  #: Network input of windows
    decode: Callable[[Body, Tensor, Any], Estimate]
    """Estimate from the network's output (B, outputs) and the encoded windows."""
    mirror_features: Callable[[Body, Tensor], Tensor]
    """Features (B, W, inputs) of the mirrored scene, whose constants are the same."""
    mirror_output: Callable[[Body, Tensor], Tensor]  #: Output (B, outputs) of the mirrored scene
    senses: bool  #: Whether it takes sensors and gives orientations

    @torch.no_grad()
    def answer(self, body: Body, network: TemporalNetwork, encoded: Encoded, flip: bool) -> Tensor:
        """Return the output (B, outputs); `flip` averages it with that of the mirrored windows."""
        output: Tensor = network(encoded.features, encoded.constants)
        if flip:
            mirrored = network(self.mirror_features(body, encoded.features), encoded.constants)
            output = (output + self.mirror_output(body, mirrored)) / 2
        return output


def _model(of: Any, network: Callable[[NetworkConfig], TemporalNetwork], senses: bool) -> Model:
    return Model(of.sizes, network, of.encode, of.decode, of.mirror_features, of.mirror_output, senses)


MODELS: Final = {
    RAYS: _model(windows, TemporalNetwork, senses=True),
    VIDEOPOSE3D: _model(videopose3d, videopose3d.PoseAndRootNetwork, senses=False),
}
"""Models by name: the package's own, see `windows`, and the baseline, see `videopose3d`."""


def model_of(name: str) -> Model:
    """Return the model of a name, a key of `MODELS`; `UnknownNameError` for others."""
    if name not in MODELS:
        raise UnknownNameError("model", [name], list(MODELS))
    return MODELS[name]


_Map = tuple[Tensor, Tensor]
"""Bias (outputs,) and weight (inputs, outputs) for `torch.addmm`; this layout is faster for few rows."""


class FoldedNetwork:
    """Fused copy of a trained network of the package's own model, without gradients.

    It computes what `windows.answer` does. It is not an `nn.Module`: for a single window, module calls
    take as long as the arithmetic.
    """

    def __init__(self, body: Body, network: TemporalNetwork, flip: bool = True):
        """Fuse the weights."""
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
