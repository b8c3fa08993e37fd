"""The models there are: what the network reads, what its answer means, and the network itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from lifting import videopose3d, windows
from lifting.body import Body
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.windows import Encoded, Estimate, Windows
from rtof_kin.core.errors import UnknownNameError

RAYS = "rays"
VIDEOPOSE3D = videopose3d.NAME


@dataclass(frozen=True)
class Model:
    """One way from windows to estimates."""

    sizes: Callable[[Body], tuple[int, int, int]]
    """Inputs, constants and outputs of the network."""
    network: Callable[[NetworkConfig], TemporalNetwork]
    """The network of a shape, with random weights."""
    encode: Callable[[Body, Windows], Encoded]
    """Its input."""
    decode: Callable[[Body, Tensor, Any], Estimate]
    """What its answer (B, outputs) to something encoded says."""
    senses: bool
    """Whether it takes sensors, and gives orientations."""


MODELS = {
    RAYS: Model(
        lambda body: (body.inputs, body.constants, body.outputs),
        TemporalNetwork,
        windows.encode,
        windows.decode,
        senses=True,
    ),
    VIDEOPOSE3D: Model(
        videopose3d.sizes,
        videopose3d.PoseAndRootNetwork,
        videopose3d.encode,
        videopose3d.decode,
        senses=False,
    ),
}
"""By name. rays: the package's own, see `windows`. videopose3d: the baseline, see `videopose3d`."""


def model_of(name: str) -> Model:
    """The model of a name.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in MODELS:
        raise UnknownNameError("model", [name], list(MODELS))
    return MODELS[name]
