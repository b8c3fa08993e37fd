"""Poses of calibration, against where limbs point in them."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.inertial.pose_calibration import POSES, facing_of, pose_rotations, turned_to

DOWN, AHEAD = [0, 0, -1], [1, 0, 0]


@pytest.mark.parametrize(
    ("pose", "joint", "direction"),
    [
        ("T", "LeftArm", [0, 1, 0]),
        ("N", "LeftArm", DOWN),
        ("N", "RightForeArm", DOWN),
        ("N", "LeftLeg", DOWN),
        ("seated", "LeftUpLeg", AHEAD),
        ("seated", "RightLeg", DOWN),
        ("seated", "RightArm", DOWN),
    ],
)
def test_limbs_point_where_the_pose_says(
    pose: str, joint: str, direction: list[float], skeleton: SkeletonModel
) -> None:
    R = pose_rotations(pose, skeleton)
    child = next(i for i, p in enumerate(skeleton.parents) if p == skeleton.index(joint)[0])
    bone = R[skeleton.index(joint)[0]] @ so3.unit(skeleton.joint_offsets[child])
    assert bone @ np.array(direction) > 0.95


def test_palms_face_the_thighs_in_an_n_pose_and_feet_are_flat_when_seated(skeleton: SkeletonModel) -> None:
    R = pose_rotations("N", skeleton)
    for hand, inward in (("LeftHand", -1.0), ("RightHand", 1.0)):
        palm = R[skeleton.index(hand)[0]] @ np.array(DOWN)  # palms are down in the T-pose
        np.testing.assert_allclose(palm, [0, inward, 0], atol=1e-9)
    seated = pose_rotations("seated", skeleton)
    np.testing.assert_allclose(seated[skeleton.index("LeftFoot")[0]], np.eye(3), atol=1e-9)


@pytest.mark.parametrize("pose", POSES)
def test_a_named_pose_faces_x_and_can_be_turned(pose: str, skeleton: SkeletonModel) -> None:
    R = pose_rotations(pose, skeleton)
    assert facing_of(R) == pytest.approx(0.0)
    turned = turned_to(R, 2.0)
    assert facing_of(turned) == pytest.approx(2.0)
    relative = (np.swapaxes(M[:1], -1, -2) @ M for M in (turned, R))
    np.testing.assert_allclose(*relative, atol=1e-12)


def test_invalid_poses_are_refused(skeleton: SkeletonModel) -> None:
    with pytest.raises(UnknownNameError, match="unknown calibration pose 'TT'.*Known: T, N, seated"):
        pose_rotations("TT", skeleton)
    with pytest.raises(InvalidInputError, match=r"expected shape \(21, 3, 3\)"):
        pose_rotations(np.eye(3), skeleton)
    measured = so3.exp(np.random.default_rng(0).standard_normal((21, 3)))
    np.testing.assert_array_equal(pose_rotations(measured, skeleton), measured)
    R = np.tile(np.eye(3), (21, 1, 1))
    R[4] = np.nan
    with pytest.raises(InvalidInputError, match="Spine3"):
        pose_rotations(R, skeleton)
    lying = np.tile(so3.about_axis("y", np.pi / 2), (21, 1, 1))
    with pytest.raises(InvalidInputError, match="vertical"):
        facing_of(lying)
