"""Calibration of recordings that cannot be calibrated, or not wholly: it is told, and nothing unobserved
is frozen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration, Verdict
from rtof_kin.core.errors import CalibrationError, FileFormatError, ShapeError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.reconstruction.consistency_checks import check_height, consistency_warnings
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
T = 72


@cache
def moving() -> MotionSequence:
    return cs.motion(T)


@cache
def still() -> MotionSequence:
    """Somebody who stands as in the first frame, all the time."""
    first = moving()
    q = np.tile(first.q[:1], (T, 1))
    p, R = cs.BODY.forward_kinematics(q)
    return replace(first, q=q, poses=replace(first.poses, p_world_joint=p, R_world_bone=R))


@cache
def recorded(motion: str = "moving") -> Recording:
    return planted.recording(still() if motion == "still" else moving(), sigma_px=1.0, degrees=1.0)


def found(motion: str, priors: CalibrationPriors) -> SelfCalibration:
    poses = (still() if motion == "still" else moving()).poses
    return cs.calibrated(recorded(motion), poses, priors, cs.SETTINGS, frames=24)


# --- too little motion ---------------------------------------------------------------------------


def test_who_stands_still_leaves_open_what_only_motion_tells() -> None:
    result = found("still", cs.only("delay", "lever arm"))
    assert [q.verdict for q in result.quantities] == [Verdict.PRIOR] * 9
    for q in result.quantities:
        assert not q.value.any()
        np.testing.assert_array_equal(q.sigma, q.sigma_prior)
    recording = recorded("still")
    after = result.apply(recording)
    np.testing.assert_array_equal(after.video.times, recording.video.times)
    assert after.calibration is not None
    assert recording.calibration is not None
    np.testing.assert_array_equal(after.calibration.p_bone_sensor, recording.calibration.p_bone_sensor)


def test_who_moves_tells_the_delay() -> None:
    assert found("moving", cs.only("delay"))["delay", "video"].verdict is Verdict.OBSERVED


def test_a_drift_is_not_told_by_a_recording_of_a_second() -> None:
    priors = cs.only("delay", "heading", sigma_clock_drift=1e-3, sigma_heading_drift=0.003)
    result = found("moving", priors)
    assert result["delay", "video"].sigma[1] == pytest.approx(1e-3, rel=0.02)
    for joint in planted.LIMBS:
        q = result["heading", joint]
        assert q.sigma[1] == pytest.approx(q.sigma_prior[1], rel=0.05)


def test_what_was_not_observed_is_not_frozen() -> None:
    result = found("still", cs.only(*cs.OPEN))
    unobserved = [q for q in result.quantities if q.verdict is Verdict.PRIOR]
    assert unobserved
    assert not any(q.value.any() for q in unobserved if q.kind != "ankle height")
    for q in unobserved:
        assert q.item not in result.of_kind(q.kind)


# --- contradictory facts -------------------------------------------------------------------------

LONG_LEGS = {"LeftLeg": 0.55, "RightLeg": 0.55, "LeftFoot": 0.60, "RightFoot": 0.60}


def test_a_height_that_no_bone_lengths_fit_is_refused_and_both_are_named() -> None:
    recording = replace(recorded(), joint_offsets=np.empty((0, 3)), height=1.6, bone_lengths=LONG_LEGS)
    with pytest.raises(CalibrationError, match=r"told to be 1\.60 m, .* make a body 2\.06 m tall"):
        check_height(recording)


@pytest.mark.parametrize("share", [0.95, 1.0, 1.05])
def test_a_height_that_bones_nearly_have_is_none_of_it(share: float) -> None:
    recording = recorded()
    check_height(replace(recording, height=share * recording.skeleton.height))
    check_height(recording)


def test_bones_found_against_the_height_told_are_told_with_both_heights() -> None:
    tall = replace(recorded(), height=recorded().skeleton.height)
    ones = np.ones(1)
    small = Quantity("bones", "all", -0.2 * ones, 0.01 * ones, 0.02 * ones, 0.9)
    said = consistency_warnings(tall, SelfCalibration((small,)))
    assert len(said) == 2
    assert said[0].startswith("bones of all: -20 % is 10 times the 2 that it was held to be known to")
    told, made = recorded().skeleton.height, 0.8 * recorded().skeleton.height
    assert f"told to be {told:.2f} m" in said[1]
    assert f"make {made:.2f} m" in said[1]


@pytest.mark.parametrize("value, known", [(0.03, 0.9), (0.3, 0.05)])
def test_what_agrees_or_was_not_observed_contradicts_nothing(value: float, known: float) -> None:
    ones = np.ones(1)
    quantity = Quantity("bones", "all", value * ones, 0.01 * ones, 0.02 * ones, known)
    assert consistency_warnings(recorded(), SelfCalibration((quantity,))) == ()


def test_a_body_told_much_too_small_is_found_out() -> None:
    """With a floor; whoever says 2 % of a body that is a quarter too small is told so."""
    small = replace(recorded(), joint_offsets=recorded().joint_offsets / 1.25)
    priors = cs.only("bones", sigma_size=0.02, sigma_proportion=None)
    result = cs.calibrated(small, moving().poses, priors, cs.SETTINGS, frames=24)
    assert any(line.startswith("bones of all") for line in consistency_warnings(small, result))


# --- too short, and nothing in common ------------------------------------------------------------


def test_a_recording_shorter_than_the_delay_searched_is_refused_with_both_lengths() -> None:
    short = replace(recorded(), keypoints=recorded().video[:20])
    with pytest.raises(CalibrationError, match=r"0\.32 s in common, too little .* delay of 2\.00 s"):
        cs.calibrated(short, moving().poses[:20], cs.only("delay", sigma_delay=0.5), cs.SETTINGS, frames=24)


def test_a_video_that_hardly_overlaps_the_sensors_is_refused() -> None:
    seen = recorded().video
    seen = replace(seen, times=seen.times + seen.times[-1] - 0.1)
    late = replace(recorded(), keypoints=seen, truth=None)
    poses = replace(moving().poses, times=late.video.times)
    with pytest.raises(CalibrationError, match="too little to look for a delay"):
        cs.calibrated(late, poses, cs.only("delay"), cs.SETTINGS, frames=24)


# --- two sensors with one name -------------------------------------------------------------------


def test_two_sensors_with_one_name_are_refused() -> None:
    imus, calibration = recorded().imus, recorded().calibration
    assert imus is not None
    assert calibration is not None
    first, _, *others = calibration.sensors
    with pytest.raises(ShapeError, match=f"{first}.* stands there more than once"):
        ImuSequence.joined([imus, imus])
    with pytest.raises(CalibrationError, match=f"sensor {first} stands there more than once"):
        replace(calibration, sensors=(first, first, *others))
    with pytest.raises(CalibrationError, match="segment LeftArm stands there more than once"):
        replace(calibration, joints=("LeftArm", "LeftArm", *calibration.joints[2:]))


@pytest.mark.parametrize("old, new, message", [
    ('"imu_RightArm",', '"imu_LeftArm",', r"imus\.npz: IMU names: imu_LeftArm stands there more"),
    ("[imus.sensors.imu_RightArm]", "[imus.sensors.imu_LeftArm]", r"recording\.toml.*imu_LeftArm.*twice"),
])  # fmt: skip
def test_two_sensors_with_one_name_in_a_file_are_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    folder = tmp_path / "recording"
    recorded().save(folder)
    index = folder / "recording.toml"
    text = index.read_text()
    assert old in text
    index.write_text(text.replace(old, new, 1))
    with pytest.raises(FileFormatError, match=message):
        Recording.load(folder)
