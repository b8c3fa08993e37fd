"""The lifter's network for use alone: the same numbers up to rounding, in less than half the time.

Batch normalisation goes into the linear maps before it. The mirrored scene is computed at once: to mirror
is a permutation with signs, so the sum and the difference of each feature and its counterpart are even
and odd in it. The first map of the scene is that of the even part plus that of the odd part, of the
mirrored scene the one less the other: together they cost one scene. Mirroring back goes into the last.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lifting.body import Body
from lifting.model import TemporalNetwork
from lifting.windows import mirror_features, mirror_output


class FoldedNetwork(nn.Module):
    """A copy of a trained network of the package's own kind, in its strided form.

    `forward` answers as `windows.answer` does. The weights cannot be trained further.
    """

    def __init__(self, body: Body, network: TemporalNetwork, flip: bool = True):
        """Take the weights.

        Args:
            body: what the network was trained for.
            network: in evaluation mode.
            flip: average with the mirrored scene.
        """
        super().__init__()
        self.config, self.flip = network.config, flip
        weight, bias, gain = _folded(network.expand.linear, network.expand.norm)
        assert network.constant is not None
        self.constant = _Map(gain[:, None] * network.constant.weight, bias)
        self.temporal = _maps(network.temporal)
        self.pointwise = _maps(network.pointwise)
        width, inputs = self.config.filter_widths[0], self.config.inputs
        out, out_bias = network.shrink.weight.detach(), network.shrink.bias.detach()
        if flip:
            self.parity = _Parity(body, width, inputs)
            self.even, self.odd = map(_Map, self.parity.split_weight(weight))
            mirrored = mirror_output(body, torch.cat([out, out_bias[:, None]], dim=1).T).T
            out = torch.cat([out, mirrored[:, :-1]], dim=1) / 2
            out_bias = (out_bias + mirrored[:, -1]) / 2
        else:
            self.first = _Map(weight)
        self.shrink = _Map(out, out_bias)
        self.eval()

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        """The network's output (B, outputs).

        Args:
            features: (B, receptive_field, inputs).
            constants: (B, constants).
        """
        x = self._first(features, self.constant(constants)[:, None])
        for temporal, pointwise, width in zip(
            self.temporal, self.pointwise, self.config.filter_widths[1:], strict=True
        ):
            kept = x[:, (width - 1 if self.config.causal else width // 2) :: width]
            hidden = temporal(x.reshape(-1, width * x.shape[2])).relu_()
            x = pointwise(hidden).relu_().reshape(kept.shape).add_(kept)
        # Of both scenes side by side, see `shrink`.
        out: Tensor = self.shrink(torch.cat(x.chunk(2), dim=2)[:, 0] if self.flip else x[:, 0])
        return out

    def _first(self, features: Tensor, shift: Tensor) -> Tensor:
        """(B, T, channels) after the first map; or (2 B, T, channels), the mirrored windows last."""
        width = self.config.filter_widths[0]
        B, length = features.shape[0], features.shape[1] // width
        x = features.reshape(B * length, width * features.shape[2])
        if not self.flip:
            first: Tensor = self.first(x).reshape(B, length, -1)
            return first.add_(shift).relu_()
        even, odd = self.parity(x)
        a = self.even(even).reshape(B, length, -1).add_(shift)
        b = self.odd(odd).reshape(B, length, -1)
        return torch.cat([a + b, a.sub_(b)]).relu_()


class _Map(nn.Module):
    """A linear map (n, inputs) -> (n, outputs) that does not learn.

    Its weight lies transposed, which is faster for the few rows of a single window.
    """

    weight: Tensor
    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None = None):
        super().__init__()
        transposed = weight.detach().t().clone(memory_format=torch.contiguous_format)
        self.register_buffer("weight", transposed)
        self.register_buffer("bias", None if bias is None else bias.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        if self.bias is None:
            return x @ self.weight
        return torch.addmm(self.bias, x, self.weight)


class _Parity(nn.Module):
    """Features of a few frames into the part that mirroring leaves, and the part that it negates.

    They are cut from one array that is put in order once and then changed in place: any other way costs
    as much as the linear map after it.
    """

    order: Tensor
    signs: Tensor

    def __init__(self, body: Body, frames: int, inputs: int):
        super().__init__()
        n = frames * inputs
        # Row i of the mirrored identity holds, at i's counterpart, the sign.
        matrix = mirror_features(body, torch.eye(n).reshape(n, frames, inputs)).flatten(1)
        other, sign, index = matrix.abs().argmax(dim=0), matrix.sum(dim=0), torch.arange(n)
        first = index[other > index]
        even, odd = (index[(other == index) & (sign == s)] for s in (1.0, -1.0))
        self.sizes = [len(first), len(even), len(first), len(odd)]
        self.register_buffer("order", torch.cat([first, even, other[first], odd]))
        self.register_buffer("signs", sign[first])

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
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


def _maps(layers: nn.ModuleList) -> nn.ModuleList:
    return nn.ModuleList(
        _Map(*_folded(layer.linear, layer.norm)[:2])  # type: ignore[arg-type]
        for layer in layers
    )


def _folded(before: nn.Linear, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor, Tensor]:
    """Weight and bias of a linear map with the normalisation after it, and what it is multiplied by."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return gain[:, None] * before.weight, norm.bias - gain * norm.running_mean, gain
