"""Inflation of covariances by class of observation; its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks.confidence.curves import as_toml as curves_as_toml
from benchmarks.confidence.fitting import as_toml
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.solve.joint_space.covariance import segment_pairs
from rtof_kin.solve.uncertainty import (
    OTHER,
    SEEN,
    USUAL_TORSO_SIGMA,
    WINDOW,
    CovarianceInflation,
    CurveFactors,
    ResidualStatistics,
    Widening,
    autocorrelation,
    disagreement,
    leg_misfit,
    leg_spread,
    residual_statistics,
    seen_by,
    unsided,
)

BODY = SkeletonModel.default()
PAIRS = ((WORLD, "Hips"), ("Hips", "LeftUpLeg"))


def confidence(size: float = 1.0) -> Confidence:
    unit = np.tile(size * np.eye(3), (2, 3, 1, 1))
    names = ("Hips", "LeftUpLeg", "RightUpLeg")
    return Confidence(np.arange(2.0), names, unit, unit, PAIRS, unit[:, :2])


def inflation(**others: dict[str, Widening]) -> CovarianceInflation:
    """Factors 1, 2 and 3 by who saw it, and no floor; `others` are of turns, by who saw them."""
    return CovarianceInflation(
        {
            who: {kind: {OTHER: Widening(i, 0.0), **(others.get(who, {}) if kind == "turn" else {})} for kind in kinds}
            for i, (who, kinds) in enumerate(SEEN.items(), start=1)
        }
    )


def test_a_covariance_is_scaled_on_both_sides_and_gets_a_floor() -> None:
    root = np.random.default_rng(0).normal(size=(2, 2, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2)
    wide = Widening([1.0, 2.0, 4.0], [0.1, 0.2, 0.3])
    found = inflation(camera={"world Hips": wide}).apply(
        replace(confidence(), turn_covariance=covariance), ResidualStatistics()
    )
    K = np.diag([1.0, 2.0, 4.0])
    expected = K @ covariance[:, 0] @ K + np.diag([0.01, 0.04, 0.09])
    np.testing.assert_allclose(found.turn_covariance[:, 0], expected)
    np.testing.assert_allclose(found.turn_covariance[:, 1], covariance[:, 1])


@pytest.mark.parametrize(
    "sensors, position, relative, turns",
    [
        ((), 1, 1, [1, 1]),
        (("LeftLeg",), 1, 2, [2, 2]),
        (("LeftUpLeg", "RightLeg"), 1, 2, [2, 2]),
        (("LeftUpLeg", "LeftLeg"), 2, 2, [2, 2]),
        (("Hips",), 1, 3, [3, 2]),
        (("Hips", "LeftUpLeg", "LeftLeg"), 2, 3, [3, 3]),
    ],
)
def test_sensor_class(sensors: tuple[str, ...], position: float, relative: float, turns: list[float]) -> None:
    found = inflation().apply(confidence(), ResidualStatistics(sensors))
    np.testing.assert_allclose(found.position_sigma, position)
    np.testing.assert_allclose(found.relative_sigma[:, 1:], relative)
    np.testing.assert_allclose(found.turn_covariance[0, :, 0, 0], np.square(turns))
    np.testing.assert_array_equal(found.relative_sigma[:, 0], 0.0)


def test_share_of_the_disagreement_is_added() -> None:
    given = inflation()
    found = CovarianceInflation(given.widenings, {"fused": {"relative": 0.5, "turn": 0.25}})
    off = np.zeros((2, 3, 3, 3))
    off[1, 1, 0, 0] = 4.0
    apart = confidence().changed(position_covariance=off, relative_covariance=off, turn_covariance=off[:, :2])
    statistics = ResidualStatistics(("LeftLeg",))
    plain, wide = (found.apply(confidence(), statistics, of) for of in (None, apart))
    np.testing.assert_allclose(wide.relative_covariance - plain.relative_covariance, 0.25 * off)
    np.testing.assert_allclose(wide.turn_covariance - plain.turn_covariance, off[:, :2] / 16)
    np.testing.assert_array_equal(wide.position_covariance, plain.position_covariance)  # no share


def test_positions_in_world_err_in_proportion_to_the_distance_along_the_line_of_sight() -> None:
    given, statistics = inflation(), ResidualStatistics(autocorrelation=0.5)
    found = CovarianceInflation(given.widenings, depths={"camera": 0.2})
    away = np.random.default_rng(0).normal(size=(2, 3, 3))
    plain, wide = (found.apply(confidence(), statistics, None, p) for p in (None, away))
    more = wide.position_covariance - plain.position_covariance
    distance = np.linalg.norm(away, axis=-1)
    np.testing.assert_allclose(np.sqrt(np.trace(more, axis1=2, axis2=3)), 0.1 * distance)
    along = np.einsum("tji,tjik,tjk->tj", away, more, away) / distance**2
    np.testing.assert_allclose(np.sqrt(along), 0.1 * distance)
    np.testing.assert_array_equal(wide.relative_covariance, plain.relative_covariance)


def test_white_residuals_have_the_least_inflation() -> None:
    wide = {"world Hips": Widening(3.0, 0.5), "Hips UpLeg": Widening(1.1, 0.5)}
    white = inflation(camera=wide).apply(confidence(), ResidualStatistics(autocorrelation=0.0))
    np.testing.assert_allclose(white.turn_covariance[0, :, 0, 0], np.square([1.2, 1.1]))
    half = inflation(camera=wide).apply(confidence(), ResidualStatistics(autocorrelation=0.5))
    np.testing.assert_allclose(half.turn_covariance[0, 0, 0, 0], 2.1**2 + 0.25**2)


def test_uncertain_lifter_raises_floors_without_sensors() -> None:
    wide = {"world Hips": Widening(2.0, 0.5)}
    unsure = ResidualStatistics(torso_sigma=2 * USUAL_TORSO_SIGMA)
    found = inflation(camera=wide, sensed=wide)
    free = found.apply(confidence(), unsure)
    sensed = found.apply(confidence(), replace(unsure, sensors=("Hips",)))
    assert free.turn_covariance[0, 0, 0, 0] == pytest.approx(2.0**2 + 1.0)
    assert sensed.turn_covariance[0, 0, 0, 0] == pytest.approx(2.0**2 + 0.25)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"autocorrelation": 1.1}, r"autocorrelation: 1.1 is not in \[0, 1\]"),
        ({"autocorrelation": np.nan}, "autocorrelation: nan is not"),
        ({"torso_sigma": 0.0}, "torso_sigma: 0.0 must be positive"),
        ({"sensors": ("Hips", "Hips")}, "sensors: Hips occurs more than once"),
    ],
)
def test_invalid_statistics_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ResidualStatistics(**wrong)


def test_right_and_left_have_equal_widenings() -> None:
    assert unsided("Hips LeftUpLeg") == unsided("Hips RightUpLeg") == "Hips UpLeg"
    found = CovarianceInflation.shipped().apply(confidence(1e-4), ResidualStatistics())
    np.testing.assert_array_equal(found.position_sigma[:, 1], found.position_sigma[:, 2])


def test_file_round_trip(tmp_path: Path) -> None:
    plain = inflation(sensed={"Hips UpLeg": Widening([1.0, 2.5, 3.0], [0.0, 0.01, 0.02])})
    given = CovarianceInflation(plain.widenings, {"fused": {"position": 0.0, "turn": 0.25}}, {"camera": 0.02})
    (tmp_path / "a.toml").write_text(as_toml(given))
    read = CovarianceInflation.read(tmp_path / "a.toml")
    assert as_toml(read) == as_toml(given)
    assert (read.shares, read.depths) == (given.shares, given.depths)
    np.testing.assert_array_equal(read.widenings["sensed"]["turn"]["Hips UpLeg"].factor, [1.0, 2.5, 3.0])


def test_shipped_file_has_all_joints_and_pairs() -> None:
    shipped = CovarianceInflation.shipped()
    carriers = tuple(joint for name, (joint, _) in BODY.sensors.items() if name.endswith(("Arm", "Leg")))
    assert len(carriers) == 8
    for kind in ("position", "relative"):
        known = shipped.widenings["fused"][kind]
        assert {unsided(name) for name in BODY.names[1:]} <= set(known)
    for pair in segment_pairs(BODY):
        if not pair[1].endswith(("Head", "Hand", "Foot")):  # leaves, which no sensor of the eight turns
            name = " ".join(pair)
            who = seen_by("turn", name, BODY.root, carriers)
            assert unsided(name) in shipped.widenings[who]["turn"], name


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "empty; expected TOML"),
        ("[fused]", "no table of widenings: 'camera'"),
        ("camera = 3", "no table of widenings"),
        ("[camera.position]\nother = {factor = 0.5, floor = 0}", "factor: 0.5 must be one or three"),
        ("[camera.position]\nother = {factor = 2, floor = -1}", "floor: -1.0 must be"),
        ("[camera.position]\nother = {factor = [1, 2], floor = 0}", "must be one or three numbers"),
        ("[camera.position]\nother = {factor = 2, width = 0}", "no table of widenings"),
        ("[camera.position]\nother = {factor = nan, floor = 0}", "factor: nan must be"),
    ],
)
def test_invalid_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        CovarianceInflation.read(tmp_path / "a.toml")


SOLVED = planted.moving(BODY, 60, 2).poses
PAIRS_UNCERTAINTY_DISAGREEMENT = ((WORLD, "Hips"), ("Hips", "LeftUpLeg"), (WORLD, "LeftUpLeg"))
LIKE = Confidence(
    SOLVED.times,
    BODY.names,
    np.zeros((60, 21, 3, 3)),
    np.zeros((60, 21, 3, 3)),
    PAIRS_UNCERTAINTY_DISAGREEMENT,
    np.zeros((60, 3, 3, 3)),
)
(THIGH,) = BODY.index("LeftUpLeg")


def test_it_has_the_size_and_the_direction_of_the_difference() -> None:
    shift, turn = np.array([0.03, 0.0, -0.04]), np.array([0.0, 0.2, 0.0])
    p, R = SOLVED.p_world_joint + shift, np.array(SOLVED.R_world_bone)
    R[:, THIGH] = R[:, THIGH] @ so3.exp(-turn)
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p, R_world_bone=R), LIKE)
    np.testing.assert_allclose(found.position_covariance[10, THIGH], np.outer(shift, shift), atol=1e-12)
    assert np.abs(found.relative_covariance).max() < 1e-12  # the root is off as far
    np.testing.assert_allclose(found.turn_covariance[10, 1], np.outer(turn, turn), atol=1e-12)
    np.testing.assert_allclose(found.turn_covariance[10, 2], found.turn_covariance[10, 1], atol=1e-12)
    assert np.abs(found.turn_covariance[:, 0]).max() < 1e-12


def test_neighbours_in_time_count_alike_and_the_ends_have_fewer() -> None:
    p = np.array(SOLVED.p_world_joint)
    p[30, THIGH, 2] += 0.1
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p), LIKE).relative_covariance[:, THIGH, 2, 2]
    reach = round(WINDOW * SOLVED.rate_hz)
    assert found[30 - reach] == found[30 + reach] == pytest.approx(0.01 / (2 * reach + 1))
    assert found[29 - reach] == pytest.approx(0.0, abs=1e-15)
    p[:, THIGH] = SOLVED.p_world_joint[:, THIGH]
    p[0, THIGH, 2] += 0.1
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p), LIKE).relative_covariance[:, THIGH, 2, 2]
    assert found[0] == pytest.approx(0.01 / (reach + 1))


def test_what_is_not_known_is_not_apart() -> None:
    p, R = np.array(SOLVED.p_world_joint), np.array(SOLVED.R_world_bone)
    p[:20], R[:20] = np.nan, np.nan
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p, R_world_bone=R), LIKE)
    for part in (found.position_covariance, found.relative_covariance, found.turn_covariance):
        assert np.isfinite(part).all()
        assert np.abs(part).max() < 1e-12


Array = NDArray[np.float64]
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


CURVE_FACTORS = CurveFactors({0: {"knee_flexion": 4.0}, 8: {"knee_flexion": 3.0, "hip_flexion": 2.5}}, 21, 0.9, "clips")


def test_curve_factors_are_equal_on_both_sides_and_those_of_the_next_smaller_set() -> None:
    sides = [CURVE_FACTORS.factor(f"{side}knee_flexion", 8) for side in ("right_", "left_", "")]
    assert sides == [3.0, 3.0, 3.0]
    assert [CURVE_FACTORS.factor("knee_flexion", count) for count in (0, 7, 9, 17)] == [4.0, 4.0, 3.0, 3.0]
    assert CURVE_FACTORS.factor("hip_flexion", 4) is None  # those of eight sensors are no factors of four
    assert CURVE_FACTORS.factor("left_hip_flexion", 10) == 2.5
    assert CurveFactors({4: {"knee_flexion": 2.0}}, 9, 0.9).factor("knee_flexion", 0) is None


def test_curve_factors_are_read_with_the_inflation(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(as_toml(inflation()) + "\n" + curves_as_toml(CURVE_FACTORS))
    assert CovarianceInflation.read(tmp_path / "a.toml").curves == CURVE_FACTORS
    (tmp_path / "b.toml").write_text(as_toml(inflation()))
    assert CovarianceInflation.read(tmp_path / "b.toml").curves is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("people = 0\nlevel = 0.9", "level 0.9 of 0 people"),
        ("people = 9\nlevel = 1.0", "level 1.0 of 9 people"),
        ("people = 9", "no table of widenings"),
        ("people = 9\nlevel = 0.9\n[curve.8]\nknee_flexion = inf", "inf of knee_flexion with 8 sensors"),
        ("people = 9\nlevel = 0.9\neight = 3", "no table of widenings"),
    ],
)
def test_invalid_curve_factors_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.toml").write_text(as_toml(inflation()) + "\n[curve]\n" + text)
    with pytest.raises(FileFormatError, match=message):
        CovarianceInflation.read(tmp_path / "a.toml")


def test_shipped_curves_are_those_of_enough_people_and_wider_than_single_frames() -> None:
    shipped = CovarianceInflation.shipped().curves
    assert shipped is not None
    assert set(shipped.factors) == {0, 4, 8, 10}
    assert shipped.people / (shipped.people + 1) > shipped.level
    for sensors in shipped.factors:
        knee = shipped.factor("right_knee_flexion", sensors)
        assert knee is not None
        assert knee > 1.96
