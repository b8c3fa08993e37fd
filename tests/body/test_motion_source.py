"""`MotionSource`: blocks with margins, parts, and the masks of the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest

from rtof_kin.body import motion_source
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks, never_observed, observed_dofs
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.poses import Provenance

BODY = SkeletonModel.default()
T = 40


@pytest.fixture
def motion() -> Motion:
    """All but the left hand observed by sensors; the left knee bends in the first quarter alone."""
    motion = planted.moving(BODY, T)
    q = np.array(motion.q)
    names = BODY.dof_names
    for dof in ("LeftLeg_x", "LeftLeg_z"):
        q[:, 7 + names.index(dof)] = 0.0
    q[T // 4 :, 7 + names.index("LeftLeg_y")] = 0.0
    p, R = BODY.forward_kinematics(q)
    turned = np.array([name != "LeftHand" for name in BODY.names])
    poses = replace(
        motion.poses,
        p_world_joint=p,
        R_world_bone=R,
        orientation_observed=turned,
        provenance=np.where(turned, Provenance.IMU, Provenance.PRIOR)[None].repeat(T, axis=0),
    )
    return replace(motion, q=q, poses=poses)


@pytest.fixture
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_source, "BLOCK", 7)


@pytest.mark.usefixtures("short_blocks")
@pytest.mark.parametrize("margin", [0, 1, 9])
def test_blocks_are_the_motion_and_their_margin_is_what_is_beside_them(motion: Motion, margin: int) -> None:
    covered = []
    for block in MotionSource.of(motion).blocks(margin):
        first, last = max(block.start - margin, 0), min(block.stop + margin, T)
        np.testing.assert_array_equal(block.motion.q, motion.q[first:last])
        np.testing.assert_array_equal(block.motion.q[block.own], motion.q[block.frames])
        covered += range(block.start, block.stop)
    assert covered == list(range(T))


@pytest.mark.usefixtures("short_blocks")
def test_masks_of_blocks_are_those_of_the_whole(motion: Motion) -> None:
    source, whole = MotionSource.of(motion), ObservationMasks.of(motion)
    np.testing.assert_array_equal(observed_dofs(source.masks), observed_dofs(motion))
    np.testing.assert_array_equal(source.masks.levels, whole.levels)
    assert never_observed(source.masks) == never_observed(motion) != ()
    fixed = [BODY.dof_names.index(name) for name in ("LeftLeg_x", "LeftLeg_z")]
    straight = slice(T // 2, T)  # where the knee does not move, nothing shows that it is a hinge
    assert observed_dofs(motion[straight])[:, fixed].all()
    assert not observed_dofs(source.masks[straight])[:, fixed].any()


@pytest.mark.usefixtures("short_blocks")
def test_part_of_a_source_is_that_part_of_the_motion(motion: Motion) -> None:
    part = MotionSource.of(motion)[5:25][3:]
    found = np.concatenate([block.motion.q for block in part.blocks()])
    np.testing.assert_array_equal(found, motion.q[8:25])
    np.testing.assert_array_equal(part.times, motion.times[8:25])
    np.testing.assert_array_equal(part.masks.valid, motion.poses.valid[8:25])


def test_source_of_a_source_is_itself_and_times_can_be_replaced(motion: Motion) -> None:
    source = MotionSource.of(motion)
    assert MotionSource.of(source) is source
    later = source.with_times(motion.times + 5)
    (block,) = later.blocks()
    np.testing.assert_array_equal(block.motion.times, motion.times + 5)
    assert later.rate_hz == pytest.approx(source.rate_hz)
