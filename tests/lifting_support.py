"""A tiny synthetic corpus and keypoints of it, for the tests of `lifting`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lifting.checkpoint import LifterDescription
from lifting.corpus import Corpus
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.predict import Lifter
from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.resources import model_path
from rtof_kin.skeleton_table import SkeletonTable, read_skeleton_table
from rtof_kin.types import Camera, KeypointSequence

Array = NDArray[np.float64]
torch.set_num_threads(1)
TABLE = read_skeleton_table(model_path("skeleton.toml"))
TABLE_17 = read_skeleton_table(model_path("human36m.toml"))


def moving(
    seed: int, frames: int, table: SkeletonTable = TABLE, rate_hz: float = 60.0
) -> tuple[Array, Array]:
    """Root (T, 3) and orientations (T, J, 3, 3) of somebody standing on the floor and waving."""
    rng = np.random.default_rng(seed)
    J, time = len(table.names), np.arange(frames) / rate_hz
    rotvec = np.zeros((frames, J, 3))
    for frequency in (0.2, 0.6):
        phase = rng.uniform(0, 2 * np.pi, (J, 3))
        rotvec += (
            0.2
            * rng.normal(size=(J, 3))
            * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
        )
    R = kinematics.world_rotations(table.parents, so3.exp(rotvec))
    p_root = np.stack([0.3 * np.sin(time), 0.2 * np.cos(time), np.zeros(frames)], axis=1)
    p = kinematics.positions(table.parents, table.offsets, p_root, R)
    p_root[:, 2] = 0.06 - p[..., 2].min()
    return p_root, R


def tiny_corpus(
    clips: int = 4,
    frames: int = 90,
    seed: int = 0,
    table: SkeletonTable = TABLE,
    rate_hz: float = 60.0,
) -> Corpus:
    """Clips of two subjects that train, one each that validates and tests."""
    splits = ["train", "train", "validation", "test"]
    motion = [moving(seed + c, frames, table, rate_hz) for c in range(clips)]
    sizes = 1 + 0.05 * np.arange(clips)
    return Corpus(
        table.names,
        table.parents,
        np.concatenate([p for p, _ in motion]).astype(np.float32),
        np.concatenate([R for _, R in motion]).astype(np.float32),
        np.stack([table.offsets * s for s in sizes]).astype(np.float32),
        np.arange(clips + 1) * frames,
        tuple(f"subject {c % 4}" for c in range(clips)),
        tuple(splits[c % 4] for c in range(clips)),
        rate_hz,
    )


def untrained_lifter(
    seed: int = 0, channels: int = 16, table: SkeletonTable = TABLE, rate_hz: float = 60.0
) -> Lifter:
    """A lifter with random weights: symmetries do not depend on training."""
    body = tiny_corpus(table=table).body()
    torch.manual_seed(seed)
    network = TemporalNetwork(NetworkConfig(body.inputs, body.outputs, channels=channels)).eval()
    with torch.no_grad():
        for p in network.parameters():
            p.add_(0.02 * torch.randn_like(p))
        network.shrink.bias[-1] = np.log(0.4)
    return Lifter(network, LifterDescription(body, network.config, rate_hz))


def seen_by(camera: Camera, p_world_joint: Array, rate_hz: float = 60.0) -> KeypointSequence:
    """Exact keypoints of positions (T, J, 3)."""
    uv = camera.project(p_world_joint)
    times = np.arange(len(uv)) / rate_hz
    return KeypointSequence(camera, times, uv, np.ones(uv.shape[:2]), TABLE.names)


def positions(seed: int, frames: int) -> Array:
    """Joints (T, J, 3) of `moving`."""
    p_root, R = moving(seed, frames)
    return kinematics.positions(TABLE.parents, TABLE.offsets, p_root, R)


def side_camera() -> Camera:
    """A camera 4 m away, 1.5 m high."""
    return Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
