"""Calibration by a pose, from sensors whose right calibration is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from inertial_support import Worn, exercising, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.poses import facing_of, pose_rotations
from rtof_kin.simulation.noise import ImuNoise

LEGS = ("L_UpLeg", "R_UpLeg", "L_LowLeg", "R_LowLeg", "Pelvis")
HEADING, HELD = 1.0, (0.5, 1.5)


@cache
def posed(pose: str, noisy: bool = False) -> Worn:
    """A walk after a pose, sensors in one reference that is turned by `HEADING` in world."""
    R = pose_rotations(pose, SkeletonModel.default())
    noise = replace(ImuNoise(), misalignment_deg=0.0) if noisy else None
    return walking(R, LEGS, noise=noise, seed=3).with_one_reference(HEADING)


def faced(worn: Worn) -> float:
    """Heading, rad, in which the person faces while the pose is held."""
    return facing_of(worn.poses.R_world_bone[0])


@pytest.mark.parametrize("pose", ["T", "N", "seated"])
def test_an_ideal_pose_with_known_facing_gives_the_planted_calibration(pose: str) -> None:
    worn = posed(pose)
    found = calibrate_by_pose(
        worn.imus, worn.joints, pose, worn.skeleton, facing=faced(worn) - HEADING, still=HELD
    ).calibration
    np.testing.assert_allclose(found.R_sensor_bone, worn.truth.R_sensor_bone, atol=1e-6)
    np.testing.assert_allclose(found.R_world_inertial, np.tile(np.eye(3), (len(LEGS), 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(found.p_bone_sensor, worn.truth.p_bone_sensor)


def test_the_world_can_be_the_one_the_person_is_known_to_face_in() -> None:
    worn = posed("N")
    found = calibrate_by_pose(
        worn.imus, worn.joints, "N", worn.skeleton, facing=faced(worn) - HEADING,
        world_facing=faced(worn), still=HELD,
    )  # fmt: skip
    np.testing.assert_allclose(found.calibration.R_world_inertial, worn.truth.R_world_inertial, atol=1e-6)
    assert found.facing == pytest.approx(faced(worn))


def test_facing_may_be_the_axis_of_a_sensor() -> None:
    worn = posed("N")
    s = LEGS.index("Pelvis")
    forward = worn.truth.R_sensor_bone[s][:, 0]
    column = int(np.argmax(np.abs(forward)))
    axis = ("-" if forward[column] < 0 else "") + "xyz"[column]
    by_axis = calibrate_by_pose(worn.imus, worn.joints, "N", worn.skeleton, facing=("Pelvis", axis))
    # The axis of a sensor that was put on anyhow points forward to within a half of a right angle.
    R_inertial_axis = worn.imus.R_inertial_sensor[0, s][:, column] * (-1 if axis[0] == "-" else 1)
    expected = np.arctan2(R_inertial_axis[1], R_inertial_axis[0])
    assert by_axis.facing == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("pose", ["T", "N", "seated"])
def test_facing_is_told_by_the_walk_that_follows(pose: str) -> None:
    worn = posed(pose, noisy=True)
    found = calibrate_by_pose(worn.imus, worn.joints, pose, worn.skeleton)
    off = so3.log(so3.about_axis("z", found.facing - (faced(worn) - HEADING)))
    assert np.degrees(np.abs(off[2])) < 12
    assert found.heading_margin is not None
    assert found.heading_margin > 20
    assert worn.errors_deg(found.calibration).mean() < 12
    assert not found.warnings


def test_headings_of_their_own_are_told_by_movement() -> None:
    worn = exercising(LEGS)
    found = calibrate_by_pose(worn.imus, worn.joints, "N", worn.skeleton, headings="own")
    assert worn.errors_deg(found.calibration).max() < 6
    assert found.facing == 0.0
    assert all(report.heading_sigma_deg > 0 for report in found.sensors)


def test_a_log_with_times_of_their_own_gives_the_same_as_one_sequence() -> None:
    worn = posed("N")
    options = {"facing": faced(worn) - HEADING, "still": HELD}
    of_log, of_sequence = (
        calibrate_by_pose(imus, worn.joints, "N", worn.skeleton, **options).calibration  # type: ignore[arg-type]
        for imus in (worn.log(), worn.imus)
    )
    np.testing.assert_allclose(of_log.R_sensor_bone, of_sequence.R_sensor_bone, atol=1e-9)


def test_a_measured_pose_gives_its_own_world() -> None:
    worn = posed("seated")
    R = worn.poses.R_world_bone[0]
    found = calibrate_by_pose(
        worn.imus, worn.joints, R, worn.skeleton, facing=faced(worn) - HEADING, still=HELD
    )
    assert found.pose == "measured"
    assert found.sensors[0].expected_deg < 5
    np.testing.assert_allclose(found.calibration.R_world_inertial, worn.truth.R_world_inertial, atol=1e-6)


def test_an_error_of_the_pose_becomes_one_of_the_same_size() -> None:
    worn = posed("N")
    R = worn.poses.R_world_bone[0].copy()
    j = worn.skeleton.index("LeftLeg")[0]
    R[j] = R[j] @ so3.exp(np.radians([0.0, 10.0, 0.0]))
    found = calibrate_by_pose(
        worn.imus, worn.joints, R, worn.skeleton, facing=faced(worn) - HEADING, still=HELD
    )
    off = so3.angle_between(found.calibration.R_sensor_bone, worn.truth.R_sensor_bone)
    np.testing.assert_allclose(np.degrees(off), [0, 0, 10, 0, 0], atol=1e-3)


def test_somebody_who_sways_is_told_so() -> None:
    worn = posed("N")
    t = worn.imus.times
    sway = so3.about_axis("y", 0.4 * np.sin(1.5 * t)[:, None])
    imus = replace(worn.imus, R_inertial_sensor=worn.imus.R_inertial_sensor @ sway)
    found = calibrate_by_pose(imus, worn.joints, "N", worn.skeleton, facing=0.0, still=(0.0, 2.0))
    assert "L_UpLeg turned by" in found.warnings[0]
    assert found.sensors[0].spread_deg > 5


def test_a_headings_warning_says_what_to_do() -> None:
    worn = posed("N")
    found = calibrate_by_pose(worn.imus, worn.joints, "N", worn.skeleton, facing=0.0)
    assert "hardly determines the headings (1.0 nats)" in replace(found, heading_margin=1.0).warnings[-1]


def test_own_places_stand_above_the_usual_ones() -> None:
    worn = posed("N")
    found = calibrate_by_pose(
        worn.imus, worn.joints, "N", worn.skeleton, facing=0.0, levers={"Pelvis": [0.0, 0.0, 0.1]}
    ).calibration
    np.testing.assert_array_equal(found.p_bone_sensor[LEGS.index("Pelvis")], [0.0, 0.0, 0.1])


def test_a_segment_without_a_usual_sensor_carries_it_in_its_middle() -> None:
    worn = posed("N")
    joints = {"Pelvis": "LeftHand"}
    found = calibrate_by_pose(worn.imus, joints, "N", worn.skeleton, facing=0.0).calibration
    hand = worn.skeleton.table.joints[worn.skeleton.index("LeftHand")[0]]
    np.testing.assert_allclose(found.p_bone_sensor, hand.end[None] / 2)


def test_what_cannot_be_is_refused() -> None:
    worn = posed("N")
    imus, joints, skeleton = worn.imus, worn.joints, worn.skeleton

    def refused(error: type[Exception], message: str, **changes: object) -> None:
        given = {"imus": imus, "joints": joints, "pose": "N", "skeleton": skeleton, "facing": 0.0}
        with pytest.raises(error, match=message):
            calibrate_by_pose(**{**given, **changes})  # type: ignore[arg-type]

    refused(UnknownNameError, "unknown sensor 'Pelviss'", joints={"Pelviss": "Hips"})
    refused(UnknownNameError, "unknown joint 'Hip'", joints={"Pelvis": "Hip"})
    refused(CalibrationError, "no sensor is mapped", joints={})
    twice = {"Pelvis": "Hips", "L_UpLeg": "Hips"}
    refused(CalibrationError, "several sensors are mapped to Hips", joints=twice)
    refused(UnknownNameError, "unknown kind of headings", headings="common")
    refused(CalibrationError, "facing has no meaning", headings="own")
    refused(InvalidInputError, "facing: nan is no angle", facing=float("nan"))
    refused(UnknownNameError, "unknown axis of facing", facing=("Pelvis", "forward"))
    refused(UnknownNameError, "unknown sensor of facing", facing=("Head", "x"))
    refused(UnknownNameError, "unknown sensor 'Head'", levers={"Head": [0, 0, 0]})
    refused(CalibrationError, "no orientation between 90 and 95 s", still=(90.0, 95.0))
    up = int(np.argmax(np.abs(imus.R_inertial_sensor[0, 4][2])))
    if abs(imus.R_inertial_sensor[0, 4][2, up]) > np.cos(np.radians(20)):
        refused(CalibrationError, "within 20 degrees of vertical", facing=("Pelvis", "xyz"[up]))


def test_a_pose_alone_tells_no_heading() -> None:
    worn = posed("N")
    still = slice(0, 115)
    imus = replace(
        worn.imus, times=worn.imus.times[still], f_sensor=worn.imus.f_sensor[still],
        R_inertial_sensor=worn.imus.R_inertial_sensor[still],
    )  # fmt: skip
    with pytest.raises(CalibrationError, match="headings are not observable: no sensor turns faster"):
        calibrate_by_pose(imus, worn.joints, "N", worn.skeleton)
    found = calibrate_by_pose(imus, worn.joints, "N", worn.skeleton, facing=faced(worn) - HEADING)
    np.testing.assert_allclose(found.calibration.R_sensor_bone, worn.truth.R_sensor_bone, atol=1e-6)


def test_movement_is_judged_on_the_skeleton_with_a_prior_only() -> None:
    worn = posed("N")
    small = SkeletonModel.human36m()
    with pytest.raises(CalibrationError, match="no pose prior of it; use the one with 21 joints"):
        calibrate_by_pose(worn.imus, {"Pelvis": "Hip"}, "N", small)
