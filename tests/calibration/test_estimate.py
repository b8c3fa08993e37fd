"""Calibration from the recording itself: planted truth comes back, bad input is refused or told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration, Verdict
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.self_calibration import consistency_warnings
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
T = 72


@cache
def truth() -> Motion:
    return cs.motion(T)


@cache
def recorded(sigma_px: float = 0.5, degrees: float = 0.5) -> Recording:
    return planted.recording(truth(), sigma_px=sigma_px, degrees=degrees)


def found(recording: Recording, priors: CalibrationPriors, **start: Array) -> SelfCalibration:
    poses = replace(truth().poses, times=recording.keypoints.times, **start)
    return cs.calibrated(recording, poses, priors, cs.SETTINGS, frames=24)


@pytest.mark.parametrize("seconds", [-0.02, 0.09])
def test_a_planted_delay_is_found_to_5_ms(seconds: float) -> None:
    result = found(cs.late(recorded(), seconds), cs.only("delay"))
    assert result["delay", "video"].value[0] == pytest.approx(seconds, abs=0.005)
    assert result["delay", "video"].verdict is Verdict.OBSERVED


def test_delay_at_the_border_of_the_search_is_in_doubt() -> None:
    result = found(cs.late(recorded(), 0.3), cs.only("delay"))
    delay = result["delay", "video"]
    assert delay.verdict is Verdict.DOUBTFUL
    assert "border of 0.15 s" in delay.doubt
    assert delay.sigma[0] == delay.sigma_prior[0]
    assert any("is unreliable" in line for line in consistency_warnings(recorded(), result))


def test_planted_headings_are_found() -> None:
    S = 8
    heading = np.radians([10, -8, 6, 12, -10, 5, 8, -12.0])
    priors = cs.only("heading", sigma_heading=0.2)
    result = found(cs.misaligned(recorded(), heading=heading), priors)
    values = np.array([result["heading", joint].value[0] for joint in planted.LIMBS])
    ordered = [planted.LIMBS.index(j) for j in recorded().calibration.joints]
    np.testing.assert_allclose(values[ordered], heading, atol=np.radians(3.5))
    assert len(result.of_kind("heading")) == S


def test_planted_mountings_are_reduced() -> None:
    rng = np.random.default_rng(5)
    mounting = np.radians(6) * rng.normal(size=(8, 3))
    priors = cs.only("mounting", sigma_swing=0.1, sigma_twist=0.1)
    result = found(cs.misaligned(recorded(), mounting=mounting), priors)
    joints = recorded().calibration.joints
    left = np.array([result["mounting", joint].value for joint in joints]) - mounting
    assert np.sqrt(np.mean(left**2)) < 0.4 * np.sqrt(np.mean(mounting**2))


def test_planted_image_biases_are_estimated_up_to_their_mean() -> None:
    bias = 8 * np.random.default_rng(6).normal(size=(21, 2))
    result = found(cs.biased(recorded(), bias), cs.only("image bias", sigma_image_bias=8.0))
    left = np.array([result["image bias", n].value for n in cs.BODY.names]) - bias
    assert np.sqrt(np.mean((left - left.mean(axis=0)) ** 2)) < 0.5 * np.sqrt(np.mean(bias**2))


def standing(ankles: float = 0.08) -> Motion:
    """Somebody who stands and swings the arms, the ankles so high over the floor."""
    q, times = np.tile(cs.BODY.n_pose(), (T, 1)), np.arange(T) / 60
    swing = 0.6 * np.sin(2 * np.pi * times)[:, None]
    q[:, [7 + i for i, name in enumerate(cs.BODY.dof_names) if "Arm" in name]] += swing
    p, R = cs.BODY.forward_kinematics(q)
    p[..., 2] += ankles - p[:, cs.BODY.index("LeftFoot", "RightFoot"), 2].mean()
    return cs.BODY.motion(PoseSequence(times, p, R, cs.BODY.names))


def test_body_size_is_estimated_with_a_floor() -> None:
    truth, body = standing(), cs.BODY
    given = planted.recording(truth, sigma_px=0.5, degrees=0.5)
    small = replace(given, joint_offsets=body.joint_offsets / 1.05)
    poses = replace(truth.poses, times=given.keypoints.times)
    result = cs.calibrated(small, poses, cs.only("bones", sigma_proportion=None), cs.SETTINGS, frames=24)
    assert result["bones", "all"].value[0] == pytest.approx(0.05, abs=0.015)
    offsets = result.apply(small).joint_offsets
    assert np.abs(offsets - body.joint_offsets).max() < 0.4 * np.abs(body.joint_offsets).max() * 0.05


def test_unknown_ankle_height_limits_the_estimated_size() -> None:
    """How high they are is left open: the size moves less, and is no surer than that allows."""
    truth = standing(ankles=0.11)
    given = planted.recording(truth, sigma_px=0.5, degrees=0.5)
    poses = replace(truth.poses, times=given.keypoints.times)
    results = [
        cs.calibrated(given, poses, cs.only(*kinds, sigma_size=0.03, sigma_proportion=None), cs.SETTINGS, 24)
        for kinds in (("bones",), ("bones", "ankle height"))
    ]
    held, left_open = (result["bones", "all"] for result in results)
    assert held.value[0] > 0.02
    assert left_open.value[0] < 0.75 * held.value[0]
    assert held.value[0] > 2 * held.sigma[0]
    assert left_open.value[0] < left_open.sigma[0]
    assert results[0].ankle_height == 0.0
    assert results[1].ankle_height == pytest.approx(0.01, abs=0.005)


def test_claimed_standard_deviations_cover_what_was_planted() -> None:
    """All together, errors as large as their priors say: about two thirds within one."""
    z = []
    priors = cs.only("heading", "image bias", sigma_heading=0.1)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        heading, bias = 0.1 * rng.normal(size=8), 6 * rng.normal(size=(21, 2))
        wrong = cs.biased(cs.misaligned(recorded(), heading=heading), bias)
        result = found(wrong, priors)
        for joint, value in zip(recorded().calibration.joints, heading, strict=True):
            q = result["heading", joint]
            z.append((q.value[0] - value) / q.sigma[0])
        for name, pixels in zip(cs.BODY.names, bias, strict=True):
            q = result["image bias", name]
            z += ((q.value - pixels) / q.sigma).tolist()
    z = np.abs(z)
    assert np.mean(z < 1) > 0.5
    assert np.mean(z < 2) > 0.85


def test_correct_calibration_is_unchanged() -> None:
    result = found(recorded(0.3, 0.3), CalibrationPriors(sigma_image_bias=None))
    assert abs(result["delay", "video"].value[0]) < 0.003
    turns = np.array([result["mounting", j].value for j in recorded().calibration.joints])
    assert np.degrees(np.abs(turns).max()) < 1.5


@pytest.mark.parametrize(
    "changes, priors, message",
    [
        (
            {"keypoints": recorded().keypoints[:10]},
            cs.only("delay"),
            r"0.15 s in common, too little .* delay of 0.20 s",
        ),
        ({"imus": None}, None, "without calibrated IMUs and a video"),
        ({}, cs.only(), "nothing is left open"),
        ({"keypoints": planted.unseen(recorded().keypoints, slice(None))}, CalibrationPriors(), "sees nothing"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(changes: dict[str, Any], priors: CalibrationPriors, message: str) -> None:
    wrong = replace(recorded(), **changes)
    with pytest.raises(CalibrationError, match=message):
        cs.calibrated(wrong, truth().poses[: len(wrong.video)], priors, cs.SETTINGS, frames=24)


@pytest.mark.parametrize(
    "wrong", [{"sigma_delay": 0.0}, {"sigma_twist": -1.0}, {"rounds": 0}, {"most_seconds": np.nan}]
)
def test_invalid_priors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match=f"{next(iter(wrong))} is .*positive, finite"):
        CalibrationPriors(**wrong)


def test_bones_are_estimated_only_if_not_measured() -> None:
    table = SkeletonModel.default()
    recording = replace(recorded(), joint_offsets=table.joint_offsets)
    assert CalibrationPriors.of(recording).sigma_size == 0.05
    assert CalibrationPriors.of(replace(recording, height=table.height)).sigma_size == 0.02
    measured = replace(recording, joint_offsets=1.02 * table.joint_offsets)
    assert CalibrationPriors.of(measured).sigma_size is None
    given = recording.calibration
    assert CalibrationPriors.of(recording).sigma_swing is not None
    stated = replace(recording, calibration=replace(given, mounting_sd_deg=np.full(len(given.sensors), 3.0)))
    assert CalibrationPriors.of(stated).sigma_swing is None


def test_unobserved_quantities_are_zero() -> None:
    """Of somebody who stands as in the first frame, all the time."""
    q = np.tile(truth().q[:1], (T, 1))
    p, R = cs.BODY.forward_kinematics(q)
    still = replace(truth(), q=q, poses=replace(truth().poses, p_world_joint=p, R_world_bone=R))
    recording = planted.recording(still, sigma_px=1.0, degrees=1.0)
    result = cs.calibrated(recording, still.poses, cs.only(*cs.OPEN), cs.SETTINGS, frames=24)
    unobserved = [q for q in result.quantities if q.verdict is Verdict.PRIOR]
    assert unobserved
    assert not any(q.value.any() for q in unobserved if q.kind != "ankle height")
    for q in unobserved:
        assert q.item not in result.of_kind(q.kind)
        assert q.kind == "ankle height" or np.array_equal(q.sigma, q.sigma_prior)
    assert result["delay", "video"] in unobserved
    np.testing.assert_array_equal(result.apply(recording).video.times, recording.video.times)


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
