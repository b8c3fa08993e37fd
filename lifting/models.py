"""The available models: network, encoding of its input and decoding of its output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor

from lifting import videopose3d, windows
from lifting.body import Body
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.windows import Encoded, Estimate, Windows
from rtof_kin.core.errors import UnknownNameError

RAYS: Final = "rays"
VIDEOPOSE3D: Final = "videopose3d"


@dataclass(frozen=True)
class Model:
    """A way from windows to estimates."""

    sizes: Callable[[Body], tuple[int, int, int]]
    """Numbers of inputs, constants and outputs of the network."""
    network: Callable[[NetworkConfig], TemporalNetwork]
    """Network with random weights."""
    encode: Callable[[Body, Windows], Encoded]
    """Network input of windows."""
    decode: Callable[[Body, Tensor, Any], Estimate]
    """Estimate from the network's output (B, outputs) and the encoded windows."""
    mirror_features: Callable[[Body, Tensor], Tensor]
    """Features (B, W, inputs) of the mirrored scene, whose constants are the same."""
    mirror_output: Callable[[Body, Tensor], Tensor]
    """Output (B, outputs) of the mirrored scene."""
    senses: bool
    """Whether it takes sensors and gives orientations."""

    @torch.no_grad()
    def answer(self, body: Body, network: TemporalNetwork, encoded: Encoded, flip: bool) -> Tensor:
        """Return the output (B, outputs); `flip` averages it with that of the mirrored windows."""
        output: Tensor = network(encoded.features, encoded.constants)
        if flip:
            mirrored = network(self.mirror_features(body, encoded.features), encoded.constants)
            output = (output + self.mirror_output(body, mirrored)) / 2
        return output


MODELS: Final = {
    RAYS: Model(
        windows.sizes,
        TemporalNetwork,
        windows.encode,
        windows.decode,
        windows.mirror_features,
        windows.mirror_output,
        senses=True,
    ),
    VIDEOPOSE3D: Model(
        videopose3d.sizes,
        videopose3d.PoseAndRootNetwork,
        videopose3d.encode,
        videopose3d.decode,
        videopose3d.mirror_features,
        videopose3d.mirror_output,
        senses=False,
    ),
}
"""Models by name: the package's own, see `windows`, and the baseline, see `videopose3d`."""


def model_of(name: str) -> Model:
    """Return the model of a name.

    Args:
        name: a key of `MODELS`.

    Raises:
        UnknownNameError: it is not.
    """
    if name not in MODELS:
        raise UnknownNameError("model", [name], list(MODELS))
    return MODELS[name]
