"""Calibration by a pose, from sensors whose correct calibration is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from inertial_support import Worn, exercising, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.inertial.pose_calibration import PoseCalibration, calibrate_by_pose, facing_of, pose_rotations
from rtof_kin.simulation.noise import ImuNoise

LEGS = ("L_UpLeg", "R_UpLeg", "L_LowLeg", "R_LowLeg", "Pelvis")
HEADING = 1.0


@cache
def posed(pose: str = "N", noisy: bool = False) -> Worn:
    """A walk after a pose, with sensors in one reference that is rotated by `HEADING` in world."""
    R = pose_rotations(pose, SkeletonModel.default())
    noise = replace(ImuNoise(), misalignment_deg=0.0) if noisy else None
    return walking(R, LEGS, noise=noise, seed=3).with_one_reference(HEADING)


def faced(worn: Worn) -> float:
    """Heading, rad, of the person in world during the pose."""
    return facing_of(worn.poses.R_world_bone[0])


def calibrate(worn: Worn, pose: Any, imus: Any = None, **options: Any) -> PoseCalibration:
    """Calibration with known facing."""
    given = {"facing": faced(worn) - HEADING, "still": (0.5, 1.5), **options}
    return calibrate_by_pose(imus or worn.imus, worn.joints, pose, worn.skeleton, **given)


@pytest.mark.parametrize("pose", ["T", "N", "seated"])
def test_an_ideal_pose_with_known_facing_gives_the_planted_calibration(pose: str) -> None:
    worn = posed(pose)
    found = calibrate(worn, pose).calibration
    np.testing.assert_allclose(found.R_sensor_bone, worn.truth.R_sensor_bone, atol=1e-6)
    np.testing.assert_allclose(found.R_world_inertial, np.tile(np.eye(3), (len(LEGS), 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(found.p_bone_sensor, worn.truth.p_bone_sensor)
    of_log = calibrate(worn, pose, worn.log()).calibration
    np.testing.assert_allclose(of_log.R_sensor_bone, found.R_sensor_bone, atol=1e-9)


def test_the_heading_of_the_world_may_be_given() -> None:
    worn = posed()
    found = calibrate(worn, "N", world_facing=faced(worn))
    np.testing.assert_allclose(found.calibration.R_world_inertial, worn.truth.R_world_inertial, atol=1e-6)
    assert found.facing == pytest.approx(faced(worn))


def test_facing_may_be_the_axis_of_a_sensor() -> None:
    worn, s = posed(), LEGS.index("Pelvis")
    forward = worn.truth.R_sensor_bone[s][:, 0]
    column = int(np.argmax(np.abs(forward)))
    sign = -1 if forward[column] < 0 else 1
    found = calibrate(worn, "N", facing=("Pelvis", "-"[: sign < 0] + "xyz"[column]), still=None)
    x, y, _ = sign * worn.imus.R_inertial_sensor[0, s][:, column]
    assert found.facing == pytest.approx(np.arctan2(y, x), abs=1e-3)


@pytest.mark.parametrize("pose", ["T", "N", "seated"])
def test_facing_is_estimated_from_the_walk_that_follows(pose: str) -> None:
    worn = posed(pose, noisy=True)
    found = calibrate(worn, pose, facing=None, still=None)
    off = so3.log(so3.about_axis("z", found.facing - (faced(worn) - HEADING)))
    assert np.degrees(np.abs(off[2])) < 12
    assert found.heading_margin is not None
    assert found.heading_margin > 20
    assert worn.errors_deg(found.calibration).mean() < 12
    assert not found.warnings


def test_own_headings_are_estimated_from_movement() -> None:
    worn = exercising(("L_UpLeg", "L_LowLeg", "Pelvis"))
    found = calibrate_by_pose(worn.imus, worn.joints, "N", worn.skeleton, headings="own")
    assert worn.errors_deg(found.calibration).max() < 6
    assert found.facing == 0.0
    assert all(report.heading_sigma_deg > 0 for report in found.sensors)


def test_a_measured_pose_defines_its_own_world() -> None:
    worn = posed("seated")
    found = calibrate(worn, worn.poses.R_world_bone[0])
    assert found.pose == "measured"
    assert found.sensors[0].expected_deg < 5
    np.testing.assert_allclose(found.calibration.R_world_inertial, worn.truth.R_world_inertial, atol=1e-6)
    R = worn.poses.R_world_bone[0].copy()
    j = worn.skeleton.index("LeftLeg")[0]
    R[j] = R[j] @ so3.exp(np.radians([0.0, 10.0, 0.0]))
    off = so3.angle_between(calibrate(worn, R).calibration.R_sensor_bone, worn.truth.R_sensor_bone)
    np.testing.assert_allclose(np.degrees(off), [0, 0, 10, 0, 0], atol=1e-3)


def test_warnings_name_restless_sensors_and_unobservable_headings() -> None:
    worn = posed()
    sway = so3.about_axis("y", 0.4 * np.sin(1.5 * worn.imus.times)[:, None])
    imus = replace(worn.imus, R_inertial_sensor=worn.imus.R_inertial_sensor @ sway)
    found = calibrate(worn, "N", imus, still=(0.0, 2.0))
    assert "L_UpLeg turned by" in found.warnings[0]
    assert found.sensors[0].spread_deg > 5
    assert "headings (1.0 nats)" in replace(found, heading_margin=1.0).warnings[-1]


def test_levers_are_given_or_usual_or_in_the_middle_of_the_segment() -> None:
    worn = posed()
    found = calibrate(worn, "N", levers={"Pelvis": [0.0, 0.0, 0.1]}).calibration
    np.testing.assert_array_equal(found.p_bone_sensor[LEGS.index("Pelvis")], [0.0, 0.0, 0.1])
    hand = worn.skeleton.table.joints[worn.skeleton.index("LeftHand")[0]]
    found = calibrate_by_pose(worn.imus, {"Pelvis": "LeftHand"}, "N", worn.skeleton, facing=0.0).calibration
    np.testing.assert_allclose(found.p_bone_sensor, hand.end[None] / 2)


@pytest.mark.parametrize(
    "error, message, changes",
    [
        (UnknownNameError, "sensor 'Pelviss'", {"joints": {"Pelviss": "Hips"}}),
        (UnknownNameError, "joint 'Hip'", {"joints": {"Pelvis": "Hip"}}),
        (CalibrationError, "no sensor is mapped", {"joints": {}}),
        (CalibrationError, "mapped to Hips", {"joints": {"Pelvis": "Hips", "L_UpLeg": "Hips"}}),
        (UnknownNameError, "kind of headings", {"headings": "common"}),
        (CalibrationError, "facing", {"headings": "own"}),
        (InvalidInputError, "facing: nan", {"facing": float("nan")}),
        (UnknownNameError, "axis of facing", {"facing": ("Pelvis", "forward")}),
        (UnknownNameError, "sensor of facing", {"facing": ("Head", "x")}),
        (UnknownNameError, "sensor 'Head'", {"levers": {"Head": [0, 0, 0]}}),
        (CalibrationError, "no orientation between 90 and 95 s", {"still": (90.0, 95.0)}),
        (
            CalibrationError,
            "no pose prior",
            {"joints": {"Pelvis": "Hip"}, "skeleton": SkeletonModel.human36m(), "facing": None},
        ),
    ],
)
def test_invalid_arguments_are_refused(error: type[Exception], message: str, changes: dict[str, Any]) -> None:
    worn = posed()
    given = {"joints": worn.joints, "pose": "N", "skeleton": worn.skeleton, "facing": 0.0, **changes}
    with pytest.raises(error, match=message):
        calibrate_by_pose(worn.imus, **given)


def test_a_pose_alone_does_not_determine_headings() -> None:
    worn = posed()
    one, n = worn.imus, 115
    imus = ImuSequence(one.times[:n], one.R_inertial_sensor[:n], one.f_sensor[:n], one.names)
    with pytest.raises(CalibrationError, match="headings are not observable"):
        calibrate(worn, "N", imus, facing=None, still=None)
    found = calibrate(worn, "N", imus, still=None)
    np.testing.assert_allclose(found.calibration.R_sensor_bone, worn.truth.R_sensor_bone, atol=1e-6)
