"""A lifter as one ONNX file, for other languages and devices.

The graph is `graph.LifterGraph`: rays of a window in world in, the pose of its estimated frame in world
out, any number of windows at once. What a caller does before is to undistort pixels, turn their rays to
world (z up), and take `receptive_field` frames at `rate_hz`; see the metadata, whose values are JSON.
"""

from __future__ import annotations

import json
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lifting.body import Body, bone_groups
from lifting.checkpoint import LifterDescription
from lifting.graph import LifterGraph, WindowPoses
from lifting.models import RAYS
from lifting.predict import MIN_JOINTS, Lifter
from rtof_kin.core.errors import RtofError, ShapeError
from rtof_kin.core.files.folder import new_file

INPUTS = ("rays_world", "seen", "bones", "camera_height", "R_world_sensed", "sensed")
"""See `LifterGraph.forward`; the two last are left out for a lifter without sensors."""
OUTPUTS = WindowPoses._fields
"""See `WindowPoses`; likewise."""
OPSET = 17


def export_onnx(lifter: Lifter, path: str | Path, flip: bool = True, overwrite: bool = False) -> Path:
    """Write a lifter as ONNX; the file appears whole or not at all.

    Args:
        lifter: of the package's own kind.
        path: of the file.
        flip: average with the mirrored scene: a third slower, and better.

    Raises:
        ShapeError: the lifter is of another kind.
        OutputExistsError: the file exists and overwriting was not asked for.
        RtofError: the package `onnx` is not installed, or the file cannot be written.
    """
    path, description = Path(path), lifter.description
    if description.network.model != RAYS:
        raise ShapeError(f"a lifter of kind {description.network.model} has no ONNX form")
    try:
        onnx: Any = import_module("onnx")
    except ImportError as error:
        raise RtofError("ONNX needs its package; install it: pip install rtof_kin[onnx]") from error
    sensed = bool(description.body.sensors)
    inputs, outputs = (INPUTS, OUTPUTS) if sensed else (INPUTS[:4], OUTPUTS[:3])
    graph = LifterGraph(description.body, lifter.network, flip)
    with new_file(path, overwrite) as whole:
        _export(
            graph if sensed else _Unsensed(graph),
            example_windows(description.body, lifter.receptive_field())[: len(inputs)],
            whole, inputs, outputs,
        )  # fmt: skip
        model = onnx.load(whole)
        model.doc_string = "Lifter of rtof_kin: see the metadata."
        onnx.helper.set_model_props(model, metadata(lifter, flip))
        onnx.checker.check_model(model)
        onnx.save(model, whole)
    return path


def metadata(lifter: Lifter, flip: bool = True) -> dict[str, str]:
    """What a user of the file has to know, as JSON by key."""
    description: LifterDescription = lifter.description
    body = description.body
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
        "bones_rule": "position of each joint in its parent's segment frame (T-pose: x forward, y left, "
        "z up), m; of the left and the right one the mean as if left, of one in the middle with y = 0",
        "shapes": {"rays_world": "B W J 3", "seen": "B W J", "bones": "B 3G", "camera_height": "B",
                   "R_world_sensed": "B W S 3 3", "sensed": "B W S", "p_root_joint": "B J 3",
                   "p_camera_root": "B 3", "sigma_m": "B J 2 (across the ray, along it)",
                   "R_world_bone": "B J 3 3", "sigma_rad": "B J"},
        "unknown": "NaN in a whole row of bones or camera_height; false in seen and sensed",
        "acknowledgement": description.data,
        "sha256_of_checkpoint": lifter.sha256,
    }  # fmt: skip
    return {key: json.dumps(value) for key, value in facts.items()}


def example_windows(body: Body, size: int) -> tuple[Tensor, ...]:
    """Inputs of two windows, all seen and sensed."""
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
    )


class _Unsensed(torch.nn.Module):
    """The graph of a lifter without sensors."""

    def __init__(self, graph: LifterGraph):
        super().__init__()
        self.graph = graph

    def forward(
        self, rays_world: Tensor, seen: Tensor, bones: Tensor, camera_height: Tensor
    ) -> tuple[Tensor, ...]:
        B, W = seen.shape[:2]
        none = rays_world.new_zeros((B, W, 0, 3, 3))
        poses: WindowPoses = self.graph(
            rays_world, seen, bones, camera_height, none, seen.new_zeros((B, W, 0))
        )
        return poses.p_root_joint, poses.p_camera_root, poses.sigma_m


def _export(
    graph: torch.nn.Module,
    example: tuple[Tensor, ...],
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
) -> None:
    """By torch's exporter of recorded operations: the newer one needs minutes and another package."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # that it is the older one, and which operations it splits
        torch.onnx.export(
            graph, example, str(path),
            input_names=list(inputs), output_names=list(outputs),
            dynamic_axes={name: {0: "windows"} for name in (*inputs, *outputs)},
            opset_version=OPSET, dynamo=False,
        )  # fmt: skip
