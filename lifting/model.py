"""The network: VideoPose3D's temporal convolutions with residual blocks.

Pavllo, Feichtenhofer, Grangier, Auli: 3D human pose estimation in video with temporal convolutions
and semi-supervised training, CVPR 2019, section 3, in its strided form: one frame is estimated from a
window of `receptive_field` frames. A convolution is one matrix product over the frames it sees (channels
last). Features of a whole window are a shift of the first layer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Final

import numpy as np

from lifting.arrays import Tensor, like, namespace
from lifting.body import Body
from lifting.windows import mirror_features, mirror_output


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

    def receptive_field(self) -> int:
        """Return the number of frames of a window."""
        return prod(self.filter_widths)

    def estimated(self) -> int:
        """Return the index of the estimated frame in a window."""
        return self.receptive_field() - 1 if self.causal else self.receptive_field() // 2

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of weights and running statistics by their names, those of `training.network`."""
        n, further = self.channels, list(enumerate(self.filter_widths[1:]))
        layers = {"expand": self.filter_widths[0] * self.inputs}
        layers |= {f"temporal.{i}": width * n for i, width in further} | {f"pointwise.{i}": n for i, _ in further}
        shapes: dict[str, tuple[int, ...]] = {f"{name}.linear.weight": (n, size) for name, size in layers.items()}
        shapes |= {f"{layer}.norm.{part}": (n,) for layer in layers for part in _NORM}
        shapes |= {f"{layer}.norm.num_batches_tracked": () for layer in layers}
        last = {"shrink.weight": (self.outputs, n), "shrink.bias": (self.outputs,)}
        return shapes | last | {"constant.weight": (n, self.constants)}


_NORM: Final = ("running_mean", "running_var", "weight", "bias")
_EPSILON: Final = 1e-5  #: That of `torch.nn.BatchNorm1d`


class FoldedNetwork:
    """A trained network, fused: what `training.network.TemporalNetwork` computes, in half the time.

    Batch normalisation is fused into the linear maps. The mirrored scene costs one extra half: mirroring is a
    permutation with signs, so each feature and its counterpart have an even part (their sum) and an odd part (their
    difference). The first map of the scene is that of the even part plus that of the odd part, the map of the mirrored
    scene is their difference. The last map includes mirroring back and averaging.
    """

    def __init__(self, body: Body, config: NetworkConfig, weights: Mapping[str, Tensor], flip: bool = True):
        """Fuse weights of these `NetworkConfig.weight_shapes`; `flip` averages with the mirrored windows."""
        self._width, *widths = config.filter_widths
        gain, self._bias = _norm(weights, "expand")
        self._constant = weights["constant.weight"].T * gain
        self._parity = _Parity(body, self._width, config.inputs, gain) if flip else None
        first = weights["expand.linear.weight"] * gain[:, None]
        self._firsts = [part.T for part in (self._parity.split_weight(first) if self._parity else [first])]
        kept = [width - 1 if config.causal else width // 2 for width in widths]
        maps = [[_fused(weights, f"{kind}.{i}") for i in range(len(widths))] for kind in ("temporal", "pointwise")]
        self._blocks = list(zip(*maps, widths, kept, strict=True))
        out, bias = weights["shrink.weight"].T, weights["shrink.bias"]
        if flip:
            out = namespace(out).concat([out, mirror_output(body, out)], axis=0) / 2
            bias = (bias + mirror_output(body, bias[None])[0]) / 2
        self._shrink = bias, out

    def __call__(self, features: Tensor, constants: Tensor) -> Tensor:
        """Return the output (B, outputs) of features (B, receptive_field, inputs) and constants (B, constants)."""
        x = self._first(features, (constants @ self._constant + self._bias)[:, None])
        for temporal, pointwise, width, which in self._blocks:
            kept = x[:, which::width]
            hidden = _rectified(x.reshape(-1, width * x.shape[2]) @ temporal[1] + temporal[0])
            x = _rectified(hidden @ pointwise[1] + pointwise[0]).reshape(kept.shape)
            x += kept
        parts = x.reshape(2 if self._parity else 1, -1, x.shape[2])  # the mirrored windows are the second half
        return namespace(x).concat([*parts], axis=1) @ self._shrink[1] + self._shrink[0]

    def _first(self, features: Tensor, shift: Tensor) -> Tensor:
        """First layer (B, T, channels), or (2 B, T, channels) with the mirrored windows last."""
        B, frames, inputs = features.shape
        x = features.reshape(-1, self._width * inputs)
        parts = self._parity.split(x) if self._parity else [x]
        first, *odd = (
            (part @ weight).reshape(B, frames // self._width, -1)
            for part, weight in zip(parts, self._firsts, strict=True)
        )
        first += shift
        return _rectified(namespace(x).concat([first + odd[0], first - odd[0]]) if odd else first)


def _norm(weights: Mapping[str, Tensor], layer: str) -> tuple[Tensor, Tensor]:
    """Gain and bias (outputs,) of a layer's batch normalisation."""
    mean, variance, scale, bias = (weights[f"{layer}.norm.{part}"] for part in _NORM)
    gain = scale / namespace(scale).sqrt(variance + _EPSILON)
    return gain, bias - mean * gain


def _fused(weights: Mapping[str, Tensor], layer: str) -> tuple[Tensor, Tensor]:
    """Bias (outputs,) and weight (inputs, outputs) of a layer with its batch normalisation."""
    gain, bias = _norm(weights, layer)
    return bias, weights[f"{layer}.linear.weight"].T * gain


def _rectified(x: Tensor) -> Tensor:
    """Positive part, in place where it can be."""
    return np.maximum(x, 0, out=x) if isinstance(x, np.ndarray) else x.relu_()


class _Parity:
    """Split of the features of a few frames into even and odd part under mirroring."""

    def __init__(self, body: Body, frames: int, inputs: int, weights: Tensor):
        n = frames * inputs
        # Row i of the mirrored identity has the sign at the counterpart of i.
        matrix = mirror_features(body, np.eye(n).reshape(n, frames, inputs)).reshape(n, n)
        other, sign, index = abs(matrix).argmax(axis=0), matrix.sum(axis=0), np.arange(n)
        first = index[other > index]
        even, odd = (index[(other == index) & (sign == s)] for s in (1.0, -1.0))
        self._stops = np.cumsum([len(first), len(even), len(first)]).tolist()
        self._order = namespace(weights).asarray(np.concatenate([first, even, other[first], odd]))
        self._signs = like(weights, sign[first])

    def split(self, x: Tensor) -> list[Tensor]:
        """Even and odd part (n, even), (n, odd) of features (n, frames * inputs)."""
        xp, x, (a, b, c) = namespace(x), x[:, self._order], self._stops
        one, even, other, odd = x[:, :a], x[:, a:b], x[:, b:c], x[:, c:]
        other = other * self._signs
        return [xp.concat([one + other, even], axis=1), xp.concat([one - other, odd], axis=1)]

    def split_weight(self, weight: Tensor) -> list[Tensor]:
        """Weights (m, even), (m, odd) of both parts from a weight (m, frames * inputs)."""
        parts = self.split(weight)
        for part in parts:
            part[:, : self._stops[0]] /= 2
        return parts
