"""Observed and unobserved degrees of freedom, landmarks and bones of a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.observability import (
    DIRECTION,
    NOTHING,
    WHOLE,
    levels_by_points,
    never_observed,
    observed_bones,
    observed_dofs,
    observed_landmarks,
    root_turn_observed,
    segment_levels,
)
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import Provenance

BODY = SkeletonModel.default()
T = 12
ELBOWS_AND_KNEES = {
    f"{side}{axes}" for side in ("Left", "Right") for axes in ("ForeArm_y", "ForeArm_x", "Leg_x", "Leg_z")
}
LEAVES = ("Head", "LeftHand", "RightHand", "LeftFoot", "RightFoot")
ENDS = {f"{leaf}_{axis}" for leaf in LEAVES for axis in "xyz"}
HAND = {"RightHand_x", "RightHand_y", "RightHand_z"}


def seen_by(motion: Motion, *sensors: str) -> Motion:
    """The camera sees all joints, and sensors these segments."""
    observed = BODY.orientation_observed(sensors)
    return replace(motion, poses=replace(motion.poses, orientation_observed=observed))


def hinged(motion: Motion) -> Motion:
    """The same with knees and elbows that only bend."""
    q = np.array(motion.q)
    q[:, [7 + BODY.dof_names.index(name) for name in ELBOWS_AND_KNEES]] = 0.0
    return replace(motion, q=q)


def unobserved(motion: Motion) -> set[str]:
    """Degrees of freedom that were not observed in any frame."""
    return {n for n, seen in zip(BODY.dof_names, observed_dofs(motion).T, strict=True) if not seen.any()}


def with_landmarks(names: tuple[str, ...], camera: Camera) -> KeypointSequence:
    return KeypointSequence(camera, [0.0], np.ones((1, len(names), 2)), np.ones((1, len(names))), names)


def test_angles_fixed_by_the_solver_are_not_observed() -> None:
    """Limbs with sensors, in joint space: pronation, ankles, wrists and axial rotation of the neck."""
    motion = hinged(seen_by(planted.moving(BODY, T), *planted.LIMBS))
    assert unobserved(motion) == ELBOWS_AND_KNEES | ENDS | {"Neck_z"}
    assert root_turn_observed(motion).all()
    # Axial rotation of the neck moves the head, which is observed; the others move no joint.
    assert set(never_observed(motion)) == ELBOWS_AND_KNEES | ENDS
    q = np.array(motion.q)
    q[:, [7 + BODY.dof_names.index(name) for name in never_observed(motion)]] = 0.0
    p, _ = BODY.forward_kinematics(q)
    np.testing.assert_allclose(p, BODY.forward_kinematics(motion.q)[0], atol=1e-12)


@pytest.mark.parametrize(
    ("sensors", "missing"),
    [
        ((), ENDS | {"Neck_z", "LeftLeg_z", "RightLeg_z", "LeftForeArm_y", "RightForeArm_y"}),
        ((*planted.LIMBS, "RightFoot", "Head"), {n for n in ENDS if n[:5] not in ("Right", "Head_")} | HAND),
    ],
)
def test_sensors_observe_axial_rotations_that_joint_positions_do_not(
    sensors: tuple[str, ...], missing: set[str]
) -> None:
    assert unobserved(seen_by(planted.moving(BODY, T), *sensors)) == missing


def test_joint_of_an_unobserved_segment_is_not_observed_in_those_frames() -> None:
    motion = seen_by(planted.moving(BODY, T), *planted.LIMBS)
    provenance, observed = np.array(motion.poses.provenance), np.array(motion.poses.orientation_observed)
    leg = BODY.index("LeftLeg", "LeftFoot")
    provenance[3:5, leg] = Provenance.PRIOR
    observed[3:5, [*leg, *BODY.index("LeftUpLeg")]] = False
    poses = replace(motion.poses, provenance=provenance, orientation_observed=observed)
    found = observed_dofs(replace(motion, poses=poses))
    for name in ("LeftUpLeg_y", "LeftLeg_y"):
        assert np.flatnonzero(~found[:, BODY.dof_names.index(name)]).tolist() == [3, 4], name
    assert found[:, BODY.dof_names.index("RightLeg_y")].all()


def test_without_a_camera_joints_between_sensors_are_not_observed() -> None:
    motion = planted.moving(BODY, T)
    sensed = np.isin(BODY.names, planted.LIMBS)
    reached = sensed | np.isin([BODY.names[p] for p in BODY.parents], planted.LIMBS)
    provenance = np.tile(np.where(reached, Provenance.IMU, Provenance.PRIOR), (T, 1))
    poses = replace(motion.poses, provenance=provenance, orientation_observed=sensed)
    motion = replace(motion, poses=poses)
    assert not root_turn_observed(motion).any()
    moved = {"LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm"}
    assert {n.split("_")[0] for n in set(BODY.dof_names) - unobserved(motion)} == moved


def test_motion_without_provenance_is_observed_where_finite() -> None:
    motion = planted.moving(BODY, T)
    q = np.array(motion.q)
    q[2] = np.nan
    motion = replace(motion, q=q, poses=replace(motion.poses, provenance=None))
    assert observed_dofs(motion).all(axis=1).sum() == observed_dofs(motion).any(axis=1).sum() == T - 1
    assert not never_observed(motion)
    assert observed_landmarks(motion).all()
    np.testing.assert_array_equal(np.flatnonzero(~root_turn_observed(motion)), [2])


@pytest.mark.parametrize(
    ("names", "segment", "level"),
    [
        (("RightFoot", "RightHeel", "RightToe"), "RightFoot", WHOLE),
        (("RightFoot", "RightToe", "RightToeBase"), "RightFoot", DIRECTION),
        (("RightFoot", "RightToe"), "RightFoot", DIRECTION),
        (("RightFoot",), "RightFoot", NOTHING),
        (("RightHand", "RightHandEnd"), "RightHand", DIRECTION),
        (("Head", "Nose", "LeftEar"), "Head", WHOLE),
        (("RightLeg", "RightFoot"), "RightLeg", DIRECTION),
        (("Hips", "LeftUpLeg", "RightUpLeg"), "Hips", WHOLE),
        (("unknown landmark", "RightFoot", "LeftFoot"), "RightFoot", NOTHING),
    ],
)
def test_points_of_a_segment_determine_its_direction_or_orientation(
    names: tuple[str, ...], segment: str, level: int, camera: Camera
) -> None:
    levels = levels_by_points(BODY, with_landmarks(names, camera))
    assert levels[0, BODY.names.index(segment)] == level


def test_only_detected_points_count(camera: Camera) -> None:
    names = ("RightFoot", "RightHeel", "RightToe")
    uv = np.ones((4, 3, 2))
    uv[1, 2], uv[2, 1:] = np.nan, np.nan
    confidence = np.isfinite(uv[..., 0]).astype(float)
    levels = levels_by_points(BODY, KeypointSequence(camera, np.arange(4.0), uv, confidence, names))
    foot: NDArray[np.int_] = levels[:, BODY.names.index("RightFoot")]
    assert foot.tolist() == [WHOLE, DIRECTION, NOTHING, WHOLE]


def test_far_end_of_a_hand_does_not_observe_its_axial_rotation() -> None:
    motion = seen_by(planted.moving(BODY, T), *planted.LIMBS)
    directed = np.isin(BODY.names, "RightHand")
    motion = replace(motion, poses=replace(motion.poses, direction_observed=directed))
    assert (segment_levels(motion.poses, BODY)[:, directed] == DIRECTION).all()
    assert unobserved(motion) & HAND == {"RightHand_y"}
    landmarks = dict(zip(BODY.landmarks, observed_landmarks(motion).T, strict=True))
    assert landmarks["RightHandEnd"].all()
    assert not landmarks["LeftHandEnd"].any()


def test_heel_is_observed_only_with_the_orientation_of_its_foot() -> None:
    motion = seen_by(planted.moving(BODY, T), "LeftFoot")
    seen = observed_landmarks(motion)
    names = {n for n, whole in zip(BODY.landmarks, seen.all(axis=0), strict=True) if whole}
    assert names == {*BODY.names, "LeftHeel", "LeftToe", "LeftToeBase"}


def test_bone_is_observed_by_both_ends_or_by_a_sensor() -> None:
    motion = planted.moving(BODY, T)
    provenance, observed = np.array(motion.poses.provenance), np.zeros((T, len(BODY.names)), dtype=bool)
    arm, forearm, hand = BODY.index("LeftArm", "LeftForeArm", "LeftHand")
    provenance[4:, [forearm, hand]] = Provenance.PRIOR
    observed[8:, forearm] = True
    valid = np.array(motion.poses.valid)
    valid[10:] = False
    poses = replace(motion.poses, provenance=provenance, orientation_observed=observed, valid=valid)
    bones = observed_bones(replace(motion, poses=poses))
    assert np.flatnonzero(bones[:, forearm]).tolist() == [0, 1, 2, 3]
    assert np.flatnonzero(bones[:, hand]).tolist() == [0, 1, 2, 3, 8, 9]
    assert np.flatnonzero(bones[:, arm]).tolist() == list(range(10))
