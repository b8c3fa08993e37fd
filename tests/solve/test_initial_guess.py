"""Initial guess: the root on its rays, and unobserved intervals bridged by the sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.initial_guess import initial_guess

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
WALK, _ = planted.walking(BODY, 6.0)
LEGS = ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
LIMBS = (*LEGS, "LeftArm", "RightArm", "LeftForeArm", "RightForeArm")
TRUTH = WALK.poses
T = len(TRUTH)


def hidden(*gaps: tuple[float, float]) -> NDArray[np.bool_]:
    """(T,) whether the person is observed, given the gaps in s."""
    return ~np.any([(TRUTH.times >= a) & (TRUTH.times < b) for a, b in gaps], axis=0)


def stopped(seen: NDArray[np.bool_]) -> PoseSequence:
    """The truth as a lifter that bridges it: between, each frame is the last one that was seen."""
    last = np.maximum.accumulate(np.where(seen, np.arange(T), np.flatnonzero(seen)[0]))
    return replace(TRUTH, p_world_joint=TRUTH.p_world_joint[last], R_world_bone=TRUTH.R_world_bone[last])


def bridged(start: PoseSequence, seen: NDArray[np.bool_], imus: BoneImuSequence) -> tuple[PoseSequence, Array]:
    """Poses and sigma of the root, with keypoints in the frames `seen` and the root not refitted."""
    uv = np.where(seen[:, None, None], np.full((T, 21, 2), 500.0), np.nan)
    keypoints = KeypointSequence(planted.camera(), TRUTH.times, uv, np.ones((T, 21)), BODY.names)
    guess = initial_guess(start, keypoints, imus, BODY, refit_root=False)
    return guess.poses, guess.sigma_root


@pytest.mark.parametrize("gap", [(2.0, 4.0), (-1.0, 2.0), (4.0, 7.0)])
def test_bridged_root_follows_a_walk_within_its_sigma(gap: tuple[float, float]) -> None:
    seen = hidden(gap)
    start, sigma = bridged(stopped(seen), seen, planted.bone_imus(BODY, TRUTH, LIMBS))
    error = np.linalg.norm(start.p_world_joint[:, 0] - TRUTH.p_world_joint[:, 0], axis=1)
    was = np.linalg.norm(stopped(seen).p_world_joint[:, 0] - TRUTH.p_world_joint[:, 0], axis=1)
    assert error.max() < 0.08
    assert was.max() > 1.0
    assert np.all(error[~seen] < 3 * sigma[~seen])
    np.testing.assert_array_equal(sigma[seen], 0.0)
    np.testing.assert_array_equal(start.p_world_joint[seen], TRUTH.p_world_joint[seen])


def test_bridged_poses_are_rigid_and_continuous_at_both_ends() -> None:
    seen = hidden((1.0, 1.5), (3.0, 4.5))
    start, _ = bridged(stopped(seen), seen, planted.bone_imus(BODY, TRUTH, LIMBS))
    p = kinematics.positions(BODY.parents, BODY.joint_offsets, start.p_world_joint[:, 0], start.R_world_bone)
    np.testing.assert_allclose(p, start.p_world_joint, atol=1e-9)
    step = np.linalg.norm(np.diff(start.p_world_joint, axis=0), axis=-1).max()
    assert step < 1.5 * np.linalg.norm(np.diff(TRUTH.p_world_joint, axis=0), axis=-1).max()
    turns = so3.angle_between(start.R_world_bone[:-1], start.R_world_bone[1:])
    assert turns.max() < np.radians(12)


def test_unobserved_turn_is_recovered_from_limb_sensors() -> None:
    """A quarter turn in two seconds, trunk and all; no sensor sits on the trunk."""
    about = so3.about_axis("z", np.radians(90) * np.clip((TRUTH.times - 2) / 2, 0, 1))
    turned = replace(
        TRUTH,
        R_world_bone=about[:, None] @ TRUTH.R_world_bone,
        p_world_joint=np.einsum("tij,tkj->tki", about, TRUTH.p_world_joint),
    )
    seen = hidden((2.2, 3.8))
    last = np.maximum.accumulate(np.where(seen, np.arange(T), 0))
    frozen = replace(turned, R_world_bone=turned.R_world_bone[last])
    start, _ = bridged(frozen, seen, planted.bone_imus(BODY, turned, LIMBS))
    off, was = (so3.angle_between(turned.R_world_bone[:, 0], p.R_world_bone[:, 0]) for p in (start, frozen))
    assert off.max() < np.radians(10)
    assert was.max() > 1.0


def test_root_is_unchanged_without_leg_sensors() -> None:
    seen = hidden((2.0, 4.0))
    imus = planted.bone_imus(BODY, TRUTH, ("LeftArm", "RightArm"))
    start, sigma = bridged(stopped(seen), seen, imus)
    np.testing.assert_array_equal(start.p_world_joint[:, 0], stopped(seen).p_world_joint[:, 0])
    np.testing.assert_array_equal(sigma, 0.0)


@pytest.mark.parametrize("seen", [np.ones(T, dtype=bool), np.zeros(T, dtype=bool)])
def test_always_or_never_observed_is_unchanged(seen: NDArray[np.bool_]) -> None:
    start, sigma = bridged(TRUTH, seen, planted.bone_imus(BODY, TRUTH, LIMBS))
    assert start is TRUTH
    np.testing.assert_array_equal(sigma, 0.0)


def test_root_is_refitted_to_its_rays_unless_switched_off() -> None:
    poses = planted.human(BODY, 4).poses
    away = replace(poses, p_world_joint=poses.p_world_joint + np.array([0.0, 0.3, 0.0]))
    error = {
        refit: np.abs(guess.poses.p_world_joint - poses.p_world_joint).max()
        for refit in (True, False)
        for guess in [initial_guess(away, planted.keypoints(poses), None, BODY, refit_root=refit)]
    }
    assert error[False] == pytest.approx(0.3)
    assert error[True] < 0.1
    assert initial_guess(away, None, planted.bone_imus(BODY, poses), BODY).poses is away
