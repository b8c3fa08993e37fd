"""Tests of `rtof_kin.calibration.clocks`."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import planted
import pytest
from clocks_support import cut, filmed, joints, shifted, skeleton, worn

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.clocks import ClockEstimate, find_clock, find_video_offset
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence


@cache
def session(seconds: int = 90, rate_hz: float = 100.0) -> tuple[Motion, SensorLog, ImuCalibration]:
    motion = planted.moving(skeleton(), round(seconds * planted.RATE_HZ))
    return (motion, *worn(motion, rate_hz))


@pytest.mark.parametrize("offset, known", [(-587.3, True), (-3.21, False), (0.0, True), (412.345, False)])
def test_an_offset_of_up_to_ten_minutes_is_found_to_ten_milliseconds(offset: float, known: bool) -> None:
    motion, log, calibration = session()
    start = 41.37
    poses, keypoints = filmed(motion, start, 12.0)
    start = round(start * planted.RATE_HZ) / planted.RATE_HZ
    wanted = joints(calibration) if known else None
    found = find_clock(poses, keypoints, shifted(log, start + offset), skeleton(), wanted)
    assert found.offset == pytest.approx(offset, abs=0.01)
    assert found.doubt == ""
    assert found.joints == joints(calibration)
    assert (found.drift, found.sigma_drift) == (0.0, pytest.approx(60e-6))  # 12 s are too short to tell


@pytest.mark.parametrize("rate_hz", [60.0, 120.0])
def test_the_sensors_rate_does_not_matter(rate_hz: float) -> None:
    motion, log, calibration = session(40, rate_hz)
    poses, keypoints = filmed(motion, 20.0, 10.0)
    found = find_clock(poses, keypoints, log, skeleton(), joints(calibration))
    assert found.offset == pytest.approx(-20.0, abs=0.01)


def test_a_log_shorter_than_the_video_is_found_in_it() -> None:
    motion, log, calibration = session()
    poses, keypoints = filmed(motion, 10.0, 70.0)
    short = cut(log, 30.0, 42.0)
    found = find_clock(poses, keypoints, shifted(short, 100.0), skeleton(), joints(calibration))
    assert found.offset == pytest.approx(90.0, abs=0.01)
    assert found.doubt == ""


def test_drift_is_found_in_a_long_recording_and_taken_off() -> None:
    motion = planted.moving(skeleton(), round(180 * planted.RATE_HZ))
    log, calibration = worn(motion)
    poses, keypoints = filmed(motion, 0.0, 180.0)
    found = find_clock(poses, keypoints, shifted(log, 5.0, 80e-6), skeleton(), joints(calibration))
    assert found.drift == pytest.approx(80e-6, abs=25e-6)
    assert found.sigma_drift < 25e-6
    moved = found.apply(shifted(log, 5.0, 80e-6))
    assert moved.streams[0].times == pytest.approx(log.streams[0].times, abs=0.01)


def test_equal_strides_are_in_doubt_and_name_the_other_offsets() -> None:
    motion, _ = planted.walking(skeleton(), 60.0)
    log, calibration = worn(motion)
    poses, keypoints = filmed(motion, 20.0, 6.0, radians=0.0)
    found = find_clock(poses, keypoints, log, skeleton(), joints(calibration))
    assert "repeats itself" in found.doubt
    assert found.candidates
    assert found.sigma >= max(abs(offset - found.offset) for offset in found.candidates) - 0.05


def test_sensors_of_another_motion_are_in_doubt() -> None:
    motion, *_ = session()
    log, calibration = worn(planted.moving(skeleton(), round(90 * planted.RATE_HZ), seed=50))
    found = find_clock(*filmed(motion, 30.0, 20.0), log, skeleton(), joints(calibration))
    assert "move differently" in found.doubt


@pytest.mark.parametrize(
    "seconds, later, carrier, message",
    [
        (10.0, 5000.0, "LeftForeArm", "search further"),
        (1.0, 0.0, "LeftForeArm", r"shows a person for 1\.0 s"),
        (5.0, 0.0, "Tail", "Tail"),
    ],
)
def test_what_nothing_relates_is_refused(seconds: float, later: float, carrier: str, message: str) -> None:
    motion, log, _ = session()
    with pytest.raises((CalibrationError, UnknownNameError), match=message):
        find_clock(*filmed(motion, 30.0, seconds), shifted(log, later), skeleton(), {"L_LowArm": carrier}, reach=60.0)


def test_sensors_that_do_not_move_are_named_as_such() -> None:
    motion, *_ = session()
    log, calibration = worn(planted.standing(skeleton(), round(60 * planted.RATE_HZ)))
    with pytest.raises(CalibrationError, match="they do not move"):
        find_clock(*filmed(motion, 30.0, 10.0), log, skeleton(), joints(calibration))


def test_a_start_time_decides_between_repetitions() -> None:
    motion, _ = planted.walking(skeleton(), 60.0)
    log, calibration = worn(motion)
    poses, keypoints = filmed(motion, 20.0, 6.0, radians=0.0)
    found = find_clock(poses, keypoints, log, skeleton(), joints(calibration), around=-20.1, reach=0.3)
    assert found.offset == pytest.approx(-20.0, abs=0.01)
    assert not found.candidates


def test_applying_follows_the_formula() -> None:
    _, log, _ = session()
    moved = ClockEstimate(3.0, 1e-4, 0.01, 9.0, middle=50.0).apply(log)
    t = log.streams[0].times
    assert np.array_equal(moved.streams[0].times, t + 3.0 + 1e-4 * (t - 50.0))


BODY = SkeletonModel.default()
MOTION = planted.moving(BODY, 600)


def lifted(seed: int) -> PoseSequence:
    """The motion with the errors of a lifter."""
    p = planted.lifted(MOTION, radians=0.1, seed=seed)
    return replace(MOTION.poses, p_world_joint=p)


def elsewhere(poses: PoseSequence, heading: float, later: float) -> PoseSequence:
    """The poses in a world of another heading, on a clock that is `later`."""
    R = so3.about_axis("z", heading)
    p = poses.p_world_joint @ R.T + [3.0, 1.0, 0.0]
    return replace(poses, times=poses.times + later, p_world_joint=p, R_world_bone=R @ poses.R_world_bone)


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.5])
@pytest.mark.parametrize("later", [0.0, 0.517, -600.0])
def test_the_offset_is_found_whatever_the_heading(heading: float, later: float) -> None:
    second = elsewhere(lifted(9)[120:420], heading, later)
    found = find_video_offset(lifted(5), second)
    assert found.offset == pytest.approx(-later, abs=0.012)
    assert found.doubt == ""


def test_other_rates_are_compared_too() -> None:
    slow = elsewhere(lifted(9)[::3], 1.0, 2.0)
    assert find_video_offset(lifted(5), slow).offset == pytest.approx(-2.0, abs=0.012)


def test_another_motion_is_doubted() -> None:
    other = planted.moving(BODY, 600, seed=50).poses
    assert "differently" in find_video_offset(lifted(5), other).doubt


def test_a_motion_that_repeats_itself_is_doubted_unless_the_time_is_known() -> None:
    walk = planted.walking(BODY, 12.0, stride_s=1.2)[0].poses
    found = find_video_offset(walk, walk[240:480])
    assert "repeats itself" in found.doubt
    near = find_video_offset(walk, walk[240:480], around=0.0)
    assert abs(near.offset) < 1.3


def test_too_short_videos_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="shorter than 1 s"):
        find_video_offset(MOTION.poses, MOTION.poses[:45])
    with pytest.raises(InvalidInputError, match="in common"):
        find_video_offset(MOTION.poses, elsewhere(MOTION.poses, 0.0, 50.0), around=0.0)
