"""Motion on another rig: what joint centres define stays, the spine bends evenly about a person's posture."""

from __future__ import annotations

import numpy as np
import planted

from benchmarks.rerigged import RIG, Posture, rerigged, t_pose
from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import SPINE
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.simulation.mocap import MocapClip

BODY = SkeletonModel.default()
OFFSETS = BODY.joint_offsets * 0.9 + np.where(BODY.index("Spine") == np.arange(21)[:, None], [0.02, 0, 0], 0)
CLIP = MocapClip("walk", planted.moving(BODY, 40).poses, OFFSETS, subject="somebody", rig="cmu_bvh")


def test_limbs_and_upper_trunk_stay_and_positions_follow_orientations() -> None:
    other = rerigged(CLIP)
    assert (other.name, other.rig) == ("walk_tc", RIG)
    kept = BODY.index("Spine3", "Head", "LeftArm", "RightForeArm", "LeftUpLeg", "RightLeg")
    off = so3.angle_between(other.poses.R_world_bone[:, kept], CLIP.poses.R_world_bone[:, kept])
    assert off.max() < 1e-6
    R, p = other.poses.R_world_bone, other.poses.p_world_joint
    again = kinematics.positions(BODY.parents, other.joint_offsets, p[:, 0], R)
    np.testing.assert_allclose(p, again, atol=1e-12)


def test_spine_bends_evenly_about_the_posture_of_the_person() -> None:
    other, bends = rerigged(CLIP), Posture.of("somebody").bends
    local = kinematics.local_rotations(BODY.parents, other.poses.R_world_bone)[:, BODY.index(*SPINE)]
    shares = so3.log(local[:, :3]) - bends[:3]
    np.testing.assert_allclose(shares, shares[:, :1].repeat(3, axis=1), atol=1e-9)
    assert np.ptp(shares, axis=0).max() > 0.01
    np.testing.assert_allclose(bends.sum(axis=0), 0, atol=1e-12)


def test_t_pose_shows_the_posture_and_the_pelvis_of_the_other_rig() -> None:
    rest = t_pose(CLIP)
    pitch = so3.log(rest["Hips"])
    assert abs(pitch[1]) > np.radians(2)  # the lumbar joint lies elsewhere
    np.testing.assert_allclose(rest["Hips"] @ rest["LeftUpLeg"], np.eye(3), atol=1e-9)
    posture = Posture.of("somebody")
    np.testing.assert_allclose(so3.log(rest["Spine"]), posture.bends[0] - pitch / 4, atol=1e-9)
    np.testing.assert_allclose(so3.log(rest["LeftShoulder"])[::2], posture.clavicles[0] * [1, -1], atol=1e-9)
