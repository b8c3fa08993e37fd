"""Calibration by movement, from exercises whose sensors are known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from inertial_support import Worn, exercising

from benchmarks.held import movements
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.inertial.functional import Movement, calibrate_by_movement

SENSORS = ("L_UpArm", "L_LowArm", "L_UpLeg", "L_LowLeg", "R_UpLeg", "R_LowLeg", "Sternum")
DONE = movements(4.0)


@cache
def exercised(seed: int) -> Worn:
    return exercising(SENSORS, seed)


def done(*joints: str) -> list[Movement]:
    return [movement for movement in DONE if movement.joint in joints]


ALL = done("LeftLeg", "RightLeg", "LeftForeArm", "Spine3")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("headings", ["shared", "own"])
def test_movements_give_the_planted_calibration(seed: int, headings: str) -> None:
    worn = exercised(seed)
    worn = worn.with_one_reference(-2.0) if headings == "shared" else worn
    found = calibrate_by_movement(worn.imus, worn.joints, ALL, worn.skeleton, headings=headings)  # type: ignore[arg-type]
    off = np.degrees(so3.angle_between(found.calibration.R_sensor_bone, worn.truth.R_sensor_bone))
    assert off.max() < 14
    assert off.mean() < 7
    assert worn.errors_deg(found.calibration).max() < 14


def test_shared_headings_are_one_and_own_ones_follow_each_sensor() -> None:
    worn = exercised(0)
    one = worn.with_one_reference(0.7)
    shared = calibrate_by_movement(one.imus, worn.joints, ALL, worn.skeleton).calibration
    np.testing.assert_allclose(shared.R_world_inertial, shared.R_world_inertial[:1].repeat(7, axis=0))
    own = calibrate_by_movement(worn.imus, worn.joints, ALL, worn.skeleton, headings="own").calibration
    off = so3.angle_between(own.R_world_inertial, worn.truth.R_world_inertial)
    assert np.degrees(off).max() < 14


def test_a_person_who_stands_with_legs_turned_out_is_calibrated_all_the_same() -> None:
    """What the pose gets wrong about the vertical the movement gets right."""
    worn = exercised(1).with_one_reference(0.0)
    j = worn.skeleton.index("LeftUpLeg", "LeftLeg", "LeftFoot")
    out = so3.about_axis("z", np.radians(25.0))
    sensors = [worn.imus.names.index(name) for name in ("L_UpLeg", "L_LowLeg")]
    R = worn.imus.R_inertial_sensor.copy()
    R[:, sensors] = out @ R[:, sensors]  # the whole leg, all the time
    imus = type(worn.imus)(worn.imus.times, R, worn.imus.f_sensor, worn.imus.names)
    assert len(j) == 3
    found = calibrate_by_movement(imus, worn.joints, ALL, worn.skeleton).calibration
    off = np.degrees(so3.angle_between(found.R_sensor_bone, worn.truth.R_sensor_bone))
    assert off[sensors].max() < 10


def test_each_sensor_alone_is_calibrated_by_its_own_turning() -> None:
    worn = exercised(2)
    joints = {"L_LowArm": "LeftForeArm"}  # no upper arm: no hinge
    found = calibrate_by_movement(
        worn.imus, joints, done("LeftForeArm"), worn.skeleton, headings="own"
    ).calibration
    s = SENSORS.index("L_LowArm")
    assert np.degrees(so3.angle_between(found.R_sensor_bone[0], worn.truth.R_sensor_bone[s])) < 12


def test_a_log_gives_the_same_as_a_sequence() -> None:
    worn = exercised(0)
    of_log, of_sequence = (
        calibrate_by_movement(
            imus, worn.joints, ALL, worn.skeleton, headings="own", still=(0.5, 1.5)
        ).calibration
        for imus in (worn.log(), worn.imus)
    )
    off = so3.angle_between(of_log.R_sensor_bone, of_sequence.R_sensor_bone)
    assert np.degrees(off).max() < 0.5


def test_what_cannot_be_is_refused() -> None:
    worn = exercised(0)

    def refused(error: type[Exception], message: str, *moved: Movement, **options: object) -> None:
        with pytest.raises(error, match=message):
            calibrate_by_movement(worn.imus, worn.joints, moved, worn.skeleton, **options)  # type: ignore[arg-type]

    knee = DONE[0]
    refused(CalibrationError, "no movement tells the heading of .*LeftForeArm", knee, headings="own")
    refused(CalibrationError, "no movement tells the heading")
    refused(UnknownNameError, "unknown kind of headings", knee, headings="one")
    refused(UnknownNameError, "unknown joint 'Knee'", Movement("Knee", 2, 6))
    refused(CalibrationError, "movement of RightArm: no sensor is mapped", Movement("RightArm", 2, 6))
    refused(CalibrationError, "fewer than ten samples", Movement("LeftLeg", 200, 206))
    refused(CalibrationError, "hardly|rad/s only; bend the joint more", Movement("LeftLeg", 0.2, 1.8))
    refused(CalibrationError, "rad/s only; move it more", Movement("Spine3", 0.2, 1.8))
    with pytest.raises(ShapeError, match="from 2 to 2.2 s is too short"):
        Movement("LeftLeg", 2, 2.2)


def test_stirring_about_all_axes_is_no_flexion() -> None:
    worn = exercised(0)
    t = worn.imus.times
    s = SENSORS.index("Sternum")
    R = worn.imus.R_inertial_sensor.copy()
    stirred = so3.exp(np.stack([np.sin(5 * t), np.sin(7 * t), np.sin(6 * t)], -1) * (t > 2.5)[:, None])
    R[:, s] = R[0, s] @ stirred
    imus = type(worn.imus)(worn.imus.times, R, worn.imus.f_sensor, worn.imus.names)
    with pytest.raises(CalibrationError, match="Spine3: only .* % of its turning is about one axis"):
        calibrate_by_movement(imus, worn.joints, [Movement("Spine3", 3, 9)], worn.skeleton)
