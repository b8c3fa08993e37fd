"""Other rigs' trunks: bodies stay whole, and what is not the trunk's stays."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch

from lifting.training.data import MotionBank, Moving
from lifting.training.joint_errors import Draw
from lifting.training.noise import RigConfig, exp, log, turns
from lifting.windows import rotations
from rtof_kin.core import rotations as so3

B, W = 200, 27
STILL = RigConfig(
    share=1.0, spread=0.0, spine=(0, 0, 0), pelvis=(0, 0, 0), clavicle=(0, 0, 0), mobility=(1.0, 1.0), places=0.0
)


@pytest.fixture(scope="module")
def bank() -> MotionBank:
    return MotionBank(support.tiny_corpus(), [0, 1], torch.device("cpu"))


def varied(bank: MotionBank, rigs: RigConfig, estimated: int = W // 2) -> tuple[Moving, Moving]:
    """The same bodies as recorded and in another rig."""
    frames = torch.linspace(20, 150, B).long()
    offset = (torch.arange(W) - estimated + torch.zeros(B, 1)).float()
    one, other = (bank._at(frames, offset, torch.zeros(B, 1), torch.zeros(B, dtype=torch.long))[0] for _ in range(2))
    bank._vary(other, frames, offset, rigs, draws(B))
    return one, other


@pytest.mark.parametrize("estimated", [W // 2, W - 1])
def test_bones_follow_their_segments(bank: MotionBank, estimated: int) -> None:
    """Independent reference: forward kinematics from orientations and offsets."""
    _, moving = varied(bank, RigConfig(share=1.0), estimated)
    R = rotations(moving.axes).permute(0, 3, 1, 2)
    bones = (R[:, bank.body.parents[1:]] @ moving.offsets[:, 1:, :, None])[..., 0]
    torch.testing.assert_close(moving.bones[:, :, estimated].transpose(1, 2), bones, atol=1e-5, rtol=0)
    torch.testing.assert_close(R @ R.transpose(-1, -2), torch.eye(3).expand_as(R), atol=1e-5, rtol=0)


def test_limbs_and_upper_trunk_keep_their_orientation(bank: MotionBank) -> None:
    one, other = varied(bank, RigConfig(share=1.0))
    changed = (one.axes - other.axes).abs().amax(dim=(0, 1, 2)) > 1e-6
    names = {bank.body.names[j] for j in changed.nonzero()[:, 0]}
    assert names == {"Hips", "Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder"}


def test_another_place_of_the_root_leaves_the_legs_motion(bank: MotionBank) -> None:
    one, other = varied(bank, replace(STILL, places=1.0))
    hip, knee, _ = bank.body.legs[0]
    assert (other.offsets - one.offsets)[:, hip].norm(dim=1).mean() > 0.03
    change = torch.matmul(other.bones, bank.chain) + other.root[..., None]
    change -= torch.matmul(one.bones, bank.chain) + one.root[..., None]
    moved = change[..., knee] - change[:, :, W // 2 : W // 2 + 1, knee]
    assert moved.norm(dim=1).max() < 0.01


def draws(batch: int) -> Draw:
    return Draw(batch, torch.Generator().manual_seed(0), torch.device("cpu"))


def test_a_bend_is_spread_and_a_clavicle_slowed(bank: MotionBank) -> None:
    """Planted: a bend of 40 degrees, all of it at one joint, becomes 10 degrees at each."""
    R = torch.eye(3).repeat(B, W, 8, 1, 1)
    R[:, :, 4:] = torch.from_numpy(so3.about_axis("y", np.radians(40.0))).float()
    R[:, :, 5] = R[:, :, 4] @ torch.from_numpy(so3.about_axis("x", 0.3)).float()
    axes = R[..., [0, 2]].permute(0, 3, 1, 4, 2)
    out = turns(axes, replace(STILL, mobility=(0.5, 0.5)), draws(B)) @ R
    bend = log(out[:, :, :5])[0, 0]
    np.testing.assert_allclose(bend[:, 1].rad2deg(), [0, 10, 20, 30, 40], atol=1e-3)
    clavicle = log(out[:, :, 4].transpose(-1, -2) @ out[:, :, 5])
    np.testing.assert_allclose(clavicle[0, 0], [0.15, 0, 0], atol=1e-5)


def test_turns_are_constant_over_a_still_window_and_have_their_sizes(bank: MotionBank) -> None:
    axes = torch.eye(3)[:, [0, 2]].reshape(1, 3, 1, 2, 1).expand(20_000, 3, 3, 2, 8)
    out = log(turns(axes, replace(STILL, pelvis=(0.02, 0.08, 0.03), clavicle=(0.12, 0.0, 0.1)), draws(20_000)))
    assert (out - out[:, :1]).abs().max() < 1e-6
    np.testing.assert_allclose(out[:, 0, 0].std(dim=0), [0.02, 0.08, 0.03], rtol=0.05)
    torch.testing.assert_close(out[:, 0, 5] * torch.tensor([-1.0, 1, -1]), out[:, 0, 6], atol=1e-5, rtol=0)


def test_rotation_vectors_agree_with_a_peer(bank: MotionBank) -> None:
    rotvec = np.random.default_rng(0).normal(size=(40, 5, 3)) * 0.7
    rotvec[0] = 0.0
    R = exp(torch.from_numpy(rotvec))
    np.testing.assert_allclose(R, so3.exp(rotvec), atol=1e-6)
    np.testing.assert_allclose(log(R), so3.log(R.numpy()), atol=1e-6)
