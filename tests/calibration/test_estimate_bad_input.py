"""Calibration of recordings that cannot be calibrated, or not wholly: it is told, and nothing unobserved
is frozen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import calibration_support as cs
import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration, Verdict
from rtof_kin.core.errors import CalibrationError
from rtof_kin.reconstruction.self_calibration import check_height, consistency_warnings
from rtof_kin.recording.recording import Recording

T = 72


@cache
def moving() -> Motion:
    return cs.motion(T)


@cache
def still() -> Motion:
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


def test_standing_still_observes_neither_delay_nor_lever_arms() -> None:
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


def test_drift_is_unobserved_in_a_second() -> None:
    priors = cs.only("delay", "heading", sigma_clock_drift=1e-3, sigma_heading_drift=0.003)
    result = found("moving", priors)
    assert result["delay", "video"].sigma[1] == pytest.approx(1e-3, rel=0.02)
    for joint in planted.LIMBS:
        q = result["heading", joint]
        assert q.sigma[1] == pytest.approx(q.sigma_prior[1], rel=0.05)


def test_unobserved_quantities_are_zero() -> None:
    result = found("still", cs.only(*cs.OPEN))
    unobserved = [q for q in result.quantities if q.verdict is Verdict.PRIOR]
    assert unobserved
    assert not any(q.value.any() for q in unobserved if q.kind != "ankle height")
    for q in unobserved:
        assert q.item not in result.of_kind(q.kind)


LONG_LEGS = {"LeftLeg": 0.55, "RightLeg": 0.55, "LeftFoot": 0.60, "RightFoot": 0.60}


def test_height_contradicting_bone_lengths_is_refused() -> None:
    recording = replace(recorded(), joint_offsets=None, height=1.6, bone_lengths=LONG_LEGS)
    with pytest.raises(CalibrationError, match=r"height is 1\.60 m, .* make a body 2\.06 m tall"):
        check_height(recording)


@pytest.mark.parametrize("share", [0.95, 1.0, 1.05])
def test_height_close_to_bone_lengths_is_accepted(share: float) -> None:
    recording = recorded()
    check_height(replace(recording, height=share * recording.skeleton.height))
    check_height(recording)


def test_bones_contradicting_the_height_cause_a_warning() -> None:
    tall = replace(recorded(), height=recorded().skeleton.height)
    ones = np.ones(1)
    small = Quantity("bones", "all", -0.2 * ones, 0.01 * ones, 0.02 * ones, 0.9)
    said = consistency_warnings(tall, SelfCalibration((small,)))
    assert len(said) == 2
    assert said[0].startswith("bones of all: -20 % is 10 times its prior standard deviation 2")
    told, made = recorded().skeleton.height, 0.8 * recorded().skeleton.height
    assert f"height is {told:.2f} m" in said[1]
    assert f"make {made:.2f} m" in said[1]


def test_a_video_that_hardly_overlaps_the_sensors_is_refused() -> None:
    seen = recorded().video
    seen = replace(seen, times=seen.times + seen.times[-1] - 0.1)
    late = replace(recorded(), keypoints=seen, truth=None)
    poses = replace(moving().poses, times=late.video.times)
    with pytest.raises(CalibrationError, match="too little to look for a delay"):
        cs.calibrated(late, poses, cs.only("delay"), cs.SETTINGS, frames=24)
