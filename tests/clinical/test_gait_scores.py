"""Gait scores: closed forms, bias and coverage with planted errors, and the reference's own people."""

from __future__ import annotations

import numpy as np
import pytest
from clinical_support import posture, walk, walking
from gait_support import MEAN, cycles_of, means_only, people_curves, reference_of, without
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rtof_kin.body.observability import ObservationMasks
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import foot_table
from rtof_kin.clinical.angles import angles_of
from rtof_kin.clinical.decomposition import DecomposedAngles
from rtof_kin.clinical.gait_scores import (
    build_reference,
    deviation_index,
    gait_features,
    gait_scores,
    people_scores,
    side_curves,
)
from rtof_kin.clinical.gait_variables import GaitCycles, gait_cycles, joined_cycles
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.gait_reference import NAMES

Array = NDArray[np.float64]
BOTH = np.array([MEAN, MEAN])


# --- scores --------------------------------------------------------------------------------------


def test_the_mean_itself_scores_zero() -> None:
    found = gait_scores(cycles_of(BOTH), means_only())
    assert found.overall.value == pytest.approx(0, abs=1e-12)
    assert all(score.value == pytest.approx(0, abs=1e-12) for score in found.profile["left"])


@pytest.mark.parametrize("variable", range(9))
def test_a_constant_offset_is_the_score(variable: int) -> None:
    curves = np.array(BOTH)
    curves[0, variable] += np.radians(5)
    found = gait_scores(cycles_of(curves), means_only())
    assert np.degrees(found.profile["right"][variable].value) == pytest.approx(5)
    assert np.degrees(found.sides["right"].value) == pytest.approx(5 / 3)  # one of nine
    assert found.sides["left"].value == pytest.approx(0, abs=1e-12)
    counted = 0 if variable < 3 else 25  # the pelvis counts with the left side
    assert np.degrees(found.overall.value) ** 2 == pytest.approx(counted / 15, abs=1e-12)


def test_squared_profile_score_is_the_mean_of_squared_variable_scores() -> None:
    found = gait_scores(cycles_of(people_curves(1, 3)[0]), means_only())
    for side in ("right", "left"):
        squares = [score.value**2 for score in found.profile[side]]
        assert found.sides[side].value ** 2 == pytest.approx(np.mean(squares))
    fifteen = [s.value**2 for s in (*found.profile["left"], *found.profile["right"][3:])]
    assert found.overall.value**2 == pytest.approx(np.mean(fifteen))


def test_a_variable_that_is_unobserved_leaves_no_profile_score_and_is_named() -> None:
    found = gait_scores(without(cycles_of(BOTH), "hip_rotation"), means_only())
    assert np.isnan(found.overall.value)
    assert np.isnan(found.sides["right"].value)
    assert set(found.missing["right"]) == {"hip_rotation"}
    assert "thigh" in found.missing["right"]["hip_rotation"]
    assert np.isfinite(found.profile["right"][NAMES.index("knee_flexion")].value)


def test_a_variable_that_the_reference_does_not_have_is_named() -> None:
    mean = np.array(MEAN)
    mean[8] = np.nan
    found = gait_scores(cycles_of(BOTH), means_only(mean))
    assert found.missing["left"] == {"foot_progression": "to be in the reference"}


def errors(kind: str, rng: np.random.Generator, count: int) -> Array:
    """(count, 9, 51) errors of variance 1: independent, lasting, smooth, or shared by all angles."""
    if kind == "white":
        return rng.normal(size=(count, 9, 51))
    if kind == "smooth":
        noise = gaussian_filter1d(rng.normal(size=(count, 9, 51)), 4, axis=2, mode="wrap")
        return np.asarray(noise / noise.std())
    if kind == "lasting":
        return np.tile(rng.normal(size=(count, 9, 1)), 51)
    return np.tile(rng.normal(size=(count, 1, 1)), (9, 51))


@pytest.mark.parametrize("size", [0.0, 3.0, 12.0])
@pytest.mark.parametrize("kind", ["white", "smooth", "lasting", "shared"])
def test_bands_cover_and_the_stated_noise_is_the_bias(kind: str, size: float) -> None:
    rng, count, sigma = np.random.default_rng(4), 1500, np.radians(4.0)
    deviation = np.radians(size) * np.sin(np.arange(9)[:, None] + np.linspace(0, 5, 51))
    truth = np.sqrt(np.mean(deviation**2))
    observed = np.sqrt(np.mean((deviation + sigma * errors(kind, rng, count)) ** 2, axis=(1, 2)))
    score = gait_scores(cycles_of(BOTH, 4.0), means_only()).sides["right"]
    assert score.noise == pytest.approx(sigma)
    inside = np.abs(observed - truth) <= score.half_width
    assert inside.mean() >= 0.95 - 2.5 * np.sqrt(0.05 * 0.95 / count)
    excess = np.mean(observed**2) - truth**2
    assert excess == pytest.approx(sigma**2, rel=0.25, abs=3 * np.std(observed**2) / np.sqrt(count))


def test_lasting_shared_errors_alone_need_the_whole_band() -> None:
    rng = np.random.default_rng(5)
    observed = np.sqrt(np.mean(errors("shared", rng, 20_000) ** 2, axis=(1, 2)))
    assert (observed <= 1.959964).mean() == pytest.approx(0.95, abs=0.006)  # not more than 95 %


def test_strides_average_their_spread_and_not_the_errors_of_the_poses() -> None:
    rng = np.random.default_rng(6)
    curves = MEAN + np.radians(2) * rng.normal(size=(40, 9, 51))
    cycles = GaitCycles(("right",) * 40, curves, np.full(curves.shape, np.radians(4)), np.full(40, 1.2), "")
    score = gait_scores(cycles, means_only()).sides["right"]
    assert np.degrees(score.pose_sigma) == pytest.approx(4)
    assert np.degrees(score.stride_sigma) == pytest.approx(2 / np.sqrt(40), rel=0.03)
    assert score.stride_bound / score.stride_sigma == pytest.approx(2.0227 / 1.95996, rel=1e-4)
    assert score.strides == 40
    assert np.degrees(score.corrected) < 0.5


def test_a_motion_without_covariances_has_the_spread_between_strides_alone() -> None:
    found = gait_scores(cycles_of(BOTH), means_only())
    assert not found.has_bands
    assert np.isnan(found.overall.pose_sigma)
    assert found.overall.half_width == pytest.approx(0, abs=1e-12)


# --- index ---------------------------------------------------------------------------------------


def test_people_of_the_reference_have_mean_100_and_deviation_10() -> None:
    features = gait_features(reference_of(people_curves(25, 1)))
    index = features.index(features.distances)
    assert index.mean() == pytest.approx(100)
    assert index.std(ddof=1) == pytest.approx(10)


def test_other_healthy_people_have_the_same_index_and_deviating_ones_less() -> None:
    healthy, deviating = [], []
    for seed in range(10):
        features = gait_features(reference_of(people_curves(12, seed)))
        others = people_curves(20, 1000 + seed)
        for curves, found in ((others, healthy), (MEAN + 3 * (others - MEAN), deviating)):
            rows = curves.reshape(-1, 9 * 51) - features.mean
            found.append(features.index(np.linalg.norm(rows @ features.basis, axis=1)).mean())
    assert np.mean(healthy) == pytest.approx(100, abs=3.5)  # the scale by their own features gives 108
    assert np.mean(deviating) < 80


def test_doubling_the_distance_takes_a_known_step() -> None:
    features = gait_features(reference_of(people_curves(20, 1)))
    step = features.index(2.0) - features.index(1.0)
    assert step == pytest.approx(-10 * np.log(2) / features.log_sd)


def test_errors_widen_the_band_of_the_index_and_an_end_may_be_open() -> None:
    features = gait_features(reference_of(people_curves(20, 1)))
    one = people_curves(1, 9)[0]
    sure = deviation_index(side_curves(cycles_of(one, 0.1), "right"), features)
    unsure = deviation_index(side_curves(cycles_of(one, 8.0), "right"), features)
    assert sure.value == pytest.approx(unsure.value)
    assert unsure.low < sure.low < sure.value < sure.high < unsure.high == np.inf


def test_a_deviation_outside_of_the_features_is_said() -> None:
    features = gait_features(reference_of(people_curves(20, 1)))
    odd = np.array(BOTH) + np.radians(10) * np.sin(np.arange(51) * np.pi)
    spiky = np.array(BOTH)
    spiky[:, :, ::2] += np.radians(10)
    spiky[:, :, 1::2] -= np.radians(10)
    assert deviation_index(side_curves(cycles_of(spiky), "right"), features).explained < 0.2
    assert deviation_index(side_curves(cycles_of(odd), "right"), features).value > 0


def test_means_alone_and_few_people_give_no_index() -> None:
    with pytest.raises(InvalidInputError, match="means"):
        gait_features(means_only())
    with pytest.raises(InvalidInputError, match="4 people"):
        gait_features(reference_of(people_curves(4, 1)))


# --- reference -----------------------------------------------------------------------------------


def test_every_person_counts_once_however_many_strides() -> None:
    curves = people_curves(2, 1)
    people = {"a": cycles_of(curves[0], strides=30), "b": cycles_of(curves[1], strides=3)}
    reference, left_out = build_reference(people, licence="x", source="y", system="rtof_kin 0")
    np.testing.assert_allclose(reference.mean, curves.mean(axis=(0, 1)))
    assert reference.strides == ((30, 30), (3, 3))
    assert left_out == {}


def test_people_that_cannot_be_used_are_named_with_the_reason() -> None:
    good = {f"p{k}": cycles_of(one) for k, one in enumerate(people_curves(3, 1))}
    bad = {
        "few": cycles_of(BOTH, strides=1),
        "blind": without(cycles_of(BOTH), "foot_progression"),
        "dances": GaitCycles((), np.empty((0, 9, 51)), None, np.empty(0), "This is not steady walking."),
        "hops": GaitCycles(("right",) * 4, np.tile(MEAN, (4, 1, 1)), None, np.full(4, 1.0), ""),
    }
    reference, left_out = build_reference(good | bad, licence="x", source="y", system="rtof_kin 0")
    assert reference.people == 3
    assert set(left_out) == set(bad)
    assert "3 are needed" in left_out["few"]
    assert "sensor on the foot" in left_out["blind"]
    assert "steady" in left_out["dances"]
    assert "left" in left_out["hops"]
    with pytest.raises(InvalidInputError, match="two are needed"):
        build_reference(bad, licence="x", source="y", system="rtof_kin 0")
    with pytest.raises(InvalidInputError, match="licence"):
        build_reference(good, licence=" ", source="y", system="rtof_kin 0")


def test_people_are_scored_against_the_mean_of_the_others() -> None:
    curves = people_curves(6, 1)
    scores = people_scores(reference_of(curves))
    assert scores is not None
    others = np.delete(curves, 2, axis=0).mean(axis=(0, 1))
    assert scores[2, 0, -1] == pytest.approx(np.sqrt(np.mean((curves[2, 0] - others) ** 2)))
    assert people_scores(means_only()) is None


def test_recordings_of_one_person_are_joined() -> None:
    both = joined_cycles([cycles_of(BOTH, 2.0), cycles_of(BOTH, 4.0, strides=2)])
    assert len(both.sides) == 10
    assert both.sigma is not None
    assert np.degrees(side_curves(both, "left").pose_variance.max()) > 0
    assert joined_cycles([cycles_of(BOTH, 2.0), cycles_of(BOTH)]).sigma is None


# --- variables -----------------------------------------------------------------------------------


def value(cycles: GaitCycles, side: str, name: str) -> Array:
    return np.degrees(side_curves(cycles, side).mean[NAMES.index(name)])


@settings(deadline=None, max_examples=8)
@given(heading=st.floats(-3, 3), treadmill=st.booleans())
def test_planted_walking_has_no_rotation_whatever_its_direction(heading: float, treadmill: bool) -> None:
    cycles = gait_cycles(walking(4.0, heading=heading, treadmill=treadmill))
    assert cycles.why_not == ""
    for side in ("right", "left"):
        for name in ("pelvic_rotation", "foot_progression", "pelvic_obliquity"):
            np.testing.assert_allclose(value(cycles, side, name), 0, atol=0.3)
    straight = gait_cycles(walking(4.0))
    np.testing.assert_allclose(
        value(cycles, "right", "knee_flexion"), value(straight, "right", "knee_flexion"), atol=0.3
    )


@pytest.mark.parametrize("side, turned", [("right", 1.0), ("left", -1.0)])
@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_inward_foot_is_positive_on_either_side(side: str, turned: float, heading: float) -> None:
    skeleton = SkeletonModel.default()
    turn = so3.about_axis("z", heading)
    foot = so3.about_axis("z", turned * np.radians(12.0)) @ so3.about_axis("y", np.radians(35.0))
    poses = posture(skeleton, 2, body=turn, **{f"{side}_foot": foot})
    found = DecomposedAngles(skeleton, foot_table(skeleton.table), poses.times)
    found.add(slice(None), poses, slice(None), None)
    angles = angles_of(found, ObservationMasks.of_poses(poses, skeleton))
    mirror = 1 if side == "right" else -1
    rotation = np.degrees(angles[f"{side}_foot_rotation"] - mirror * heading)
    np.testing.assert_allclose((rotation + 180) % 360 - 180, 12.0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(angles[f"{side}_foot_pitch"]), -35.0, atol=1e-6)


def test_real_walking_has_the_curves_of_gait() -> None:
    cycles = gait_cycles(walk())
    assert cycles.why_not == ""
    for side in ("right", "left"):
        knee, hip = value(cycles, side, "knee_flexion"), value(cycles, side, "hip_flexion")
        assert 50 < knee.max() < 80
        assert 60 <= 2 * knee.argmax() <= 85  # in swing
        assert 40 <= 2 * hip.argmin() <= 65  # at push-off
        assert np.abs(value(cycles, side, "pelvic_rotation")).max() < 15
        assert np.abs(value(cycles, side, "foot_progression")[:25]).max() < 25  # stance


def test_standing_is_no_gait_and_has_no_score() -> None:
    skeleton = SkeletonModel.default()
    cycles = gait_cycles(skeleton.motion(posture(skeleton, 120)))
    assert cycles.why_not
    assert len(cycles.sides) == 0
