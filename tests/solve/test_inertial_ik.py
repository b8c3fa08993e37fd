"""Inertial-guided inverse kinematics: bones set by sensors, by keypoints, or by observed orientations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.solve.initial_guess import InertialGuidedIK, InertialGuidedIKSettings

Array = NDArray[np.float64]
SKELETON = SkeletonModel.default()
EVERYWHERE = ("Hips", "Spine3", "Head", *planted.LIMBS, "LeftFoot", "RightFoot")
CHILD = {joint: kinematics.children_of(SKELETON.parents, SKELETON.index(joint)[0])[0] for joint in planted.LIMBS}


@pytest.fixture(scope="module")
def truth() -> Motion:
    return planted.moving(SKELETON, 40)


@pytest.fixture(scope="module")
def lifted(truth: Motion) -> PoseSequence:
    return planted.lifted_poses(truth)


def refine(
    poses: PoseSequence, imus: BoneImuSequence | None = None, threshold: float | None = None, oriented: bool = False
) -> PoseSequence:
    ik = InertialGuidedIK(SKELETON, InertialGuidedIKSettings(threshold))
    return ik.refine(poses, imus, poses.R_world_bone if oriented else None)


def sensors(truth: Motion, joints: tuple[str, ...], degrees: float = 0.0) -> BoneImuSequence:
    return planted.bone_imus(SKELETON, truth.poses, joints, degrees)


def turned(imus: BoneImuSequence, angle: float, axis: str = "x") -> BoneImuSequence:
    """Sensors that are all wrong by one rotation in the bone's own axes."""
    return replace(imus, R_world_bone=imus.R_world_bone @ so3.about_axis(axis, angle))


def bone_directions(poses: PoseSequence, joint: str) -> Array:
    """Unit vectors (T, 3) in world from a joint to its child."""
    (j,) = SKELETON.index(joint)
    return so3.unit(poses.p_world_joint[:, CHILD[joint]] - poses.p_world_joint[:, j])


def angle(a: Array, b: Array) -> Array:
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def test_perfect_sensors_recover_the_limbs(truth: Motion, lifted: PoseSequence) -> None:
    out = refine(lifted, sensors(truth, planted.LIMBS))
    limbs = SKELETON.index(*planted.LIMBS)
    angles = so3.angle_between(out.R_world_bone[:, limbs], truth.poses.R_world_bone[:, limbs])
    assert angles.max() < 1e-7
    before = so3.angle_between(refine(lifted).R_world_bone[:, limbs], truth.poses.R_world_bone[:, limbs])
    assert before.mean() > 0.1


def test_threshold_pi_takes_only_the_sensors_twist(truth: Motion, lifted: PoseSequence) -> None:
    imus = turned(sensors(truth, planted.LIMBS), 0.4)
    out = refine(lifted, imus, threshold=np.pi)
    for s, joint in enumerate(planted.LIMBS):
        np.testing.assert_allclose(bone_directions(out, joint), bone_directions(lifted, joint), atol=1e-9)
        (j,) = SKELETON.index(joint)
        # No twist is left between the sensor and the answer: their difference is across the bone.
        rest = so3.unit(SKELETON.joint_offsets[CHILD[joint]])
        R_imu = imus.R_world_bone[:, s]
        swing = so3.log(out.R_world_bone[:, j] @ np.swapaxes(R_imu, -1, -2))
        assert np.abs(np.sum(swing * (R_imu @ rest), axis=-1)).max() < 1e-7


@pytest.mark.parametrize("sigma, share", [(np.radians(2.5), 0.5), (np.radians(5.0), 0.2), (np.nan, 0.0)])
def test_sensor_and_observed_bone_are_weighed_by_their_variances(truth: Motion, sigma: float, share: float) -> None:
    seen = replace(truth.poses, sigma_rad=np.full((40, 21), sigma))
    imus = turned(sensors(truth, ("LeftLeg",)), 0.3)  # across the shank
    out = InertialGuidedIK(SKELETON).refine(seen, imus)
    off = angle(bone_directions(out, "LeftLeg"), bone_directions(truth.poses, "LeftLeg"))
    np.testing.assert_allclose(off, 0.3 * (1 - share), atol=0.01)


@pytest.mark.parametrize("threshold, sensor_wins", [(0.29, True), (0.31, False)])
def test_threshold_compares_directions(truth: Motion, threshold: float, sensor_wins: bool) -> None:
    poses = refine(truth.poses)
    imus = turned(sensors(truth, ("LeftLeg",)), 0.3)  # across the shank
    out = refine(poses, imus, threshold)
    taken = imus.R_world_bone[:, 0]
    error = angle(bone_directions(out, "LeftLeg"), bone_directions(truth.poses, "LeftLeg"))
    np.testing.assert_allclose(error, 0.3 if sensor_wins else 0.0, atol=0.01)
    (j,) = SKELETON.index("LeftLeg")
    equal = so3.angle_between(out.R_world_bone[:, j], taken) < 1e-9
    assert np.all(equal == sensor_wins)


def test_children_of_a_replaced_bone_keep_direction(truth: Motion, lifted: PoseSequence) -> None:
    out = refine(lifted, turned(sensors(truth, ("LeftArm",)), 1.0))
    assert angle(bone_directions(out, "LeftArm"), bone_directions(lifted, "LeftArm")).min() > 0.2
    np.testing.assert_allclose(bone_directions(out, "LeftForeArm"), bone_directions(lifted, "LeftForeArm"), atol=1e-9)
    np.testing.assert_allclose(bone_directions(out, "RightArm"), bone_directions(lifted, "RightArm"), atol=1e-9)


def test_bone_lengths_and_root_are_kept(truth: Motion, lifted: PoseSequence) -> None:
    out = refine(lifted, sensors(truth, EVERYWHERE, degrees=5))
    parents = np.array(SKELETON.parents[1:])
    bones = out.p_world_joint[:, 1:] - out.p_world_joint[:, parents]
    lengths = np.linalg.norm(SKELETON.joint_offsets[1:], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(bones, axis=-1), np.tile(lengths, (40, 1)), atol=1e-12)
    np.testing.assert_array_equal(out.p_world_joint[:, 0], lifted.p_world_joint[:, 0])


@settings(max_examples=20, deadline=None)
@given(joints=st.sets(st.sampled_from(EVERYWHERE)))
def test_any_subset_of_sensors_is_used_and_flagged(joints: set[str]) -> None:
    truth = planted.moving(SKELETON, 3)
    seen = replace(planted.lifted_poses(truth), orientation_observed=SKELETON.orientation_observed())
    out = refine(seen, sensors(truth, tuple(sorted(joints))))
    index = SKELETON.index(*sorted(joints))
    error = so3.angle_between(out.R_world_bone[:, index], truth.poses.R_world_bone[:, index])
    assert error.max(initial=0.0) < 1e-7
    observed = {"Hips", "Spine3"} | joints
    named = {n for n, o in zip(SKELETON.names, out.orientation_observed[0], strict=True) if o}
    assert named == observed


def test_missing_samples_leave_the_observed_bone(truth: Motion, lifted: PoseSequence) -> None:
    imus = sensors(truth, planted.LIMBS)
    R = np.array(imus.R_world_bone)
    R[10:20, 2] = np.nan  # LeftForeArm
    out = refine(lifted, replace(imus, R_world_bone=R))
    seen = bone_directions(lifted, "LeftForeArm")
    np.testing.assert_allclose(bone_directions(out, "LeftForeArm")[10:20], seen[10:20], atol=1e-9)
    true = bone_directions(truth.poses, "LeftForeArm")
    np.testing.assert_allclose(bone_directions(out, "LeftForeArm")[20:], true[20:], atol=1e-9)
    (j,) = SKELETON.index("LeftForeArm")
    assert not out.orientation_observed[10:20, j].any()
    assert out.orientation_observed[20:, j].all()
    (hand,) = SKELETON.index("LeftHand")
    assert np.all(out.provenance[10:20, hand] == Provenance.CAMERA)
    assert np.all(out.provenance[20:, hand] == Provenance.CAMERA_AND_IMU)


def test_frames_with_nan_do_not_affect_others(truth: Motion, lifted: PoseSequence) -> None:
    p = np.array(lifted.p_world_joint)
    p[5, 3] = np.nan
    out = refine(replace(lifted, p_world_joint=p), sensors(truth, planted.LIMBS))
    whole = refine(lifted, sensors(truth, planted.LIMBS))
    assert np.isnan(out.R_world_bone[5]).all()
    assert np.isnan(out.p_world_joint[5, 1:]).all()
    assert not out.valid[5, 1:].any()
    others = np.arange(40) != 5
    np.testing.assert_allclose(out.p_world_joint[others], whole.p_world_joint[others], atol=1e-12)


def test_sensors_are_resampled_to_the_frames() -> None:
    truth = planted.moving(SKELETON, 81)
    even = slice(0, None, 2)
    poses, imus = truth.poses[even], sensors(truth, planted.LIMBS)
    direct, resampled = refine(poses, imus[even]), refine(poses, imus)
    np.testing.assert_allclose(resampled.p_world_joint, direct.p_world_joint, atol=1e-9)


@pytest.mark.parametrize("wrong", [{"threshold": -0.1}, {"threshold": np.nan}, {"sigma_sensor": 0.0}])
def test_invalid_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        InertialGuidedIKSettings(**wrong)


CHILDREN = [kinematics.children_of(SKELETON.parents, j) for j in range(len(SKELETON.names))]
SINGLE = [j for j, children in enumerate(CHILDREN) if len(children) == 1]
OTHERS = [j for j, children in enumerate(CHILDREN) if len(children) != 1]
"""Leaves, and segments with several children."""


@pytest.fixture(scope="module")
def oriented(lifted: PoseSequence) -> PoseSequence:
    """Lifted positions, with orientations that do not quite agree with them."""
    error = planted.smooth_noise(21, (40, len(SKELETON.names), 3), 12, 0.15)
    return replace(lifted, R_world_bone=lifted.R_world_bone @ so3.exp(error))


def test_segments_of_one_bone_take_the_observed_twist(oriented: PoseSequence) -> None:
    out = refine(oriented, oriented=True)
    for j in SINGLE:
        c = CHILDREN[j][0]
        bone, seen = (poses.p_world_joint[:, c] - poses.p_world_joint[:, j] for poses in (out, oriented))
        np.testing.assert_allclose(so3.unit(bone), so3.unit(seen), atol=1e-9)
        rest = so3.unit(SKELETON.joint_offsets[CHILDREN[j][0]])
        R = oriented.R_world_bone[:, j]
        swing = so3.log(out.R_world_bone[:, j] @ np.swapaxes(R, -1, -2))
        assert np.abs(np.sum(swing * (R @ rest), axis=-1)).max() < 1e-7, SKELETON.names[j]
        by_position = refine(oriented).R_world_bone[:, j]
        assert so3.angle_between(out.R_world_bone[:, j], by_position).max() > 0.05


def test_segments_with_several_bones_or_none_take_observed_orientations(oriented: PoseSequence) -> None:
    out = refine(oriented, oriented=True).R_world_bone
    assert {SKELETON.names[j] for j in OTHERS} >= {"Hips", "Spine3", "Head", "LeftHand", "RightFoot"}
    seen, by_position = oriented.R_world_bone, refine(oriented).R_world_bone
    assert so3.angle_between(by_position, seen)[:, OTHERS].max(axis=0).min() > 0.05
    assert so3.angle_between(out[:, OTHERS], seen[:, OTHERS]).max() < 1e-7


def test_missing_orientations_follow_from_positions(oriented: PoseSequence) -> None:
    R = np.array(oriented.R_world_bone)
    R[10:20] = np.nan
    R[30, [0, 9]] = np.nan
    out = refine(replace(oriented, R_world_bone=R), oriented=True)
    by_position, whole = refine(oriented), refine(oriented, oriented=True)
    np.testing.assert_allclose(out.R_world_bone[10:20], by_position.R_world_bone[10:20], atol=1e-9)
    np.testing.assert_allclose(out.R_world_bone[:10], whole.R_world_bone[:10], atol=1e-9)
    np.testing.assert_allclose(out.R_world_bone[30, 0], by_position.R_world_bone[30, 0], atol=1e-9)
    others = [j for j in range(21) if j not in (0, 9)]
    np.testing.assert_allclose(out.R_world_bone[30, others], whole.R_world_bone[30, others], atol=1e-9)
    nothing = refine(replace(oriented, R_world_bone=np.full_like(R, np.nan)), oriented=True)
    np.testing.assert_array_equal(nothing.R_world_bone, by_position.R_world_bone)
    np.testing.assert_array_equal(nothing.p_world_joint, by_position.p_world_joint)
