"""Planted stuck, saturated and disagreeing samples are found and removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import Verdict
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.inertial.outlier_rejection import check_form, find_disagreements, reject_imu_outliers

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
MOTION = planted.human(BODY, 180)
T = 180


def imus(seed: int = 0, size: float = 4.0, rate_hz: float = 60.0) -> ImuSequence:
    """Three sensors that are alive, with strong movement."""
    rng = np.random.default_rng(seed)
    R = so3.exp(np.cumsum(0.02 * rng.standard_normal((T, 3, 3)), axis=0))
    f = size * rng.standard_normal((T, 3, 3)) + [0.0, 0.0, 9.81]
    return ImuSequence(np.arange(T) / rate_hz, R, f, ("a", "b", "c"))


def stuck(own: ImuSequence, s: int, frames: slice) -> ImuSequence:
    R, f = own.R_inertial_sensor.copy(), own.f_sensor.copy()
    R[frames, s], f[frames, s] = R[frames.start, s], f[frames.start, s]
    return replace(own, R_inertial_sensor=R, f_sensor=f)


def spiked(own: ImuSequence) -> ImuSequence:
    f = own.f_sensor.copy()
    f[[30, 60, 90], 0, 0] = 50.0
    return replace(own, f_sensor=f)


@pytest.mark.parametrize(
    "own",
    [
        imus(),
        stuck(imus(), 1, slice(60, 64)),  # a packet that came twice
        stuck(imus(), 2, slice(0, T)),  # simulated at rest
        replace(imus(), f_sensor=np.clip(imus().f_sensor, -10.0, 10.0)),
        replace(imus(), f_sensor=np.clip(imus().f_sensor, -14.0, 14.0)),
        spiked(imus()),
    ],
)
def test_correct_sensors_are_returned_unchanged(own: ImuSequence) -> None:
    again, faults = reject_imu_outliers(own)
    assert again is own
    assert faults == ()


def test_repeated_samples_are_removed() -> None:
    own = imus()
    mended, (fault,) = reject_imu_outliers(stuck(own, 1, slice(60, 100)))
    assert fault == StreamFault(FaultKind.STUCK, "b", own.times[61], own.times[99])
    assert np.isnan(mended.R_inertial_sensor[61:100, 1]).all()
    assert np.isnan(mended.f_sensor[61:100, 1]).all()
    np.testing.assert_array_equal(mended.f_sensor[:61], own.f_sensor[:61])
    np.testing.assert_array_equal(mended.f_sensor[:, [0, 2]], own.f_sensor[:, [0, 2]])
    assert len(reject_imu_outliers(stuck(imus(), 2, slice(0, T - 1)))[1]) == 1


def test_saturated_accelerations_are_removed_with_their_neighbours() -> None:
    own = imus()
    f = own.f_sensor.copy()
    f[50:56, 0, 2] = 40.0
    f = np.clip(f, -30.0, 30.0)
    mended, faults = reject_imu_outliers(replace(own, f_sensor=f))
    assert {(x.kind, x.what) for x in faults} == {(FaultKind.SATURATED, "a")}
    gone = np.isnan(mended.f_sensor[:, 0]).all(axis=1)
    assert gone[46:60].all()
    assert not gone[:45].any()
    np.testing.assert_array_equal(mended.R_inertial_sensor, own.R_inertial_sensor)
    # A gap of that length is not bridged when the sensors are brought to the video's times.
    assert own.times[60] - own.times[45] > 0.1


def sensors(degrees: float = 3.0) -> BoneImuSequence:
    return planted.bone_imus(BODY, MOTION.poses, degrees=degrees)


def turned(own: BoneImuSequence, joint: str, frames: slice, turn: Array) -> BoneImuSequence:
    R = own.R_world_bone.copy()
    R[frames, own.joints.index(joint)] @= turn
    return replace(own, R_world_bone=R)


def across(joint: str, child: str, degrees: float) -> Array:
    bone = BODY.joint_offsets[BODY.names.index(child)]
    axis = so3.unit(np.cross(bone, [0.3, 0.5, 0.7]))
    return so3.exp(np.radians(degrees) * axis)


BONE = so3.unit(BODY.joint_offsets[BODY.names.index("LeftHand")])


@pytest.mark.parametrize(
    "own",
    [
        sensors(3.0),
        turned(sensors(1.0), "LeftForeArm", slice(60, None), so3.exp(np.radians(40.0) * BONE)),
        turned(sensors(), "LeftLeg", slice(60, 70), across("LeftLeg", "LeftFoot", 60.0)),
        replace(sensors(), R_world_bone=np.full_like(sensors().R_world_bone, np.nan)),
    ],
    ids=["usual errors", "soft tissue", "a few frames", "no data"],
)
def test_small_or_short_differences_are_no_disagreements(own: BoneImuSequence) -> None:
    assert find_disagreements(MOTION.poses, own, BODY) == ()


def test_disagreements_have_beginning_and_end() -> None:
    turn = across("LeftForeArm", "LeftHand", 25.0)
    (fault,) = find_disagreements(MOTION.poses, turned(sensors(), "LeftForeArm", slice(60, 120), turn), BODY)
    assert (fault.kind, fault.what) == (FaultKind.DISAGREES, "LeftForeArm")
    assert fault.start == pytest.approx(1.0, abs=0.1)
    assert fault.stop == pytest.approx(2.0, abs=0.1)


def test_a_mistake_that_only_one_of_many_sensors_would_have_by_chance_is_not_named() -> None:
    quarter, leaning = so3.about_axis("x", np.pi / 2), so3.about_axis("y", np.radians(3.5))
    R = np.tile([leaning, quarter, quarter], (2400, 1, 1, 1))
    right = np.swapaxes(R, -1, -2) @ [0.0, 0.0, 9.81] + 0.05 * np.random.default_rng(0).standard_normal((2400, 3, 3))
    chance = right.copy()
    chance[:, 0] = leaning @ [0.0, 0.0, 9.81] + 0.05 * np.random.default_rng(1).standard_normal((2400, 3))
    times, worlds, names = np.arange(2400) / 60.0, np.tile(np.eye(3), (3, 1, 1)), ("a", "b", "c")
    one = check_form(ImuSequence(times, R, chance, names), worlds)[1]  # 1.2 m/s2 off, none with the inverse
    every = check_form(ImuSequence(times, np.swapaxes(R, -1, -2), right, names), worlds)[1]
    assert one.verdict is Verdict.NOT_POSSIBLE
    assert "a: 1.2 m/s2, more than usual" in one.advice
    assert every.subject == "all sensors"
    assert "inverted" in every.cause
