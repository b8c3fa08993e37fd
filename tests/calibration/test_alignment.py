"""Tests of `rtof_kin.calibration.alignment`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clocks_support import filmed, joints, shifted, skeleton, worn

from rtof_kin.body.skeleton import Motion
from rtof_kin.calibration.alignment import Alignment, align_sensors
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.calibration.straight_legs import NEVER_STILL
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, ViewError
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import wrapped
from rtof_kin.recording.recording import Recording

SIX = ("L_UpArm", "L_LowArm", "R_LowArm", "L_UpLeg", "R_LowLeg", "Sternum")


def headings_off_deg(found: Alignment, truth: ImuCalibration) -> np.ndarray:
    wanted = np.array([so3.heading(R) for R in truth.R_world_inertial])
    return np.abs(np.degrees(wrapped(np.array([s.heading for s in found.sensors]) - wanted)))


def turned(log: SensorLog, truth: ImuCalibration, headings: np.ndarray) -> tuple[SensorLog, ImuCalibration]:
    """The same sensors with other references."""
    R_world_inertial = so3.about_axis("z", headings)
    streams = []
    for s, stream in enumerate(log.streams):
        assert stream.R_inertial_sensor is not None
        R = R_world_inertial[s].T @ truth.R_world_inertial[s] @ stream.R_inertial_sensor
        streams.append(replace(stream, R_inertial_sensor=R))
    return replace(log, streams=tuple(streams)), replace(truth, R_world_inertial=R_world_inertial)


def test_heading_and_mounting_of_each_sensor_are_found() -> None:
    motion = planted.moving(skeleton(), 600, radians=0.5)
    log, truth = worn(motion, sensors=SIX)
    found = align_sensors(*filmed(motion, 0.0, 9.0), log, joints(truth), skeleton())
    assert headings_off_deg(found, truth).max() < 5.0
    mounting = np.degrees(so3.angle_between(found.calibration.R_sensor_bone, truth.R_sensor_bone))
    assert mounting.max() < 6.0
    assert found.calibration.joints == truth.joints
    assert not found.shared_reference


def test_a_shared_reference_is_recognised_and_used_for_all() -> None:
    motion = planted.moving(skeleton(), 600, radians=0.5)
    log, truth = turned(*worn(motion, sensors=SIX), 1.2 + np.radians([0.0, 4.0, -3.0, 2.0, 5.0, -4.0]))
    found = align_sensors(*filmed(motion, 0.0, 9.0), log, joints(truth), skeleton())
    assert found.shared_reference
    assert len({round(sensor.heading, 9) for sensor in found.sensors}) == 1
    assert headings_off_deg(found, truth).max() < 8.0


def test_a_segment_that_does_not_move_is_in_doubt() -> None:
    motion = planted.standing(skeleton(), 600)
    log, truth = worn(motion)
    found = align_sensors(*filmed(motion, 0.0, 9.0), log, joints(truth), skeleton())
    assert all("hardly determines its heading" in sensor.doubt for sensor in found.sensors)
    assert found.warnings == (f"sensor {', '.join(log.names)}: {found.sensors[0].doubt}",)


def test_turns_about_the_vertical_alone_leave_the_heading_open() -> None:
    motion = planted.standing(skeleton(), 600)
    turn = so3.about_axis("z", planted.smooth_noise(0, (600,), 60, 1.0))
    poses = motion.poses
    R = turn[:, None] @ poses.R_world_bone
    p = np.einsum("tij,tkj->tki", turn, poses.p_world_joint)
    motion = replace(motion, poses=poses.with_poses(slice(None), p, R))
    log, truth = worn(motion)
    found = align_sensors(*filmed(motion, 0.0, 9.0), log, joints(truth), skeleton())
    assert all(sensor.doubt for sensor in found.sensors)


def test_sensors_on_another_clock_have_nothing_in_common() -> None:
    motion = planted.moving(skeleton(), 600)
    log, truth = worn(motion)
    with pytest.raises(CalibrationError, match=r"less than 2 s in common; find the clock first"):
        align_sensors(*filmed(motion, 0.0, 9.0), shifted(log, 500.0), joints(truth), skeleton())


def test_a_segment_that_is_hardly_seen_names_its_sensor() -> None:
    motion = planted.moving(skeleton(), 600)
    log, truth = worn(motion)
    poses, keypoints = filmed(motion, 0.0, 9.0)
    with pytest.raises(CalibrationError, match="sensor L_LowArm: its segment is seen for less"):
        seen = planted.unseen(keypoints, slice(30, None))
        align_sensors(poses, seen, log, joints(truth), skeleton())


def test_without_refinement_everything_is_in_doubt_and_a_warning_says_why() -> None:
    def fails(*_: object) -> SelfCalibration:
        raise ViewError("the person is behind the camera")

    motion = planted.moving(skeleton(), 600)
    log, truth = worn(motion)
    found = align_sensors(*filmed(motion, 0.0, 9.0), log, joints(truth), skeleton(), fails)
    assert found.refined is None
    assert found.delay is None
    assert "not refined: the person is behind the camera" in found.warnings[0]
    assert all(sensor.doubt for sensor in found.sensors)


def test_headings_mountings_and_their_errors_are_those_of_the_self_calibration() -> None:
    motion = planted.moving(skeleton(), 600, radians=0.5)
    log, truth = worn(motion)
    extra = replace(log.streams[0], name="on the shoulder")  # where the solver takes no sensor
    log = replace(log, streams=(extra, *log.streams))
    places = {"on the shoulder": "LeftShoulder"} | joints(truth)
    video = filmed(motion, 0.0, 9.0)
    before = align_sensors(*video, log, places, skeleton())

    def finds(recording: Recording, _: object, priors: CalibrationPriors) -> SelfCalibration:
        assert recording.calibration.sensors == truth.sensors
        found = [Quantity("delay", "video", np.array([0.004]), np.array([0.002]), np.array([0.05]), 0.99)]
        for joint, sigma_deg in zip(truth.joints, (1.0, 2.0, 3.0, 9.0), strict=True):
            sigma = np.radians([sigma_deg])
            found += [
                Quantity("heading", joint, np.radians([5.0]), sigma, np.radians([20.0]), 0.99),
                Quantity("mounting", joint, np.zeros(3), np.repeat(sigma, 3), np.radians([20.0] * 3), 0.99),
            ]
        return SelfCalibration(tuple(found), 4.5)

    after = align_sensors(*video, log, places, skeleton(), finds)
    assert after.sensors[0].heading == before.sensors[0].heading
    for old, new in zip(before.sensors[1:], after.sensors[1:], strict=True):
        assert abs(wrapped(new.heading - old.heading)) == pytest.approx(np.radians(5.0))
    assert np.degrees([s.sigma_heading for s in after.sensors[1:]]) == pytest.approx([1.0, 2.0, 3.0, 9.0])
    assert after.calibration.mounting_sd_deg == pytest.approx([10.0, 1.0, 2.0, 3.0, 9.0])
    assert [bool(s.doubt) for s in after.sensors] == [True, False, False, False, True]
    assert "is not known to 4 degrees" in after.sensors[-1].doubt
    assert after.delay.value[0] == pytest.approx(0.004)


def test_a_still_second_is_asked_for_where_legs_have_sensors_and_the_person_never_stands() -> None:
    moves, stands = planted.moving(skeleton(), 480, radians=0.5), planted.upright(skeleton(), 120)
    legs = ("L_UpLeg", "L_LowLeg", "R_UpLeg", "R_LowLeg")

    def warned(motion: Motion, sensors: tuple[str, ...]) -> bool:
        log, truth = worn(motion, sensors=sensors)
        start, stop = motion.poses.times[[0, -1]]
        found = align_sensors(
            *filmed(motion, start, stop), log, joints(truth), skeleton(), lambda *_: SelfCalibration(())
        )
        return any(text.startswith(NEVER_STILL) for text in found.warnings)

    q = np.concatenate([stands.q, moves.q])
    p, R = skeleton().forward_kinematics(q)
    poses = PoseSequence(np.arange(len(q)) / planted.RATE_HZ, p, R, moves.poses.names)
    assert warned(moves, legs)
    assert not warned(replace(moves, q=q, poses=poses), legs)
    assert not warned(moves, ("L_UpArm", "L_LowArm", "R_LowArm"))
