"""Calibration by a pose, from sensors whose correct calibration is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inertial_support import Worn, exercising, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.inertial.pose_calibration import (
    POSES,
    PoseCalibration,
    calibrate_by_pose,
    facing_of,
    pose_rotations,
    turned_to,
)
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


DOWN, AHEAD = [0, 0, -1], [1, 0, 0]


@pytest.mark.parametrize(
    ("pose", "joint", "direction"),
    [
        ("T", "LeftArm", [0, 1, 0]),
        ("N", "LeftArm", DOWN),
        ("N", "RightForeArm", DOWN),
        ("N", "LeftLeg", DOWN),
        ("seated", "LeftUpLeg", AHEAD),
        ("seated", "RightLeg", DOWN),
        ("seated", "RightArm", DOWN),
    ],
)
def test_limbs_point_where_the_pose_says(
    pose: str, joint: str, direction: list[float], skeleton: SkeletonModel
) -> None:
    R = pose_rotations(pose, skeleton)
    child = next(i for i, p in enumerate(skeleton.parents) if p == skeleton.index(joint)[0])
    bone = R[skeleton.index(joint)[0]] @ so3.unit(skeleton.joint_offsets[child])
    assert bone @ np.array(direction) > 0.95


@pytest.mark.parametrize("pose", POSES)
def test_a_named_pose_faces_x_and_can_be_turned(pose: str, skeleton: SkeletonModel) -> None:
    R = pose_rotations(pose, skeleton)
    assert facing_of(R) == pytest.approx(0.0)
    turned = turned_to(R, 2.0)
    assert facing_of(turned) == pytest.approx(2.0)
    relative = (np.swapaxes(M[:1], -1, -2) @ M for M in (turned, R))
    np.testing.assert_allclose(*relative, atol=1e-12)


SEGMENTS = ("LeftLeg", "Hips")


def stream(still: tuple[float, float], rate: float = 100.0, gyroscope: bool = True, first: float = 0.0) -> SensorStream:
    """A sensor that rotates by 1 rad/s about its z axis except in one interval."""
    times = first + np.arange(0, 10, 1 / rate)
    speed = np.where((times >= still[0]) & (times < still[1]), 0.0, 1.0)
    R = so3.about_axis("z", np.cumsum(speed) / rate)
    return SensorStream("s", times, None, R, speed[:, None] * [0, 0, 1] if gyroscope else None)


def held(*streams: SensorStream) -> tuple[float, float]:
    """Interval in which the pose is held."""
    named = tuple(
        SensorStream(name, s.times, None, s.R_inertial_sensor, s.w_sensor)
        for name, s in zip("ab", streams, strict=False)
    )
    log = SensorLog(Path("log"), "planted", named, Declaration())
    joints = dict(zip("ab", SEGMENTS[: len(streams)], strict=False))
    return calibrate_by_pose(log, joints, "N", SkeletonModel.default(), facing=0.0).still


@pytest.mark.parametrize("gyroscope", [True, False])
def test_the_first_second_in_which_all_are_still_is_found(gyroscope: bool) -> None:
    start, stop = held(stream((2.0, 6.0), gyroscope=gyroscope), stream((3.0, 8.0), 61.0, gyroscope))
    assert start == pytest.approx(3.3, abs=0.1)
    assert stop == pytest.approx(5.7, abs=0.1)
    start, stop = held(stream((4.0, 5.1), gyroscope=gyroscope))
    assert (start, stop) == (pytest.approx(4.05, abs=0.06), pytest.approx(5.05, abs=0.06))


def test_gaps_short_pauses_and_separate_sensors_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"even around 4\.\d\d s sensors turn at .* deg/s, a most"):
        held(stream((4.0, 4.6)), stream((0.0, 10.0)))
    with pytest.raises(CalibrationError, match="have 0 s in common"):
        held(stream((0.0, 10.0)), stream((100.0, 110.0), first=100.0))
    whole = stream((20.0, 30.0), gyroscope=False)
    keep = (whole.times < 4) | (whole.times > 7)
    with pytest.raises(CalibrationError, match="without rotation"):
        held(SensorStream("a", whole.times[keep], None, whole.R_inertial_sensor[keep]))


def test_invalid_poses_are_refused(skeleton: SkeletonModel) -> None:
    with pytest.raises(UnknownNameError, match="unknown calibration pose 'TT'.*Known: T, N, seated"):
        pose_rotations("TT", skeleton)
    with pytest.raises(InvalidInputError, match=r"expected shape \(21, 3, 3\)"):
        pose_rotations(np.eye(3), skeleton)
    measured = so3.exp(np.random.default_rng(0).standard_normal((21, 3)))
    np.testing.assert_array_equal(pose_rotations(measured, skeleton), measured)
    R = np.tile(np.eye(3), (21, 1, 1))
    R[4] = np.nan
    with pytest.raises(InvalidInputError, match="Spine3"):
        pose_rotations(R, skeleton)
    lying = np.tile(so3.about_axis("y", np.pi / 2), (21, 1, 1))
    with pytest.raises(InvalidInputError, match="vertical"):
        facing_of(lying)
