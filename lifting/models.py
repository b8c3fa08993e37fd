"""The available models: network, encoding of its input and decoding of its output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

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
    senses: bool
    """Whether it takes sensors and gives orientations."""


MODELS: Final = {
    RAYS: Model(
        lambda body: (body.inputs, body.constants, body.outputs),
        TemporalNetwork, windows.encode, windows.decode, senses=True,
    ),
    VIDEOPOSE3D: Model(
        videopose3d.sizes, videopose3d.PoseAndRootNetwork,
        videopose3d.encode, videopose3d.decode, senses=False,
    ),
}  # fmt: skip
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
