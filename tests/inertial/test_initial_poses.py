"""Poses from sensors alone: exact for segments with sensors, the mean posture elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.poses import Provenance
from rtof_kin.inertial.initial_poses import poses_from_sensors

BODY = SkeletonModel.default()
TRUTH = planted.human(BODY, 60).poses


def test_segments_with_sensors_are_exact_and_bones_rigid() -> None:
    imus = planted.bone_imus(BODY, TRUTH, planted.LIMBS)
    poses = poses_from_sensors(BODY, imus)
    index = BODY.index(*planted.LIMBS)
    np.testing.assert_allclose(poses.R_world_bone[:, index], imus.R_world_bone, atol=1e-9)
    bones = poses.p_world_joint[:, 1:] - poses.p_world_joint[:, list(BODY.parents[1:])]
    lengths = np.linalg.norm(BODY.joint_offsets[1:], axis=1)
    np.testing.assert_allclose(np.linalg.norm(bones, axis=2), np.tile(lengths, (60, 1)), atol=1e-9)
    np.testing.assert_array_equal(poses.p_world_joint[:, 0], 0.0)


def test_only_segments_with_data_are_observed() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("LeftLeg", "Hips"))
    R = np.array(imus.R_world_bone)
    R[10:20, 0] = np.nan
    poses = poses_from_sensors(BODY, replace(imus, R_world_bone=R))
    (leg, foot, hips, spine, arm) = BODY.index("LeftLeg", "LeftFoot", "Hips", "Spine", "LeftArm")
    assert not poses.orientation_observed[10:20, leg].any()
    assert poses.orientation_observed[20:, leg].all()
    assert not poses.orientation_observed[:, [spine, arm, foot]].any()
    assert (poses.provenance[20:, foot] == Provenance.IMU).all()
    assert (poses.provenance[10:20, foot] == Provenance.PRIOR).all()
    assert (poses.provenance[:, spine] == Provenance.IMU).all()
    assert (poses.provenance[:, [arm, hips]] == Provenance.PRIOR).all()
    assert np.isfinite(poses.R_world_bone).all()
    R[10:20] = np.nan
    valid = poses_from_sensors(BODY, replace(imus, times=10 * imus.times, R_world_bone=R)).valid
    np.testing.assert_array_equal(np.flatnonzero(~valid.any(axis=1)), np.arange(10, 20))


def test_gaps_are_interpolated_on_the_geodesic() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("Hips",))
    R = np.array(imus.R_world_bone)
    R[:5] = R[30:40] = R[55:] = np.nan
    got = poses_from_sensors(BODY, replace(imus, R_world_bone=R)).R_world_bone[:, 0]
    np.testing.assert_allclose(got[0], R[5, 0], atol=1e-9)
    np.testing.assert_allclose(got[-1], R[54, 0], atol=1e-9)
    whole = so3.angle_between(R[29, 0], R[40, 0])
    assert so3.angle_between(R[29, 0], got[34]) == pytest.approx(whole * 5 / 11, rel=1e-6)


def test_segments_between_sensors_share_the_rotation() -> None:
    turn = so3.about_axis("z", np.radians(40.0))
    imus = planted.bone_imus(BODY, TRUTH, ("Hips", "Spine3"))
    neutral = poses_from_sensors(BODY, planted.bone_imus(BODY, TRUTH, ("Hips",)))
    R = np.stack([neutral.R_world_bone[:, 0], neutral.R_world_bone[:, 4] @ turn], axis=1)
    got = poses_from_sensors(BODY, replace(imus, R_world_bone=R)).R_world_bone
    trunk = BODY.index("Spine", "Spine1", "Spine2", "Spine3")
    off = np.degrees(so3.angle_between(got[:, trunk], neutral.R_world_bone[:, trunk]))
    assert (np.diff(off, axis=1) > 1).all()
    np.testing.assert_allclose(off[:, -1], 40.0, atol=1e-6)


def test_a_root_without_a_sensor_is_upright_with_the_thighs_heading() -> None:
    standing = planted.upright(BODY, 4).poses
    for yaw in np.radians([0.0, 100.0, -170.0]):
        turned = replace(standing, R_world_bone=so3.about_axis("z", yaw) @ standing.R_world_bone)
        poses = poses_from_sensors(BODY, planted.bone_imus(BODY, turned, ("LeftUpLeg", "RightUpLeg")))
        np.testing.assert_allclose(poses.R_world_bone[:, 0, 2, 2], 1.0, atol=1e-12)
        expected = so3.about_axis("z", float(so3.heading(turned.R_world_bone[0, 0])))
        assert np.degrees(so3.angle_between(poses.R_world_bone[0, 0], expected)) < 12.0


def test_sensors_without_data_or_segment_are_refused() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("Hips",))
    with pytest.raises(InvalidInputError, match="no sensor has an orientation"):
        poses_from_sensors(BODY, replace(imus, R_world_bone=np.full_like(imus.R_world_bone, np.nan)))
    with pytest.raises(UnknownNameError, match="Tail"):
        poses_from_sensors(BODY, replace(imus, joints=("Tail",)))
