from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.training.corpus import Corpus
from lifting.training.data import AugmentConfig, Batch, MotionBank, plain

B, W = 64, 27
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus()


@pytest.fixture(scope="module")
def bank(corpus: Corpus) -> MotionBank:
    return MotionBank(corpus, [0, 1], CPU)


def draw(bank: MotionBank, config: AugmentConfig, seed: int = 0, frames: Tensor | None = None) -> Batch:
    return bank.draw(B, W, config, torch.Generator().manual_seed(seed), frames)


def lengths(bank: MotionBank, pose: Tensor) -> Tensor:
    """(B, J-1) lengths of the bones of poses (B, 3, J)."""
    return (pose[:, :, 1:] - pose[:, :, list(bank.body.parents[1:])]).norm(dim=1)


def all_pairs(pose: Tensor) -> Tensor:
    """(B, J, J) distances between joints, which no turn or mirror changes."""
    return torch.cdist(pose.transpose(1, 2), pose.transpose(1, 2))


def test_camera_height_is_measured_from_the_floor(corpus: Corpus, bank: MotionBank) -> None:
    config = replace(AugmentConfig(), hide_height=0.0, height_error=0.0)
    frames = torch.arange(B)
    batch = draw(bank, config, frames=frames)
    lowest = (batch.pose + batch.root[:, :, None])[:, 2].min(dim=1).values + batch.windows.camera_height
    recorded = torch.from_numpy(corpus.positions(0)[:B, :, 2].min(axis=1))
    torch.testing.assert_close(lowest, recorded, atol=1e-4, rtol=0)


def test_known_bones_are_those_of_the_pose(bank: MotionBank) -> None:
    config = replace(AugmentConfig(), hide_bones=0.0, bone_error=0.0, recombine=0.5)
    other = support.TABLE.offsets.astype("float32")
    other[3] *= 1.5
    bank = MotionBank(support.tiny_corpus(), [0, 1], CPU, [other])
    batch = draw(bank, config)
    known = batch.windows.bones.reshape(B, -1, 3).norm(dim=2)
    of_pose = lengths(bank, batch.pose)
    groups = bank.group_of_joint[1:]
    for g in range(bank.groups):
        mean = of_pose[:, groups == g].mean(dim=1)
        torch.testing.assert_close(mean, known[:, g], atol=2e-3, rtol=0)


def test_windows_of_17_joints_are_drawn_at_their_rate() -> None:
    corpus = support.tiny_corpus(table=support.TABLE_17, rate_hz=50.0)
    bank = MotionBank(corpus, [0, 1], CPU, [1.1 * corpus.joint_offsets[0]])
    upper = {name for j, name in enumerate(corpus.names) if bank.upper[j]}
    assert upper == {"Thorax", "Neck", "Head", "LShoulder", "LElbow", "LWrist", "RShoulder", "RElbow", "RWrist"}
    batch = draw(bank, AugmentConfig())
    assert batch.windows.rays_world.shape == (B, 3, W, 17)
    assert batch.windows.rays_world.isfinite().all()
    assert batch.pose.shape == (B, 3, 17)
    frames = torch.arange(B)
    plain_pose = draw(bank, plain(), frames=frames).pose
    p = torch.from_numpy(corpus.positions(0)[:B]).transpose(1, 2)
    torch.testing.assert_close(all_pairs(plain_pose), all_pairs(p), atol=1e-4, rtol=0)


def test_plain_windows_are_the_recorded_poses(corpus: Corpus, bank: MotionBank) -> None:
    frames = torch.arange(B)
    batch = draw(bank, plain(), frames=frames)
    p = torch.from_numpy(corpus.positions(0)[:B]).transpose(1, 2)
    torch.testing.assert_close(all_pairs(batch.pose), all_pairs(p), atol=1e-4, rtol=0)
    torch.testing.assert_close(batch.pose[:, 2], p[:, 2] - p[:, 2, :1], atol=1e-5, rtol=0)


def test_rays_of_the_middle_frame_point_at_the_joints(bank: MotionBank) -> None:
    batch = draw(bank, replace(AugmentConfig(), noise=plain().noise))
    p = batch.pose + batch.root[:, :, None]
    cosine = torch.cosine_similarity(batch.windows.rays_world[:, :, W // 2], p, dim=1)
    assert torch.all(cosine[batch.windows.seen[:, W // 2]] > 1 - 1e-6)
    assert batch.windows.seen[:, W // 2].float().mean() > 0.95


def test_mirroring_exchanges_left_and_right(corpus: Corpus, bank: MotionBank) -> None:
    frames = torch.arange(B)
    normal = draw(bank, plain(), frames=frames)
    mirrored = draw(bank, replace(plain(), mirror=1.0), frames=frames)
    order = bank.body.mirrored
    torch.testing.assert_close(
        all_pairs(mirrored.pose), all_pairs(normal.pose)[:, order][:, :, order], atol=1e-4, rtol=0
    )
    assert handedness(mirrored.pose, order) == -handedness(normal.pose, list(range(21)))


def handedness(pose: Tensor, order: list[int]) -> int:
    """Sign of the volume spanned by three bones of the first pose."""
    a = pose[0][:, order]
    return int(torch.sign(torch.det(torch.stack([a[:, 6], a[:, 10], a[:, 17]]))))


def test_time_is_warped_within_the_clip(bank: MotionBank) -> None:
    frames = torch.full((B,), 45)
    slow = draw(bank, replace(plain(), warp=(0.5, 0.5)), frames=frames)
    fast = draw(bank, replace(plain(), warp=(1.0, 1.0)), frames=frames)
    torch.testing.assert_close(slow.windows.rays_world[:, :, 23], fast.windows.rays_world[:, :, 18])
    edge = draw(bank, plain(), frames=torch.zeros(B, dtype=torch.long))
    assert torch.equal(edge.windows.rays_world[:, :, 0], edge.windows.rays_world[:, :, 13])


def test_nonrigid_joints_are_drawn_as_recorded() -> None:
    corpus = support.tiny_corpus()
    beyond = 0.03 * np.random.default_rng(0).normal(size=(360, 21, 3)).astype(np.float32)
    beyond[:, 0] = 0.0
    corpus = replace(corpus, beyond_rigid=beyond)
    pose = draw(MotionBank(corpus, [0], CPU), plain(), frames=torch.arange(B)).pose
    p = torch.from_numpy(corpus.positions(0)[:B]).transpose(1, 2)
    torch.testing.assert_close(all_pairs(pose), all_pairs(p), atol=1e-4, rtol=0)
