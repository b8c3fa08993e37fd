"""Export of a lifter as ONNX, for other languages and devices.

The graph takes rays of windows in world and gives the poses of their estimated frames in world. Before it,
a caller undistorts pixels, turns their rays to world (z up), and takes `receptive_field` frames at
`rate_hz`; see the metadata, whose values are JSON.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lifting.body import Body, bone_groups
from lifting.model import FoldedNetwork, NetworkConfig
from lifting.predict import MIN_JOINTS, Lifter
from lifting.windows import SIGMA_TURN, Windows, decode, encode, rotations
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.packages import optional

INPUTS: Final = ("rays_world", "seen", "bones", "camera_height", "R_world_sensed", "sensed", "R_bone_shared")
OUTPUTS: Final = ("p_root_joint", "p_camera_root", "sigma_m", "R_world_bone", "sigma_rad")
"""See `LifterGraph.forward`; without the last two for a lifter without sensors."""
OPSET: Final = 17


class LifterGraph(nn.Module):
    """Encoding, network and decoding as a function of arrays."""

    def __init__(self, body: Body, config: NetworkConfig, weights: Mapping[str, NDArray[Any]], flip: bool = True):
        """Take a network; `flip` averages with the mirrored scene."""
        super().__init__()
        tensors = {name: torch.tensor(value) for name, value in weights.items()}
        self.body, self.network = body, FoldedNetwork(body, config, tensors, flip)
        self.estimated = config.estimated()
        self.eval()

    def forward(
        self,
        rays_world: Tensor,
        seen: Tensor,
        bones: Tensor,
        camera_height: Tensor,
        R_world_sensed: Tensor | None = None,
        sensed: Tensor | None = None,
        R_bone_shared: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the poses in the estimated frames of B windows of W frames, in world axes.

        Args:
            rays_world: (B, W, J, 3) directions in world from the optical centre to the joints.
            seen: (B, W, J) bool; unseen rays are ignored.
            bones: (B, 3 G) m, in shared frames, see `Lifter.bones_of`; NaN in a row where unknown.
            camera_height: (B,) height of the optical centre over the floor, m; NaN where unknown.
            R_world_sensed: (B, W, S, 3, 3) orientations of the segments that may carry sensors.
            sensed: (B, W, S) bool; orientations that are not sensed are ignored.
            R_bone_shared: (B, J, 3, 3) see `Lifter.shared_frames`; None for link frames.

        Returns:
            (B, J, 3) joints relative to the root, m; (B, 3) root from the optical centre, m; (B, J, 2) see
            `LiftedPoses.sigma_m`; for a body with sensors also (B, J, 3, 3) orientations of segments and
            (B, J) their standard deviation per axis, rad.
        """
        if R_world_sensed is None or sensed is None:
            R_world_sensed, sensed = rays_world.new_zeros((*seen.shape[:2], 0, 3, 3)), seen[..., :0]
        if R_bone_shared is not None:
            R_world_sensed = R_world_sensed @ R_bone_shared[:, None, self.body.sensor_joints]
        rays = torch.where(seen[..., None], rays_world, 0.0).permute(0, 3, 1, 2)
        axes = torch.stack([R_world_sensed[..., 0], R_world_sensed[..., 2]], dim=2)
        axes = torch.where(sensed[:, :, None, :, None], axes, 0.0).permute(0, 4, 1, 2, 3)
        windows = Windows(rays, seen, bones, camera_height, axes, sensed, self.estimated)
        encoded = encode(self.body, windows)
        estimate = decode(self.body, self.network(encoded.features, encoded.constants), encoded)
        poses = estimate.pose.transpose(1, 2), estimate.root, estimate.sigma_m()
        if estimate.axes is None or estimate.log_turn is None:
            return poses
        R = rotations(estimate.axes).permute(0, 3, 1, 2)
        if R_bone_shared is not None:
            R = R @ R_bone_shared.transpose(2, 3)
        return *poses, R, SIGMA_TURN * estimate.log_turn.exp()


def export_onnx(lifter: Lifter, path: str | Path, flip: bool = True, overwrite: bool = False) -> Path:
    """Write a lifter as ONNX. `OutputExistsError`: the file exists and must not be overwritten. `RtofError`: the
    package `onnx` is not installed, or the file cannot be written.

    Args:
        flip: average with the mirrored scene: a third slower, and more accurate.
    """
    path, body = Path(path), lifter.description.body
    onnx = optional("onnx", "onnx", "writing ONNX")
    inputs, outputs = (INPUTS, OUTPUTS) if body.sensors else (INPUTS[:4], OUTPUTS[:3])
    with new_file(path, overwrite) as whole:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # about this exporter; the newer one takes minutes
            torch.onnx.export(
                LifterGraph(body, lifter.description.network, lifter.weights, flip),
                _example(body, lifter.receptive_field())[: len(inputs)],
                str(whole),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamic_axes={name: {0: "windows"} for name in (*inputs, *outputs)},
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(whole)
        model.doc_string = "Lifter of rtof_kin: see the metadata."
        onnx.helper.set_model_props(model, _metadata(lifter, flip))
        onnx.checker.check_model(model)
        onnx.save(model, whole)
    return path


def _metadata(lifter: Lifter, flip: bool) -> dict[str, str]:
    """Properties of the lifter and conventions of the graph, as JSON by key."""
    description, body = lifter.description, lifter.description.body
    facts = {
        "format": "rtof_kin lifter, ONNX 1",
        "joints": body.names,
        "parents": body.parents,
        "sensors": body.sensors,
        "bones": [f"{name} {axis}" for name in bone_groups(body.names) for axis in "xyz"],
        "nominal_bones_m": body.nominal_bones,
        "rate_hz": description.rate_hz,
        "receptive_field": lifter.receptive_field(),
        "estimated_frame": lifter.estimated(),
        "least_joints_seen": MIN_JOINTS,
        "mirror_averaged": flip,
        "frames": "world is z up, m; camera_root is from the optical centre in world axes",
        "shared_frames": "R_bone_shared turns a segment's shared frame into its link frame, as computed by "
        "rtof_kin.body.kinematics from the joint offsets; identity for CMU's skeleton",
        "bones_rule": "position of each joint in its parent's shared frame (T-pose: x forward, y left, "
        "z up), m; of the left and the right one the mean as if left, of one in the middle with y = 0",
        "shapes": {
            "rays_world": "B W J 3",
            "seen": "B W J",
            "bones": "B 3G",
            "camera_height": "B",
            "R_world_sensed": "B W S 3 3",
            "sensed": "B W S",
            "R_bone_shared": "B J 3 3",
            "p_root_joint": "B J 3",
            "p_camera_root": "B 3",
            "sigma_m": "B J 2 (across the ray, along it)",
            "R_world_bone": "B J 3 3",
            "sigma_rad": "B J",
        },
        "unknown": "NaN in a whole row of bones or camera_height; false in seen and sensed",
        "acknowledgement": description.data,
        "sha256_of_checkpoint": lifter.sha256,
    }
    return {key: json.dumps(value) for key, value in facts.items()}


def _example(body: Body, size: int) -> tuple[Tensor, ...]:
    """Inputs of two windows with everything seen and sensed."""
    J, S = len(body.names), len(body.sensors)
    rays = torch.randn(2, size, J, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    rays[..., 0] += 1.0
    return (
        rays,
        torch.ones(2, size, J, dtype=torch.bool),
        torch.tensor(body.nominal_bones).expand(2, -1).clone(),
        torch.full((2,), 1.5),
        torch.eye(3).expand(2, size, S, 3, 3).clone(),
        torch.ones(2, size, S, dtype=torch.bool),
        torch.eye(3).expand(2, J, 3, 3).clone(),
    )
