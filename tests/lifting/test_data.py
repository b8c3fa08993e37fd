from __future__ import annotations

from dataclasses import replace

import lifting_support as support
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
