"""Names of segments in the words of people and devices: what is known, and what is not guessed."""

from __future__ import annotations

import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.inertial.segment_names import known_segment, segment_of, segments_of

SKELETON = SkeletonModel.default()
H36M = SkeletonModel.human36m()


@pytest.mark.parametrize(
    ("joint", "names"),
    [
        (
            "LeftLeg",
            "LeftLeg, L_LowLeg, left shank, shank_l, L tibia, tibia_l_imu, Shank LT, LTibia, ltibia, "
            "lower_leg_left, Left Lower Leg, LEFT SHANK, LeftLowerLeg, left leg, l. calf",
        ),
        (
            "RightUpLeg",
            "RightUpLeg, R_UpLeg, femur_r_imu, RFemur, Right Upper Leg 64F61C2E, upperleg right, "
            "right thigh, Thigh RT, RightUpperLeg, rthigh",
        ),
        ("RightFoot", "R_Foot, calcn_r_imu, foot_right, Foot RT, right foot sensor"),
        ("LeftArm", "upper_arm_left, LeftUpperArm, humerus_l_imu, left upperarm, L_UpArm, Upper arm LT"),
        ("LeftForeArm", "LeftForeArm, forearm_left, ulna_l_imu, left wrist, L_LowArm, lower arm left"),
        ("RightShoulder", "RightShoulder, right scapula, clavicle_r"),
        ("Hips", "Hips, Pelvis, pelvis_imu, hip, sacrum, PELVIS"),
        ("Spine3", "Sternum, T8, torso_imu, chest, upper_back, Upper spine"),
        ("Spine", "L5, lower_back, lumbar, LowerBack, Lower spine"),
        ("Head", "Head, head_imu"),
    ],
)
def test_one_segment_has_many_names(joint: str, names: str) -> None:
    assert {name: segment_of(name, SKELETON) for name in names.split(", ")} == dict.fromkeys(names.split(", "), joint)


@pytest.mark.parametrize(
    "name", ["", "00B421E6", "thigh", "left", "left right shank", "left hip", "LeftToe", "shank 2", "pole"]
)
def test_what_is_not_certain_is_unknown(name: str) -> None:
    assert segment_of(name, SKELETON) is None
    with pytest.raises(UnknownNameError, match="unknown segment"):
        known_segment(name, SKELETON)


@pytest.mark.parametrize("skeleton", [SKELETON, H36M], ids=lambda s: s.name)
def test_joints_and_sensors_and_clinical_terms_mean_themselves(skeleton: SkeletonModel) -> None:
    for joint in skeleton.names:
        assert known_segment(joint, skeleton) == joint
    for sensor, (joint, _) in skeleton.sensors.items():
        assert known_segment(sensor, skeleton) == joint
    for term, joint in angle_table(skeleton.table).segments.items():
        if joint in skeleton.names:
            assert known_segment(term, skeleton) == joint


def test_joints_that_the_other_skeleton_calls_otherwise() -> None:
    assert segment_of("right shank", H36M) == "RKnee"
    assert segment_of("left wrist", H36M) == "LElbow"  # a sensor at the wrist is on the forearm
    assert segment_of("LWrist", H36M) == "LWrist"  # its joint is the hand's
    assert segment_of("left shoulder", H36M) is None  # it has no clavicles


def test_sensors_of_the_same_segment_are_left_out() -> None:
    names = ["left shank", "tibia_l_imu", "pelvis", "00B421E6"]
    assert segments_of(names, SKELETON) == {"pelvis": "Hips"}
