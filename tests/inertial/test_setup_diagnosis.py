"""Faults of a sensor setup, planted one by one: found, named, and repaired on request."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from inertial_support import Worn, exercising, free, walking
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, ShapeError
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial.alignment import calibrated
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.setup_diagnosis import FaultKind, diagnose_setup
from rtof_kin.simulation.noise import ImuNoise

Array = NDArray[np.float64]
SENSORS = ("L_UpArm", "L_LowArm", "L_UpLeg", "L_LowLeg", "R_UpLeg", "R_LowLeg", "Pelvis")
SQUATS = Path(__file__).parents[1] / "fixtures" / "inertial" / "xsens_dot_squats" / "squats.npz"
MISALIGNED = replace(ImuNoise(), misalignment_deg=6.0)


@cache
def moving(kind: str) -> Worn:
    """Somebody walks, exercises one joint after another, or all at once, with sensors as they are."""
    make = {"walk": walking, "exercise": exercising, "free": free}[kind]
    return make(sensors=SENSORS, noise=MISALIGNED, seed=5)


def turned(good: ImuCalibration, joint: str, R_bone: Array) -> ImuCalibration:
    """A sensor that sits turned on its segment against what its calibration says."""
    R = good.R_sensor_bone.copy()
    s = good.joints.index(joint)
    R[s] = R[s] @ R_bone
    return replace(good, R_sensor_bone=R)


def exchanged(good: ImuCalibration, *pairs: tuple[str, str]) -> ImuCalibration:
    """Sensors declared on each other's segments, calibrated in a T-pose, where all frames are alike."""
    other = {**dict(pairs), **{b: a for a, b in pairs}}
    joints = tuple(other.get(j, j) for j in good.joints)
    levers = dict(zip(good.joints, good.p_bone_sensor, strict=True))
    return replace(good, joints=joints, p_bone_sensor=np.array([levers[j] for j in joints]))


@pytest.mark.parametrize("kind", ["walk", "exercise", "free"])
def test_nothing_is_said_of_a_good_setup(kind: str) -> None:
    worn = moving(kind)
    assert diagnose_setup(worn.truth.apply(worn.imus), worn.skeleton) == ()


@pytest.mark.parametrize(("kind", "angle"), [("walk", 90), ("walk", -90), ("walk", 180), ("exercise", 180)])
def test_a_person_who_faced_elsewhere_in_the_pose_is_found(kind: str, angle: int) -> None:
    worn = moving(kind)
    wrong = replace(
        worn.truth, R_sensor_bone=worn.truth.R_sensor_bone @ so3.about_axis("z", np.radians(-angle))
    )
    found = diagnose_setup(wrong.apply(worn.imus), worn.skeleton)
    assert [fault.kind for fault in found] == [FaultKind.FACING]
    off = so3.angle_between(found[0].corrected(wrong).R_sensor_bone, worn.truth.R_sensor_bone)
    assert off.max() < 1e-6
    assert f"{abs(angle)} degrees" in str(found[0])


@pytest.mark.parametrize(
    ("joint", "axis", "angle"),
    [
        ("LeftUpLeg", "x", 90), ("LeftUpLeg", "z", 180), ("LeftForeArm", "y", -90), ("RightLeg", "y", 180)
    ],
)  # fmt: skip
def test_a_sensor_that_sits_turned_is_found(joint: str, axis: str, angle: int) -> None:
    worn = moving("free")
    wrong = turned(worn.truth, joint, so3.about_axis(axis, np.radians(-angle)))
    found = diagnose_setup(wrong.apply(worn.imus), worn.skeleton)
    assert [fault.kind for fault in found] == [FaultKind.MOUNTING]
    said = f"the sensor on {joint} sits turned by {angle} degrees about the segment's {axis} axis"
    assert said in str(found[0])
    off = so3.angle_between(found[0].corrected(wrong).R_sensor_bone, worn.truth.R_sensor_bone)
    assert off.max() < 1e-6


@pytest.mark.parametrize(
    ("pair", "kind"),
    [
        (("LeftUpLeg", "RightUpLeg"), FaultKind.SIDES),
        (("LeftLeg", "RightLeg"), FaultKind.SIDES),
        (("LeftUpLeg", "LeftLeg"), FaultKind.NEIGHBOURS),
        (("LeftArm", "LeftForeArm"), FaultKind.NEIGHBOURS),
    ],
)  # fmt: skip
def test_two_swapped_sensors_are_found(pair: tuple[str, str], kind: FaultKind) -> None:
    worn = moving("free")
    wrong = exchanged(worn.truth, pair)
    found = diagnose_setup(wrong.apply(worn.imus), worn.skeleton)
    assert [fault.kind for fault in found] == [kind]
    assert f"the sensors of {pair[0]} and {pair[1]} are swapped" in str(found[0])
    assert found[0].corrected(wrong).joints == worn.truth.joints


def test_a_sensor_on_another_segment_is_found() -> None:
    worn = moving("exercise")
    three = worn.truth.select(tuple(s for s in SENSORS if s != "L_UpLeg"))
    wrong = replace(three, joints=tuple("LeftUpLeg" if j == "LeftLeg" else j for j in three.joints))
    imus = worn.imus.select(three.sensors)
    found = diagnose_setup(wrong.apply(imus), worn.skeleton)
    assert [fault.kind for fault in found] == [FaultKind.SEGMENT]
    assert "the sensor declared on LeftUpLeg sits on LeftLeg" in str(found[0])
    np.testing.assert_array_equal(found[0].corrected(wrong).p_bone_sensor, three.p_bone_sensor)


def test_two_faults_are_found_one_after_the_other() -> None:
    worn = moving("free")
    wrong = turned(worn.truth, "LeftForeArm", so3.about_axis("y", np.pi))
    wrong = exchanged(wrong, ("LeftLeg", "RightLeg"))
    found = diagnose_setup(wrong.apply(worn.imus), worn.skeleton)
    assert {fault.kind for fault in found} == {FaultKind.MOUNTING, FaultKind.SIDES}
    for fault in found:
        wrong = fault.corrected(wrong)
    assert wrong.joints == worn.truth.joints
    assert so3.angle_between(wrong.R_sensor_bone, worn.truth.R_sensor_bone).max() < 1e-6


def test_a_mapping_that_swapped_arm_and_forearm_before_an_n_pose_is_found() -> None:
    """Through the real order of events: a wrong mapping, a calibration by it, then movement."""
    worn = moving("exercise")
    swap = {"L_UpArm": "LeftForeArm", "L_LowArm": "LeftArm"}
    imus = worn.with_one_reference(0.0).imus
    found = calibrate_by_pose(imus, {**worn.joints, **swap}, "N", worn.skeleton, facing=0.0)
    faults = diagnose_setup(found.calibration.apply(imus), worn.skeleton, pose="N", most=1)
    assert [fault.kind for fault in faults] == [FaultKind.NEIGHBOURS]
    repaired = faults[0].corrected(found.calibration)
    assert dict(zip(repaired.sensors, repaired.joints, strict=True)) == worn.joints


def test_what_a_camera_saw_tells_how_the_world_is_turned() -> None:
    worn = moving("walk")
    turn = so3.about_axis("z", np.radians(-90))
    wrong = replace(worn.truth, R_world_inertial=turn @ worn.truth.R_world_inertial)
    bone_imus = wrong.apply(worn.imus)
    assert diagnose_setup(bone_imus, worn.skeleton) == ()
    found = diagnose_setup(bone_imus, worn.skeleton, visual=worn.poses)
    assert [fault.kind for fault in found] == [FaultKind.WORLD]
    off = so3.angle_between(found[0].corrected(wrong).R_world_inertial, worn.truth.R_world_inertial)
    assert off.max() < 1e-6
    assert diagnose_setup(worn.truth.apply(worn.imus), worn.skeleton, visual=worn.poses) == ()


def test_nothing_is_repaired_unasked_and_the_ratio_is_stated() -> None:
    worn = moving("free")
    wrong = exchanged(worn.truth, ("LeftLeg", "RightLeg"))
    bone_imus = wrong.apply(worn.imus)
    before = bone_imus.R_world_bone.copy()
    fault = diagnose_setup(bone_imus, worn.skeleton)[0]
    np.testing.assert_array_equal(bone_imus.R_world_bone, before)
    assert fault.log_likelihood_ratio > 10
    assert f"(log-likelihood ratio {fault.log_likelihood_ratio:.0f}" in str(fault)
    assert str(fault).endswith("Swap the two names, or the sensors, and calibrate again.")


def test_a_fault_of_other_sensors_cannot_be_corrected() -> None:
    worn = moving("free")
    wrong = exchanged(worn.truth, ("LeftLeg", "RightLeg"))
    fault = diagnose_setup(wrong.apply(worn.imus), worn.skeleton)[0]
    with pytest.raises(CalibrationError, match="has no sensor on LeftLeg, RightLeg"):
        fault.corrected(worn.truth.select(("Pelvis",)))


def test_gaps_in_the_data_are_no_fault() -> None:
    worn = moving("free")
    R, f = worn.imus.R_inertial_sensor.copy(), worn.imus.f_sensor.copy()
    R[200:260, 1], f[400:500] = np.nan, np.nan
    imus = type(worn.imus)(worn.imus.times, R, f, worn.imus.names)
    assert diagnose_setup(worn.truth.apply(imus), worn.skeleton) == ()


def test_half_a_second_is_too_short_to_judge() -> None:
    worn = moving("walk")
    with pytest.raises(ShapeError, match="too short to judge a movement by"):
        diagnose_setup(worn.truth.apply(worn.imus)[:20], worn.skeleton)


def real_squats() -> SensorLog:
    """A real recording, whose files of the left leg are named the wrong way round."""
    arrays = np.load(SQUATS)
    streams = []
    for name in ("Pelvis", "LFemur", "LTibia", "RFemur", "RTibia"):
        quat, f = (arrays[f"{name}_{field}"].astype(float) for field in ("quat_wxyz", "f_sensor"))
        streams.append(SensorStream(name, arrays[f"{name}_times"], f, so3.from_quat_wxyz(quat)))
    return SensorLog(SQUATS, "Movella DOT", tuple(streams), Declaration())


def test_the_swapped_names_of_a_real_recording_are_found_and_its_right_leg_is_left_alone(
    skeleton: SkeletonModel,
) -> None:
    log = real_squats()
    named = {
        "Pelvis": "Hips", "LFemur": "LeftUpLeg", "LTibia": "LeftLeg", "RFemur": "RightUpLeg",
        "RTibia": "RightLeg",
    }  # fmt: skip
    found = calibrate_by_pose(log, named, "N", skeleton)
    faults = diagnose_setup(calibrated(log, found.calibration), skeleton, pose="N")
    assert [fault.what for fault in faults] == ["the sensors of LeftUpLeg and LeftLeg are swapped"]
    right = {**named, "LFemur": "LeftLeg", "LTibia": "LeftUpLeg"}
    found = calibrate_by_pose(log, right, "N", skeleton)
    assert diagnose_setup(calibrated(log, found.calibration), skeleton, pose="N") == ()
