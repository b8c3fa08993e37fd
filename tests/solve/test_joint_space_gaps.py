"""A start where nobody was seen: sensors move it on, between what was seen at its ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.joint_space.gaps import through_gaps

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
WALK, _ = planted.walking(BODY, 6.0)
LEGS = ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
LIMBS = (*LEGS, "LeftArm", "RightArm", "LeftForeArm", "RightForeArm")
TRUTH = WALK.poses
T = len(TRUTH)


def hidden(*gaps: tuple[float, float]) -> NDArray[np.bool_]:
    """(T,) whether somebody was seen, but for these times, s."""
    return ~np.any([(TRUTH.times >= a) & (TRUTH.times < b) for a, b in gaps], axis=0)


def stopped(seen: NDArray[np.bool_]) -> PoseSequence:
    """The truth as a lifter that bridges it: between, each frame is the last one that was seen."""
    last = np.maximum.accumulate(np.where(seen, np.arange(T), np.flatnonzero(seen)[0]))
    return replace(TRUTH, p_world_joint=TRUTH.p_world_joint[last], R_world_bone=TRUTH.R_world_bone[last])


@pytest.mark.parametrize("gap", [(2.0, 4.0), (-1.0, 2.0), (4.0, 7.0)])
def test_somebody_who_walks_out_of_the_picture_walks_on(gap: tuple[float, float]) -> None:
    seen = hidden(gap)
    start, sigma = through_gaps(stopped(seen), seen, planted.bone_imus(BODY, TRUTH, LIMBS), BODY)
    error = np.linalg.norm(start.p_world_joint[:, 0] - TRUTH.p_world_joint[:, 0], axis=1)
    was = np.linalg.norm(stopped(seen).p_world_joint[:, 0] - TRUTH.p_world_joint[:, 0], axis=1)
    assert error.max() < 0.08
    assert was.max() > 1.0
    assert np.all(error[~seen] < 3 * sigma[~seen])
    np.testing.assert_array_equal(sigma[seen], 0.0)
    np.testing.assert_array_equal(start.p_world_joint[seen], TRUTH.p_world_joint[seen])


def test_the_pose_is_rigid_and_goes_on_without_a_jump_where_a_gap_begins_and_ends() -> None:
    seen = hidden((1.0, 1.5), (3.0, 4.5))
    start, _ = through_gaps(stopped(seen), seen, planted.bone_imus(BODY, TRUTH, LIMBS), BODY)
    p = kinematics.positions(BODY.parents, BODY.joint_offsets, start.p_world_joint[:, 0], start.R_world_bone)
    np.testing.assert_allclose(p, start.p_world_joint, atol=1e-9)
    step = np.linalg.norm(np.diff(start.p_world_joint, axis=0), axis=-1).max()
    assert step < 1.5 * np.linalg.norm(np.diff(TRUTH.p_world_joint, axis=0), axis=-1).max()
    turns = so3.angle_between(start.R_world_bone[:-1], start.R_world_bone[1:])
    assert turns.max() < np.radians(12)


def test_a_body_that_turns_where_nobody_sees_it_is_turned_by_its_limbs() -> None:
    """A quarter turn in two seconds, trunk and all; no sensor sits on the trunk."""
    about = so3.about_axis("z", np.radians(90) * np.clip((TRUTH.times - 2) / 2, 0, 1))
    turned = replace(
        TRUTH, R_world_bone=about[:, None] @ TRUTH.R_world_bone,
        p_world_joint=np.einsum("tij,tkj->tki", about, TRUTH.p_world_joint),
    )  # fmt: skip
    seen = hidden((2.2, 3.8))
    last = np.maximum.accumulate(np.where(seen, np.arange(T), 0))
    held = replace(turned, R_world_bone=turned.R_world_bone[last])
    start, _ = through_gaps(held, seen, planted.bone_imus(BODY, turned, LIMBS), BODY)
    off, was = (so3.angle_between(turned.R_world_bone[:, 0], p.R_world_bone[:, 0]) for p in (start, held))
    assert off.max() < np.radians(10)
    assert was.max() > 1.0


def test_without_sensors_on_the_legs_the_root_stays_where_it_was_put() -> None:
    seen = hidden((2.0, 4.0))
    imus = planted.bone_imus(BODY, TRUTH, ("LeftArm", "RightArm"))
    start, sigma = through_gaps(stopped(seen), seen, imus, BODY)
    np.testing.assert_array_equal(start.p_world_joint[:, 0], stopped(seen).p_world_joint[:, 0])
    np.testing.assert_array_equal(sigma, 0.0)


@pytest.mark.parametrize("seen", [np.ones(T, dtype=bool), np.zeros(T, dtype=bool)])
def test_who_is_seen_always_or_never_is_left_alone(seen: NDArray[np.bool_]) -> None:
    start, sigma = through_gaps(TRUTH, seen, planted.bone_imus(BODY, TRUTH, LIMBS), BODY)
    assert start is TRUTH
    np.testing.assert_array_equal(sigma, 0.0)
