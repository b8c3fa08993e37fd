"""A person's T-pose: found in poses, and what it does to the pose prior."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import CLAVICLES, HIPS, JOINTS, SPINE, NeutralPosture, posture_from_t_pose, shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import all_observed, clinical_angles, relative_to_standing
from rtof_kin.clinical.paths import body_paths
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence

BODY = SkeletonModel.default()
RATE_HZ = 60.0


def bent(degrees: dict[str, tuple[float, float, float]], frames: int) -> PoseSequence:
    """Poses with some joints turned by rotation vectors from the rig's T-pose."""
    local = np.tile(np.eye(3), (frames, len(BODY.names), 1, 1))
    for joint, vector in degrees.items():
        local[:, BODY.names.index(joint)] = so3.exp(np.radians(vector))
    R = kinematics.world_rotations(BODY.parents, local)
    p = kinematics.positions(BODY.parents, BODY.joint_offsets, np.zeros((frames, 3)), R)
    return PoseSequence(np.arange(frames) / RATE_HZ, p, R, BODY.names)


def joined(*parts: PoseSequence) -> PoseSequence:
    p, R = (np.concatenate([getattr(x, n) for x in parts]) for n in ("p_world_joint", "R_world_bone"))
    return PoseSequence(np.arange(len(p)) / RATE_HZ, p, R, BODY.names)


OWN = {
    "Spine1": (0.0, 9.0, 0.0),
    "Spine3": (0.0, -4.0, 1.0),
    "LeftShoulder": (12.0, 0.0, 3.0),
    "RightUpLeg": (0.0, -8.0, 0.0),
}
HANGING = {"LeftArm": (-75.0, 0.0, 0.0), "RightArm": (75.0, 0.0, 0.0)}


def test_the_first_still_t_pose_gives_the_posture() -> None:
    posture = posture_from_t_pose(joined(bent(HANGING, 40), bent(OWN, 30), bent({}, 30)), BODY.parents)
    assert posture is not None
    for joint, R in zip(JOINTS, posture.R_parent_bone, strict=True):
        np.testing.assert_allclose(so3.log(R), np.radians(OWN.get(joint, (0, 0, 0))), atol=1e-9)


def test_hanging_arms_and_short_or_moving_t_poses_are_none() -> None:
    assert posture_from_t_pose(bent(HANGING, 90), BODY.parents) is None
    assert posture_from_t_pose(joined(bent(HANGING, 40), bent(OWN, 8), bent(HANGING, 40)), BODY.parents) is None
    swaying = [bent({"Spine": (0.0, 2.0 * t, 0.0)}, 1) for t in range(20)]
    assert posture_from_t_pose(joined(*swaying), BODY.parents) is None


def test_the_prior_of_a_person_has_the_spine_of_the_posture_and_lowered_clavicles() -> None:
    posture = NeutralPosture.of(bent(OWN, 3), BODY.parents)
    population, own = shipped_prior(BODY.names), BODY.with_posture(posture).table.prior
    means = {n: R for n, R in zip(BODY.names[1:], so3.from_quat_wxyz(own.mean_quat_wxyz), strict=True)}
    before = {n: R for n, R in zip(BODY.names[1:], so3.from_quat_wxyz(population.mean_quat_wxyz), strict=True)}
    for joint in SPINE:
        np.testing.assert_allclose(so3.log(means[joint]), np.radians(OWN.get(joint, (0, 0, 0))), atol=1e-9)
    for joint in HIPS:
        np.testing.assert_allclose(
            means[joint] @ before[joint].T, so3.exp(np.radians(OWN.get(joint, (0.0, 0, 0)))), atol=1e-9
        )
    lowered = {j: np.degrees(so3.log(so3.exp(np.radians(OWN.get(j, (0.0, 0, 0)))).T @ means[j]))[0] for j in CLAVICLES}
    assert -20 < lowered["LeftShoulder"] < -12
    assert 12 < lowered["RightShoulder"] < 20
    assert {n for n in means if not np.allclose(means[n], before[n])} <= set(JOINTS)
    np.testing.assert_array_equal(own.covariance, population.covariance)


def test_angles_relative_to_standing_vanish_there_and_keep_their_range() -> None:
    tilted = {"Spine1": (0.0, 9.0, 0.0), **HANGING}
    sitting = {"LeftUpLeg": (0.0, -80.0, 0.0), "RightUpLeg": (0.0, -80.0, 0.0), **tilted}
    poses = joined(bent(sitting, 20), bent(tilted, 45), bent(sitting, 20))
    plain = clinical_angles(all_observed(poses), BODY)
    own = relative_to_standing(plain, body_paths(poses, BODY, standing=True))
    assert abs(plain["spine_flexion"][40]) == pytest.approx(np.radians(9.0), abs=0.02)
    assert own["spine_flexion"][40] == pytest.approx(0.0, abs=1e-9)
    for name in ("right_hip_flexion", "left_shoulder_elevation"):
        assert np.ptp(own[name]) == pytest.approx(np.ptp(plain[name]))
    np.testing.assert_array_equal(own["left_shoulder_elevation"], plain["left_shoulder_elevation"])
    assert "from 0.35 to 1.05 s" in own.notes[-1]
    with pytest.raises(InvalidInputError, match="nobody stands upright and still"):
        seated = all_observed(bent(sitting, 60))
        relative_to_standing(clinical_angles(seated, BODY), body_paths(seated, BODY, standing=True))


def test_scaled_bodies_keep_their_posture_and_wrong_ones_are_refused() -> None:
    posture = NeutralPosture.of(bent(OWN, 3), BODY.parents)
    assert BODY.with_posture(posture).with_height(1.6).table.posture is posture
    with pytest.raises(InvalidInputError, match="not unit quaternions"):
        NeutralPosture(("Spine",), np.array([[2.0, 0, 0, 0]]))
    with pytest.raises(InvalidInputError, match="no frame of the T-pose is complete"):
        NeutralPosture.of(
            bent({}, 3).with_poses(slice(None), np.full((3, 21, 3), np.nan), np.full((3, 21, 3, 3), np.nan)),
            BODY.parents,
        )
