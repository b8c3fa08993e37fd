"""A whole lifter as one function of plain arrays: what is seen and sensed in windows to poses.

It is what leaves for other languages (`onnx_export`). Arrays are (B, time, element, component), as
everywhere outside `lifting`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lifting.body import Body
from lifting.folded import FoldedNetwork
from lifting.model import TemporalNetwork
from lifting.windows import SIGMA_TURN, Windows, decode, encode, rotations


class WindowPoses(NamedTuple):
    """Poses in the estimated frame of B windows, in world axes."""

    p_root_joint: Tensor
    """(B, J, 3) joints relative to the root, m."""
    p_camera_root: Tensor
    """(B, 3) the root from the optical centre, m."""
    sigma_m: Tensor
    """(B, J, 2) standard deviation per axis across the camera's ray and along it, m: of joints relative
    to the root, and in the root's place of the root."""
    R_world_bone: Tensor
    """(B, J, 3, 3) orientations of segments; J = 0 for a lifter that gives none."""
    sigma_rad: Tensor
    """(B, J) their standard deviation per axis, rad; likewise."""


class LifterGraph(nn.Module):
    """Encode, network and decode of the package's own kind of lifter."""

    def __init__(self, body: Body, network: TemporalNetwork, flip: bool = True):
        """Take a network in evaluation mode; `flip` averages with the mirrored scene."""
        super().__init__()
        self.body, self.network = body, FoldedNetwork(body, network, flip)
        self.estimated = network.estimated()
        self.eval()

    def forward(
        self,
        rays_world: Tensor,
        seen: Tensor,
        bones: Tensor,
        camera_height: Tensor,
        R_world_sensed: Tensor,
        sensed: Tensor,
    ) -> WindowPoses:
        """Poses of windows of W frames.

        Args:
            rays_world: (B, W, J, 3) directions in world from the optical centre to the joints.
            seen: (B, W, J) bool; what is not seen is not read.
            bones: (B, 3 G) m, see `Body.bones_of`; NaN in a row where they are unknown.
            camera_height: (B,) height of the optical centre over the floor, m; NaN where unknown.
            R_world_sensed: (B, W, S, 3, 3) orientations of the segments that may carry sensors.
            sensed: (B, W, S) bool; what is not sensed is not read.
        """
        rays = torch.where(seen[..., None], rays_world, 0.0).permute(0, 3, 1, 2)
        axes = torch.stack([R_world_sensed[..., 0], R_world_sensed[..., 2]], dim=2)
        axes = torch.where(sensed[:, :, None, :, None], axes, 0.0).permute(0, 4, 1, 2, 3)
        windows = Windows(rays, seen, bones, camera_height, axes, sensed, self.estimated)
        encoded = encode(self.body, windows)
        estimate = decode(self.body, self.network(encoded.features, encoded.constants), encoded)
        sigma = estimate.sigma_m()
        if estimate.axes is None or estimate.log_turn is None:
            R, turn = sigma.new_zeros((sigma.shape[0], 0, 3, 3)), sigma.new_zeros((sigma.shape[0], 0))
        else:
            R = rotations(estimate.axes).permute(0, 3, 1, 2)
            turn = SIGMA_TURN * estimate.log_turn.exp()
        return WindowPoses(estimate.pose.transpose(1, 2), estimate.root, sigma, R, turn)
