"""The baseline: VideoPose3D as published, from pixels to poses in the camera's frame.

Pavllo, Feichtenhofer, Grangier, Auli: 3D human pose estimation in video with temporal convolutions and
semi-supervised training, CVPR 2019, sections 3 to 5. Input are pixels divided by the image's width. One
network estimates joints relative to the root, a second one of the same shape the root. It uses neither
intrinsics nor gravity, bones or sensors, and estimates no uncertainty. `training.run.Published` trains it.

An unseen landmark is replaced by its position in the nearest frame that saw it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from lifting.body import Body
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.windows import Encoded, Estimate, Windows


@dataclass(frozen=True)
class EncodedPictures(Encoded):
    """Network input, and the camera's orientation."""

    R_camera_world: Tensor  #: (B, 3, 3)


class PoseAndRootNetwork(TemporalNetwork):
    """Two independent networks with concatenated outputs, the root's three last."""

    def __init__(self, config: NetworkConfig):
        super().__init__(replace(config, outputs=config.outputs - 3))
        self.config = config
        self.root = TemporalNetwork(replace(config, outputs=3))

    def forward(self, features: Tensor, constants: Tensor) -> Tensor:
        """Return (B, outputs)."""
        return torch.cat([super().forward(features, constants), self.root(features, constants)], dim=-1)


def sizes(body: Body) -> tuple[int, int, int]:
    """Return the numbers of inputs, constants and outputs of the network."""
    J = len(body.names)
    return 2 * J, 0, 3 * (J - 1) + 3


def encode(body: Body, windows: Windows) -> EncodedPictures:  # noqa: ARG001, as every `Model.encode`
    """Return the network input of windows; raises ValueError: they have no picture."""
    picture = windows.picture
    if picture is None:
        raise ValueError("windows without a picture, which VideoPose3D needs")
    xy = bridged(picture.xy, windows.seen & picture.xy.isfinite().all(dim=1))
    features = xy.permute(0, 2, 1, 3).flatten(2)
    return EncodedPictures(features, features.new_zeros((len(xy), 0)), picture.R_camera_world)


def decode(body: Body, output: Tensor, encoded: EncodedPictures) -> Estimate:
    """Return the estimate in world axes, its spreads NaN, from (B, outputs): joints but the root (3, J-1) relative to
    the root, and the root (3), in the camera's frame, m.
    """
    output = output.to(encoded.R_camera_world.dtype)  # bfloat16 in training
    B, J = len(output), len(body.names)
    pose, root = torch.split(output, [3 * (J - 1), 3], dim=1)
    R_world_camera = encoded.R_camera_world.transpose(1, 2)
    pose_world = pad(torch.bmm(R_world_camera, pose.reshape(B, 3, J - 1)), (1, 0))
    root_world = torch.bmm(R_world_camera, root[..., None])[..., 0]
    return Estimate(pose_world, root_world, output.new_full((B, 2, J), torch.nan), None, None)


def mirror_features(body: Body, features: Tensor) -> Tensor:
    """Mirror features (B, W, inputs): swap left and right, negate x."""
    xy = features.reshape(*features.shape[:-1], 2, -1)[..., body.mirrored]
    return torch.flatten(xy * _mirror_signs(xy, 2)[:, None], -2)


def mirror_output(body: Body, output: Tensor) -> Tensor:
    """Mirror an output (B, outputs): swap left and right, negate x."""
    J = len(body.names)
    pose, root = torch.split(output, [3 * (J - 1), 3], dim=1)
    pose = pose.reshape(-1, 3, J - 1)[..., [j - 1 for j in body.mirrored[1:]]]
    signs = _mirror_signs(output, 3)
    return torch.cat([(pose * signs[:, None]).flatten(1), root * signs], dim=1)


def bridged(xy: Tensor, seen: Tensor) -> Tensor:
    """Replace unseen image points (B, 2, W, J) by those of the nearest frame that saw them; seen is (B, W, J).

    A landmark never seen in a window is placed at the mean of all seen points, or in the middle.
    """
    if bool(seen.all()):
        return xy
    W = seen.shape[1]
    frame = torch.arange(W, device=xy.device)[None, :, None]
    before = torch.where(seen, frame, -2 * W).cummax(dim=1).values
    after = torch.where(seen, frame, 3 * W).flip(1).cummin(dim=1).values.flip(1)
    nearest = torch.where(frame - before <= after - frame, before, after).clamp(0, W - 1)
    held = xy.gather(2, nearest[:, None].expand_as(xy))
    known = torch.where(seen[:, None], xy, 0.0)
    mean = known.sum(dim=(2, 3)) / seen.sum(dim=(1, 2)).clamp_min(1)[:, None]
    return torch.where(seen.any(dim=1)[:, None, None], held, mean[..., None, None])


def _mirror_signs(like: Tensor, components: int) -> Tensor:
    """Signs of the components of a mirrored vector in the camera: x, to the right, is negated."""
    return like.new_tensor([-1.0, 1.0, 1.0][:components])
