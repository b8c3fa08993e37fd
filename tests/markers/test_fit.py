"""Planted bodies, marker places and movements are recovered; what does not fit is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marker_support import PLUG_IN_GAIT, Planted, planted

from rtof_kin.body import metrics
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.markers.fit import MarkerBody, fit_body, marker_residuals, track

LIMBS = tuple(side + part for side in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot", "ForeArm", "Hand"))


@pytest.fixture(scope="module")
def truth() -> Planted:
    return planted(1)


@pytest.fixture(scope="module")
def body(truth: Planted) -> MarkerBody:
    return fit_body([truth.markers], frames=120)


@pytest.fixture(scope="module")
def motion(truth: Planted, body: MarkerBody) -> Motion:
    return track(truth.markers, body)


def test_joint_centres_lie_within_a_centimetre_where_markers_have_noise_of_5_mm(truth: Planted, motion: Motion) -> None:
    columns = motion.skeleton.index(*LIMBS)
    apart = np.linalg.norm(motion.poses.p_world_joint - truth.p, axis=-1)[:, columns]
    assert np.sqrt(np.mean(apart**2)) < 0.0075
    assert np.sqrt(np.mean(apart**2, axis=0)).max() < 0.012


def test_knee_and_elbow_flexion_are_within_two_degrees(truth: Planted, motion: Motion) -> None:
    hinges = metrics.hinges(truth.skeleton)
    found, true = (metrics.flexion(p, truth.skeleton) for p in (motion.poses.p_world_joint, truth.p))
    error = np.degrees(found - true)[:, hinges]
    assert np.sqrt(np.mean(error**2)) < 1.6
    assert np.max(np.abs(np.mean(error, axis=0))) < 2.0


def test_bone_lengths_are_recovered(truth: Planted, body: MarkerBody) -> None:
    for name in ("LeftLeg", "RightLeg", "LeftFoot", "RightFoot", "LeftForeArm", "RightHand"):
        assert body.skeleton.bone_lengths[name] == pytest.approx(truth.skeleton.bone_lengths[name], abs=0.012)


def test_left_out_markers_are_predicted(truth: Planted) -> None:
    """The place of a marker from half of the frames predicts it in the other half."""
    names = [name for name in PLUG_IN_GAIT if name not in ("LTIB", "RFRM", "LBHD")]
    columns = [PLUG_IN_GAIT.index(name) for name in names]
    fewer = MarkerSequence(truth.markers.times, tuple(names), truth.markers.p_world[:, columns])
    body = fit_body([fewer], frames=100)
    poses, half = track(fewer, body).poses, len(truth.p) // 2
    for name in ("LTIB", "RFRM", "LBHD"):
        segment = truth.skeleton.names.index(truth.places.segments[PLUG_IN_GAIT.index(name)])
        seen = truth.markers.p_world[:, PLUG_IN_GAIT.index(name)]
        own = np.einsum("tji,tj->ti", poses.R_world_bone[:, segment], seen - poses.p_world_joint[:, segment])
        assert np.sqrt(np.mean(np.sum((own[half:] - own[:half].mean(axis=0)) ** 2, axis=-1))) < 0.018


@pytest.mark.parametrize("scale", [0.65, 1.15])
def test_children_and_tall_people_are_fitted_at_their_size(scale: float) -> None:
    truth = planted(2, frames=100, scale=scale)
    body = fit_body([truth.markers], frames=50)
    assert body.skeleton.height == pytest.approx(truth.skeleton.height, rel=0.04)
    moved = track(truth.markers, body)
    columns = moved.skeleton.index(*LIMBS)
    apart = np.linalg.norm(moved.poses.p_world_joint - truth.p, axis=-1)[:, columns]
    assert np.sqrt(np.mean(apart**2)) < 0.011


def test_gaps_are_bridged_and_frames_without_markers_are_not_valid(truth: Planted, body: MarkerBody) -> None:
    p = np.array(truth.markers.p_world)
    p[60:70] = np.nan
    p[100:160, PLUG_IN_GAIT.index("LKNE")] = np.nan
    motion = track(replace(truth.markers, p_world=p), body)
    assert not motion.poses.valid[60:70].any()
    assert motion.poses.valid[100:160].all()
    knee = motion.skeleton.names.index("LeftLeg")
    apart = np.linalg.norm(motion.poses.p_world_joint - truth.p, axis=-1)
    assert apart[100:160, knee].max() < 0.03
    assert apart[60:70].max() < 0.15


def test_a_marker_of_a_standing_trial_alone_and_one_that_is_never_seen(truth: Planted) -> None:
    """The body takes what each trial has; a trial of one frame is solved too."""
    walking = np.array(truth.markers.p_world)
    walking[:, PLUG_IN_GAIT.index("LKNE")] = walking[:, PLUG_IN_GAIT.index("T10")] = np.nan
    standing = np.array(truth.markers.p_world[:1])
    standing[:, PLUG_IN_GAIT.index("T10")] = np.nan
    trials = [replace(truth.markers, p_world=walking), replace(truth.markers[:1], p_world=standing)]
    body = fit_body(trials, frames=40)
    assert "LKNE" in body.places.names
    assert "T10" not in body.places.names
    apart = np.linalg.norm(track(trials[1], body).poses.p_world_joint - truth.p[:1], axis=-1)
    assert np.median(apart) < 0.02


def test_an_exchanged_marker_is_named_and_hardly_moves_the_rest(truth: Planted) -> None:
    p = np.array(truth.markers.p_world)
    p[:, PLUG_IN_GAIT.index("LANK")] = p[:, PLUG_IN_GAIT.index("RTOE")] + 0.05  # labels exchanged
    wrong = replace(truth.markers, p_world=p)
    body = fit_body([wrong], frames=60)
    assert list(body.left_out) == ["LANK"]
    assert not body.doubtful
    motion = track(wrong, body)
    knee = motion.skeleton.names.index("LeftLeg")
    assert np.median(np.linalg.norm(motion.poses.p_world_joint - truth.p, axis=-1)[:, knee]) < 0.015


def test_residuals_are_those_of_the_noise(truth: Planted, body: MarkerBody, motion: Motion) -> None:
    residuals = marker_residuals(truth.markers, body, motion)
    assert residuals.shape == (len(truth.p), 39)
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(0.005 * np.sqrt(3), rel=0.25)


def test_what_is_no_person_is_refused(truth: Planted) -> None:
    with pytest.raises(CalibrationError, match=r"is the unit of the file right\?"):
        fit_body([replace(truth.markers, p_world=truth.markers.p_world * 10)])
    rng = np.random.default_rng(0)
    shuffled = replace(truth.markers, names=tuple(rng.permutation(truth.markers.names)))
    with pytest.raises(CalibrationError, match="the markers fit no body|is the unit"):
        fit_body([shuffled], frames=40)
    gone = np.array(truth.markers.p_world)
    gone[:, PLUG_IN_GAIT.index("LASI")] = gone[:, PLUG_IN_GAIT.index("LPSI")] = np.nan
    with pytest.raises(CalibrationError, match="three markers of the pelvis"):
        fit_body([replace(truth.markers, p_world=gone)])
    with pytest.raises(InvalidInputError, match="trials: none"):
        fit_body([])
