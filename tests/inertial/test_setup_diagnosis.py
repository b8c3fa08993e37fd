"""Planted faults of a sensor setup are found, named, and corrected on request."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inertial_support import Worn, exercising, free, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.inertial.pose_calibration import calibrate_by_pose, calibrated
from rtof_kin.inertial.setup_diagnosis import Fault, FaultKind, diagnose_setup
from rtof_kin.simulation.noise import ImuNoise

SENSORS = ("L_UpArm", "L_LowArm", "L_UpLeg", "L_LowLeg", "R_UpLeg", "R_LowLeg", "Pelvis")
SQUATS = Path(__file__).parents[1] / "fixtures" / "inertial" / "xsens_dot_squats" / "squats.npz"
MISALIGNED = replace(ImuNoise(), misalignment_deg=6.0)


@cache
def moving(kind: str = "free") -> Worn:
    make = {"walk": walking, "exercise": exercising, "free": free}[kind]
    return make(sensors=SENSORS, noise=MISALIGNED, seed=5)


def found(worn: Worn, wrong: ImuCalibration) -> tuple[Fault, ...]:
    bone_imus = wrong.apply(worn.imus.select(wrong.sensors))
    before = bone_imus.R_world_bone.copy()
    faults = diagnose_setup(bone_imus, worn.skeleton)
    np.testing.assert_array_equal(bone_imus.R_world_bone, before)
    return faults


def turned(good: ImuCalibration, joint: str, axis: str, degrees: float) -> ImuCalibration:
    """A sensor that is turned on its segment after the calibration."""
    R = good.R_sensor_bone.copy()
    s = good.joints.index(joint)
    R[s] = R[s] @ so3.about_axis(axis, np.radians(degrees))
    return replace(good, R_sensor_bone=R)


def exchanged(good: ImuCalibration, a: str, b: str) -> ImuCalibration:
    """Sensors declared on each other's segments, calibrated in a T-pose, where all frames are alike."""
    joints = tuple({a: b, b: a}.get(j, j) for j in good.joints)
    levers = dict(zip(good.joints, good.p_bone_sensor, strict=True))
    return replace(good, joints=joints, p_bone_sensor=np.array([levers[j] for j in joints]))


@pytest.mark.parametrize("kind", ["walk", "exercise", "free"])
def test_a_correct_setup_has_no_faults(kind: str) -> None:
    assert found(moving(kind), moving(kind).truth) == ()


def facing(good: ImuCalibration, degrees: float) -> ImuCalibration:
    """The person faced another way in the pose."""
    return replace(good, R_sensor_bone=good.R_sensor_bone @ so3.about_axis("z", np.radians(-degrees)))


@pytest.mark.parametrize(
    ("motion", "wrong", "kind", "what"),
    [
        *((m, (facing, a), FaultKind.FACING, f"{abs(a)} degrees") for m, a in (("walk", 90), ("walk", -90))),
        *((m, (facing, 180), FaultKind.FACING, "180 degrees") for m in ("walk", "exercise")),
        *(
            (
                "free",
                (turned, *o, -a),
                FaultKind.MOUNTING,
                f"{o[0]} sits turned by {a} degrees about the segment's {o[1]}",
            )
            for *o, a in (
                ("LeftUpLeg", "x", 90),
                ("LeftUpLeg", "z", 180),
                ("LeftForeArm", "y", -90),
                ("RightLeg", "y", 180),
            )
        ),
        *(
            ("free", (exchanged, *o), k, f"the sensors of {o[0]} and {o[1]} are swapped (log-likelihood ratio ")
            for *o, k in (
                ("LeftUpLeg", "RightUpLeg", FaultKind.SIDES),
                ("LeftLeg", "RightLeg", FaultKind.SIDES),
                ("LeftUpLeg", "LeftLeg", FaultKind.NEIGHBOURS),
                ("LeftArm", "LeftForeArm", FaultKind.NEIGHBOURS),
            )
        ),
    ],
)
def test_a_planted_fault_is_found_and_corrected(
    motion: str, wrong: tuple[Any, ...], kind: FaultKind, what: str
) -> None:
    truth, (make, *options) = moving(motion).truth, wrong
    made = make(truth, *options)
    (fault,) = found(moving(motion), made)
    assert fault.kind is kind
    assert what in str(fault)
    assert fault.log_likelihood_ratio > 10
    mended = fault.corrected(made).select(truth.sensors)
    assert mended.joints == truth.joints
    if make is not exchanged:  # the joint frames differ but in a T-pose
        for name in ("R_sensor_bone", "R_world_inertial"):
            assert so3.angle_between(getattr(mended, name), getattr(truth, name)).max() < 1e-6
        np.testing.assert_array_equal(mended.p_bone_sensor, truth.p_bone_sensor)
    else:
        with pytest.raises(CalibrationError, match=f"no sensor on .*{options[0]}"):
            fault.corrected(truth.select(("Pelvis",)))


def test_a_sensor_on_another_segment_is_found() -> None:
    worn = moving("exercise")
    truth = worn.truth.select(tuple(s for s in SENSORS if s != "L_UpLeg"))
    wrong = replace(truth, joints=tuple("LeftUpLeg" if j == "LeftLeg" else j for j in truth.joints))
    (fault,) = found(worn, wrong)
    assert fault.kind is FaultKind.SEGMENT
    assert "declared on LeftUpLeg sits on LeftLeg" in str(fault)
    np.testing.assert_array_equal(fault.corrected(wrong).p_bone_sensor, truth.p_bone_sensor)


def test_sensors_swapped_before_the_pose_are_found() -> None:
    worn = moving("exercise")
    swap = {"L_UpArm": "LeftForeArm", "L_LowArm": "LeftArm"}
    imus = worn.with_one_reference(0.0).imus
    wrong = calibrate_by_pose(imus, {**worn.joints, **swap}, "N", worn.skeleton, facing=0.0).calibration
    (fault,) = diagnose_setup(wrong.apply(imus), worn.skeleton, pose="N", most=1)
    assert fault.kind is FaultKind.NEIGHBOURS
    assert fault.corrected(wrong).joints == worn.truth.joints


def test_gaps_are_no_fault_and_a_short_movement_is_refused() -> None:
    worn = moving()
    R, f = worn.imus.R_inertial_sensor.copy(), worn.imus.f_sensor.copy()
    R[200:260, 1], f[400:500] = np.nan, np.nan
    imus = type(worn.imus)(worn.imus.times, R, f, worn.imus.names)
    assert diagnose_setup(worn.truth.apply(imus), worn.skeleton) == ()
    with pytest.raises(InvalidInputError, match="too short"):
        diagnose_setup(worn.truth.apply(worn.imus)[:20], worn.skeleton)


def test_swapped_names_of_a_real_recording_are_found(skeleton: SkeletonModel) -> None:
    arrays = np.load(SQUATS)
    names = ("Pelvis", "LFemur", "LTibia", "RFemur", "RTibia")
    streams = []
    for name in names:
        quat, f = (arrays[f"{name}_{field}"].astype(float) for field in ("quat_wxyz", "f_sensor"))
        streams.append(SensorStream(name, arrays[f"{name}_times"], f, so3.from_quat_wxyz(quat)))
    log = SensorLog(SQUATS, "Movella DOT", tuple(streams), Declaration())
    right = ("Hips", "LeftLeg", "LeftUpLeg", "RightUpLeg", "RightLeg")
    as_filed = ("Hips", "LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg")
    for segments, expected in ((right, []), (as_filed, ["the sensors of LeftUpLeg and LeftLeg are swapped"])):
        own = calibrate_by_pose(log, dict(zip(names, segments, strict=True)), "N", skeleton).calibration
        faults = diagnose_setup(calibrated(log, own), skeleton, pose="N")
        assert [fault.what for fault in faults] == expected
