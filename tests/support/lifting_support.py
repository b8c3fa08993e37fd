"""A tiny synthetic corpus and keypoints of it, for the tests of `lifting`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting.body import Body
from lifting.checkpoint import LifterDescription
from lifting.model import FoldedNetwork, NetworkConfig
from lifting.predict import LiftedPoses, Lifter
from lifting.training.corpus import Corpus
from lifting.training.network import TemporalNetwork
from lifting.training.run import first_answer
from lifting.windows import EncodedWindows, Windows, sizes
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton_table import SkeletonTable, read_skeleton_table
from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
torch.set_num_threads(1)
TABLE = read_skeleton_table(model_path("skeleton.toml"))
TABLE_17 = read_skeleton_table(model_path("human36m.toml"))


def moving(seed: int, frames: int, table: SkeletonTable = TABLE, rate_hz: float = 60.0) -> tuple[Array, Array]:
    """Root (T, 3) and orientations (T, J, 3, 3) of a person who stands and waves."""
    rng = np.random.default_rng(seed)
    J, time = len(table.names), np.arange(frames) / rate_hz
    rotvec = np.zeros((frames, J, 3))
    for frequency in (0.2, 0.6):
        phase = rng.uniform(0, 2 * np.pi, (J, 3))
        rotvec += 0.2 * rng.normal(size=(J, 3)) * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    R = kinematics.world_rotations(table.parents, so3.exp(rotvec))
    p_root = np.stack([0.3 * np.sin(time), 0.2 * np.cos(time), np.zeros(frames)], axis=1)
    p = kinematics.positions(table.parents, table.offsets, p_root, R)
    p_root[:, 2] = 0.06 - p[..., 2].min()
    return p_root, R


def tiny_corpus(
    clips: int = 4, frames: int = 90, seed: int = 0, table: SkeletonTable = TABLE, rate_hz: float = 60.0
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
    seed: int = 0, channels: int = 16, table: SkeletonTable = TABLE, rate_hz: float = 60.0, causal: bool = False
) -> Lifter:
    """A lifter with random weights: symmetries do not depend on training."""
    body = tiny_corpus(table=table).body()
    torch.manual_seed(seed)
    shape = NetworkConfig(*sizes(body), channels=channels, causal=causal)
    network = TemporalNetwork(shape).eval()
    with torch.no_grad():
        for p in network.parameters():
            p.add_(0.02 * torch.randn_like(p))
        network.shrink.bias.add_(first_answer(body))
    return Lifter(network.weights(), LifterDescription(body, network.config, rate_hz))


def network_of(lifter: Lifter) -> TemporalNetwork:
    """The network of a lifter as it is trained, in evaluation mode."""
    network = TemporalNetwork(lifter.description.network).eval()
    network.load_state_dict({name: torch.tensor(value) for name, value in lifter.weights.items()})
    return network


def tensor_network(lifter: Lifter) -> FoldedNetwork:
    """The fused network of a lifter on tensors."""
    tensors = {name: torch.tensor(value) for name, value in lifter.weights.items()}
    return FoldedNetwork(lifter.description.body, lifter.description.network, tensors)


def lifted_positions(
    times: Array, p_world_joint: Array, seen: NDArray[np.bool_], names: tuple[str, ...]
) -> LiftedPoses:
    """Lifted poses without orientations and standard deviations."""
    T, J = p_world_joint.shape[:2]
    nan = [np.full((T, J, *shape), np.nan) for shape in ((2,), (3, 3), ())]
    return LiftedPoses(times, p_world_joint, seen, names, *nan)


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


def scene_of(seeds: range, frames: int, table: SkeletonTable = TABLE) -> tuple[Tensor, Tensor]:
    """Joints (B, 3, W, J) from a camera 1.6 m high some metres away, and axes (B, 3, W, 2, J); each
    window has another motion."""
    points, axes = [], []
    for b, seed in enumerate(seeds):
        p_root, R = moving(seed, frames, table)
        p = kinematics.positions(table.parents, table.offsets, p_root, R)
        points.append(p + np.array([4.0 + b, 0.7 - 0.4 * b, -1.6]))
        axes.append(R[..., [0, 2]])
    return (
        torch.from_numpy(np.stack(points)).permute(0, 3, 1, 2),
        torch.from_numpy(np.stack(axes)).permute(0, 3, 1, 4, 2),
    )


def windows_of(
    body: Body,
    scene: Tensor,
    axes: Tensor | None = None,
    *,
    seen: Tensor | None = None,
    sensed: Tensor | None = None,
    bones: Tensor | None = None,
    height: float = 1.6,
    estimated: int | None = None,
) -> Windows:
    """Windows of a scene; by default everything is seen and sensed, and the bones are known.

    Args:
        axes: (B, 3, W, 2, J) of all segments; if None, nothing is sensed.
    """
    B, _, W, _ = scene.shape
    S = len(body.sensors)
    if seen is None:
        seen = torch.ones((B, *scene.shape[2:]), dtype=torch.bool)
    if sensed is None:
        sensed = torch.full((B, W, S), axes is not None)
    if axes is None:
        axes = scene.new_zeros((B, 3, W, 2, len(body.names)))
    if bones is None:
        table = TABLE if len(body.names) == len(TABLE.names) else TABLE_17
        bones = body.bones_of(torch.from_numpy(table.offsets)).expand(B, -1)
    carried = axes[..., body.sensor_joints]
    middle = W // 2 if estimated is None else estimated
    heights = scene.new_full((B,), height)
    return Windows(scene, seen, bones.to(scene), heights, carried, sensed, middle)


def assert_same_input(one: EncodedWindows, two: EncodedWindows, atol: float = 1e-9) -> None:
    """Assert equal network inputs."""
    torch.testing.assert_close(one.features, two.features, atol=atol, rtol=0)
    torch.testing.assert_close(one.constants, two.constants, atol=atol, rtol=0)


def worn_by(seed: int, frames: int, joints: tuple[str, ...], rate_hz: float = 60.0) -> BoneImuSequence:
    """Exact sensors on segments of `moving` (its 60 Hz frames, stamped at another rate)."""
    _, R = moving(seed, frames)
    index = [TABLE.names.index(joint) for joint in joints]
    none = np.zeros((frames, len(joints), 3))
    times = np.arange(frames) / rate_hz
    return BoneImuSequence(times, R[:, index], none, np.zeros((len(joints), 3)), joints)
