"""The lifter's network for use alone: the same numbers up to rounding, in less than half the time.

Batch normalisation goes into the linear maps before it. The mirrored scene is computed at once: to mirror
is a permutation with signs, so the sum and the difference of each feature and its counterpart are even
and odd in it. The first map of the scene is that of the even part plus that of the odd part, of the
mirrored scene the one less the other: together they cost one scene. Mirroring back goes into the last.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lifting.body import Body
from lifting.model import TemporalNetwork
from lifting.windows import mirror_features, mirror_output


class FoldedNetwork:
    """A copy of a trained network of the package's own kind, in its strided form.

    It answers as `windows.answer` does, and does not learn. It is no `nn.Module`: of a single window,
    calling modules takes as long as computing.
    """

    def __init__(self, body: Body, network: TemporalNetwork, flip: bool = True):
        """Take the weights.

        Args:
            body: what the network was trained for.
            network: in evaluation mode.
            flip: average with the mirrored scene.
        """
        assert network.constant is not None
        config, expand, shrink = network.config, network.expand, network.shrink
        self._width, *widths = config.filter_widths
        weight, bias, gain = _folded(expand.linear, expand.norm)
        self._constant = _map(gain[:, None] * network.constant.weight, bias)
        self._parity = _Parity(body, self._width, config.inputs) if flip else None
        firsts = self._parity.split_weight(weight) if self._parity else (weight,)
        self._firsts = [_transposed(first) for first in firsts]
        kept = [width - 1 if config.causal else width // 2 for width in widths]
        self._blocks = list(zip(_maps(network.temporal), _maps(network.pointwise), widths, kept, strict=True))
        out = torch.cat([shrink.weight, shrink.bias[:, None]], dim=1).detach()
        if flip:
            mirrored = mirror_output(body, out.T).T
            out = torch.cat([out[:, :-1], mirrored[:, :-1], out[:, -1:] + mirrored[:, -1:]], dim=1) / 2
        self._shrink = _map(out[:, :-1], out[:, -1])

    def __call__(self, features: Tensor, constants: Tensor) -> Tensor:
        """The network's output (B, outputs).

        Args:
            features: (B, receptive_field, inputs).
            constants: (B, constants).
        """
        x = self._first(features, self._constant(constants)[:, None])
        for temporal, pointwise, width, which in self._blocks:
            kept = x[:, which::width]
            hidden = temporal(x.reshape(-1, width * x.shape[2])).relu_()
            x = pointwise(hidden).relu_().reshape(kept.shape).add_(kept)
        x = x[:, 0]
        return self._shrink(torch.cat(x.chunk(2), dim=1) if self._parity else x)

    def _first(self, features: Tensor, shift: Tensor) -> Tensor:
        """(B, T, channels) after the first map; or (2 B, T, channels), the mirrored windows last."""
        B, frames, inputs = features.shape
        x = features.reshape(-1, self._width * inputs)
        parts = self._parity(x) if self._parity else (x,)
        first, *odd = (
            (part @ weight).reshape(B, frames // self._width, -1)
            for part, weight in zip(parts, self._firsts, strict=True)
        )
        first.add_(shift)
        return (_sum_and_difference(first, odd[0]) if odd else first).relu_()


class _Map(NamedTuple):
    """A linear map (n, inputs) -> (n, outputs)."""

    weight: Tensor
    """(inputs, outputs): the way it lies is faster for the few rows of a single window."""
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        return torch.addmm(self.bias, x, self.weight)


def _map(weight: Tensor, bias: Tensor) -> _Map:
    """Of a weight (outputs, inputs)."""
    return _Map(_transposed(weight), bias.detach().clone())


def _maps(layers: nn.ModuleList) -> Iterable[_Map]:
    return (
        _map(*_folded(layer.linear, layer.norm)[:2])  # type: ignore[arg-type]
        for layer in layers
    )


def _sum_and_difference(a: Tensor, b: Tensor) -> Tensor:
    """(2 B, ...) of two times (B, ...)."""
    if torch.onnx.is_in_onnx_export():  # where nothing is written in place
        return torch.cat([a + b, a - b])
    both = a.new_empty((2, *a.shape))
    torch.add(a, b, out=both[0])
    torch.sub(a, b, out=both[1])
    return both.flatten(0, 1)


def _transposed(weight: Tensor) -> Tensor:
    return weight.detach().t().clone(memory_format=torch.contiguous_format)


class _Parity:
    """Features of a few frames into the part that mirroring leaves, and the part that it negates.

    They are cut from one array that is put in order once and then changed in place: any other way costs
    as much as the linear map after it.
    """

    def __init__(self, body: Body, frames: int, inputs: int):
        n = frames * inputs
        # Row i of the mirrored identity holds, at i's counterpart, the sign.
        matrix = mirror_features(body, torch.eye(n).reshape(n, frames, inputs)).flatten(1)
        other, sign, index = matrix.abs().argmax(dim=0), matrix.sum(dim=0), torch.arange(n)
        first = index[other > index]
        even, odd = (index[(other == index) & (sign == s)] for s in (1.0, -1.0))
        self.sizes = [len(first), len(even), len(first), len(odd)]
        self.order = torch.cat([first, even, other[first], odd])
        self.signs = sign[first]

    def __call__(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Even and odd part (n, even), (n, odd) of features (n, frames * inputs)."""
        return self._split(features.index_select(1, self.order))

    def split_weight(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """What even and odd part are multiplied by, of weights (m, frames * inputs)."""
        n = self.sizes[0]
        even, odd = self._split(weight.detach().index_select(1, self.order))
        even[:, :n] /= 2
        odd[:, :n] /= 2
        return even, odd

    def _split(self, ordered: Tensor) -> tuple[Tensor, Tensor]:
        one, even, other, odd = torch.split(ordered, self.sizes, dim=1)
        if torch.onnx.is_in_onnx_export():  # where nothing is changed in place
            other = other * self.signs
            return torch.cat([one + other, even], dim=1), torch.cat([one - other, odd], dim=1)
        other.mul_(self.signs)
        difference = one - other
        one.add_(other)
        other.copy_(difference)
        n = one.shape[1] + even.shape[1]
        return ordered[:, :n], ordered[:, n:]


def _folded(before: nn.Linear, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor, Tensor]:
    """Weight and bias of a linear map with the normalisation after it, and what it is multiplied by."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return gain[:, None] * before.weight, norm.bias - gain * norm.running_mean, gain
