"""Shared frames: what they are on the shipped skeleton, and that they follow the joints."""

from __future__ import annotations

import numpy as np

from rtof_kin.body.kinematics import LUMBAR_PITCH, shared_frames, to_shared
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3

BODY = SkeletonModel.default()
NAMES, PARENTS = BODY.names, BODY.parents


def test_the_lumbar_joint_and_the_limbs_have_their_directions() -> None:
    offsets = to_shared(shared_frames(NAMES, BODY.joint_offsets), PARENTS, BODY.joint_offsets)
    own = dict(zip(NAMES, offsets, strict=True))
    up = own["Spine"] - (own["LeftUpLeg"] + own["RightUpLeg"]) / 2
    np.testing.assert_allclose(np.arctan2(up[0], up[2]), LUMBAR_PITCH, atol=1e-12)
    np.testing.assert_allclose((own["LeftUpLeg"] - own["RightUpLeg"])[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(so3.unit(own["LeftFoot"]), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(so3.unit(own["RightHand"]), [0, -1, 0], atol=1e-12)


def test_a_pelvis_frame_that_is_turned_against_the_joints_gives_the_same_body() -> None:
    turned = np.array(BODY.joint_offsets)
    R_old_new = so3.exp(np.radians([3.0, -8.0, 2.0]))
    of_pelvis = [j for j, parent in enumerate(PARENTS) if parent == 0]
    turned[of_pelvis] = turned[of_pelvis] @ R_old_new
    old, new = (shared_frames(NAMES, offsets) for offsets in (BODY.joint_offsets, turned))
    np.testing.assert_allclose(R_old_new @ new[0], old[0], atol=1e-12)
    np.testing.assert_allclose(
        to_shared(new, PARENTS, turned)[of_pelvis], to_shared(old, PARENTS, BODY.joint_offsets)[of_pelvis], atol=1e-12
    )


def test_a_straight_spine_and_unknown_joints_keep_their_link_frames() -> None:
    straight = np.array(BODY.joint_offsets)
    straight[NAMES.index("Spine")] = [0.0, 0.0, 0.1]
    np.testing.assert_array_equal(shared_frames(NAMES, straight)[0], np.eye(3))
    other = SkeletonModel.human36m()
    np.testing.assert_array_equal(
        shared_frames(other.names, other.joint_offsets), np.tile(np.eye(3), (len(other.names), 1, 1))
    )
