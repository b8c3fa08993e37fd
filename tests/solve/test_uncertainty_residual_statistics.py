"""Statistics of residuals: their autocorrelation, and the uncertainty of a lifter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.solve.uncertainty import USUAL_TORSO_SIGMA, autocorrelation, leg_misfit, leg_spread, residual_statistics

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
MOTION = planted.moving(BODY, 240, 1)
CAMERA = Camera.looking_at((4.0, 1.0, 1.5), MOTION.poses.p_world_joint.mean(axis=(0, 1)), 1250.0)


def keypoints(error_px: Array, motion: Motion = MOTION) -> KeypointSequence:
    """Of the motion's joints, off by errors (T, J, 2)."""
    uv = CAMERA.project(motion.poses.p_world_joint) + error_px
    return KeypointSequence(CAMERA, motion.times, uv, np.ones(uv.shape[:2]), BODY.names)


def errors(number: int, shape: tuple[int, ...] = (240, 21, 2)) -> Array:
    return 5.0 * np.random.default_rng(number).normal(size=shape)


def test_autocorrelation_of_white_residuals_and_of_a_bias() -> None:
    white = residual_statistics(keypoints(errors(0)), MOTION, MOTION.poses)
    biased = residual_statistics(keypoints(errors(1, (21, 2)) + 0.2 * errors(2)), MOTION, MOTION.poses)
    assert white.autocorrelation < 0.05
    assert biased.autocorrelation == 1.0


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 120.0])
def test_the_correlation_is_that_of_a_fifteenth_of_a_second_at_every_rate(rate_hz: float) -> None:
    rng, memory = np.random.default_rng(3), 0.2
    stay = np.exp(-1 / (rate_hz * memory))
    residuals = [rng.normal(size=(40, 2))]
    for _ in range(600):
        residuals.append(stay * residuals[-1] + np.sqrt(1 - stay**2) * rng.normal(size=(40, 2)))
    found = autocorrelation(np.array(residuals), np.arange(601) / rate_hz)
    assert found == pytest.approx(np.exp(-1 / (15 * memory)), abs=0.05)


def test_outliers_do_not_increase_the_autocorrelation() -> None:
    residuals = errors(4)
    residuals[50:100, :2] += 300.0
    found = autocorrelation(residuals, np.arange(240) / 60)
    assert found < 0.3


def test_unobserved_landmarks_are_ignored_and_few_have_no_autocorrelation() -> None:
    residuals = np.broadcast_to(errors(5, (21, 2)), (240, 21, 2)).copy()
    residuals[::3] = np.nan
    assert autocorrelation(residuals, np.arange(240) / 60) == pytest.approx(1.0)
    assert autocorrelation(residuals[:5], np.arange(5) / 60) is None
    assert autocorrelation(np.full((240, 21, 2), np.nan), np.arange(240) / 60) is None
    assert autocorrelation(np.zeros((240, 21, 2)), np.arange(240) / 60) is None


def test_unobserved_recording_has_the_usual_statistics() -> None:
    found = residual_statistics(keypoints(np.full((240, 21, 2), np.nan)), MOTION, MOTION.poses, ("Hips",))
    assert (found.autocorrelation, found.torso_sigma, found.sensors) == (1.0, USUAL_TORSO_SIGMA, ("Hips",))


def test_torso_sigma_is_that_of_pelvis_and_upper_trunk() -> None:
    sigma = np.full((240, 21), 0.5)
    sigma[:, BODY.index("Hips", "Spine3")] = 0.2
    sigma[:30] = np.nan
    lifted = replace(MOTION.poses, sigma_rad=sigma)
    assert residual_statistics(keypoints(errors(6)), MOTION, lifted).torso_sigma == pytest.approx(0.2)


def legs_off(px: float, frames: slice = slice(None)) -> Array:
    off = np.zeros((240, 21, 2))
    off[frames, BODY.index("LeftLeg", "RightLeg", "LeftFoot", "RightFoot"), 0] = px
    return off


def test_legs_that_are_off_together_misfit_the_hips_and_no_other_error_does() -> None:
    size = leg_misfit(keypoints(legs_off(60.0)), MOTION).thighs
    metres = 60.0 / 1250.0 * np.median(CAMERA.to_camera(MOTION.poses.p_world_joint)[..., 2])
    assert size.mean() == pytest.approx(metres, rel=0.1)
    one = legs_off(60.0) * np.char.startswith(BODY.names, "Left")[:, None]
    for other in (one, np.full((240, 21, 2), 60.0), errors(7), np.full((240, 21, 2), np.nan)):
        found = leg_misfit(keypoints(other), MOTION)
        assert not found.excess(60.0).any()
        assert found.shanks.max() < 0.02


def test_bands_grow_where_the_legs_misfit_and_less_with_sensors_on_the_thighs() -> None:
    pairs = ((WORLD, "Hips"), ("LeftUpLeg", "LeftLeg"))
    zero = np.zeros((240, 21, 3, 3))
    none = Confidence(MOTION.times, BODY.names, zero, zero, pairs, np.zeros((240, 2, 3, 3)))
    assert leg_spread(none, leg_misfit(keypoints(errors(8)), MOTION), MOTION) is None
    misfit = leg_misfit(keypoints(legs_off(60.0)), MOTION)
    wide, sensed = (leg_spread(none, misfit, MOTION, on) for on in ((), ("LeftUpLeg", "LeftLeg")))
    assert wide is not None
    assert sensed is not None
    knee, arm = BODY.index("LeftLeg", "LeftArm")
    assert 3 * sensed.relative_sigma[0, knee] < wide.relative_sigma[0, knee]
    assert 3 * wide.relative_sigma[0, arm] < wide.relative_sigma[0, knee]
    assert not wide.relative_sigma[:, 0].any()
    assert np.degrees(np.sqrt(wide.turn("LeftUpLeg", "LeftLeg")[0, 0, 0])) > 10.0
    assert not sensed.turn("LeftUpLeg", "LeftLeg").any()
