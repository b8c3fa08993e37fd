"""Standard deviations of clinical angles: against perturbed rotations, and in the files and figures."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.analysis import analyse_motion
from rtof_kin.clinical.angle_confidence import NOTHING_KNOWN, angle_rates
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.clinical.files import write_analysis
from rtof_kin.clinical.joint_coordinate_systems import decompose
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.report.clinical_figures import angles_over_time

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PAIRS = tuple((joint.parent, joint.child) for joint in angle_table(BODY.table).joints)
DISTINCT = tuple(dict.fromkeys(PAIRS))


def motion(frames: int = 20) -> MotionSequence:
    moving = planted.moving(BODY, frames)
    return replace(moving, poses=all_observed(moving.poses))


def known(given: MotionSequence, turn: Array) -> MotionSequence:
    """With the same covariance of every turn."""
    T, J = given.poses.p_world_joint.shape[:2]
    zero, turns = np.zeros((T, J, 3, 3)), np.broadcast_to(turn, (T, len(DISTINCT), 3, 3))
    return replace(given, confidence=Confidence(given.times, BODY.names, zero, zero, DISTINCT, turns))


@pytest.mark.parametrize("parent, child", [p for p in DISTINCT if p[0] != "LeftForeArm"])
def test_angles_of_turned_segments_scatter_as_their_sigmas_say(parent: str, child: str) -> None:
    """One segment alone turns, by draws of a known covariance, in its own axes."""
    root = np.radians(0.05) * np.random.default_rng(0).normal(size=(3, 3))
    one = motion(1)
    expected = clinical_angles(known(one, root @ root.T))
    draws = 3000
    poses = one.poses
    R = np.repeat(poses.R_world_bone, draws, axis=0)
    errors = np.random.default_rng(1).normal(size=(draws, 3)) @ root.T
    c = BODY.names.index(child)
    R[:, c] = R[:, c] @ so3.exp(errors)
    many = replace(
        poses, times=np.arange(draws) / 60, p_world_joint=np.repeat(poses.p_world_joint, draws, axis=0),
        R_world_bone=R, provenance=None, valid=None, orientation_observed=np.ones(21, dtype=bool),
        direction_observed=None, sigma_rad=None,
    )  # fmt: skip
    scattered = clinical_angles(many, BODY)
    assert expected.sigma is not None
    rows = [i for i, pair in enumerate(PAIRS) if pair == (parent, child)]
    columns = [3 * i + k for i in rows for k in range(3)]
    found = np.std(scattered.values[:, columns], axis=0)
    np.testing.assert_allclose(found, expected.sigma[0, columns], rtol=0.06)


def test_rates_are_derivatives_of_the_angles() -> None:
    R = so3.exp(np.random.default_rng(0).normal(size=(5, 3)))
    e = 1e-5 * np.array([0.3, -0.5, 0.8])
    for sequence in ("zxy", "yxy", "xzy"):
        moved = decompose(sequence, R @ so3.exp(e)) - decompose(sequence, R)
        np.testing.assert_allclose(angle_rates(sequence, R) @ e, moved, rtol=1e-3, atol=1e-9)


def test_nobody_knows_less_of_an_angle_than_that_it_is_somewhere() -> None:
    found = clinical_angles(known(motion(), 100 * np.eye(3))).sigma
    assert found is not None
    np.testing.assert_allclose(found[np.isfinite(found)], NOTHING_KNOWN)


def test_an_angle_that_is_not_known_has_no_sigma() -> None:
    whole = motion()
    whole = replace(whole, poses=replace(whole.poses, orientation_observed=np.zeros(21, dtype=bool)))
    found = clinical_angles(known(whole, 1e-4 * np.eye(3)))
    assert found.sigma is not None
    np.testing.assert_array_equal(np.isfinite(found.sigma), np.isfinite(found.values))
    assert np.isnan(found.values).any()


def test_pairs_that_are_not_told_of_are_nan_and_a_motion_without_confidence_has_none() -> None:
    whole = known(motion(), 1e-4 * np.eye(3))
    assert whole.confidence is not None
    turn = whole.confidence.turn_covariance[:, :1]
    pelvis = replace(whole.confidence, pairs=((WORLD, "Hips"),), turn_covariance=turn)
    found = clinical_angles(replace(whole, confidence=pelvis))
    assert found.sigma is not None
    known_ = {name for name, s in zip(found.names, found.sigma.T, strict=True) if np.isfinite(s).any()}
    assert known_ == {name for name in found.names if name.startswith("pelvis")}
    assert clinical_angles(motion()).sigma is None


def test_selected_angles_keep_their_sigmas() -> None:
    found = clinical_angles(known(motion(), 1e-4 * np.eye(3)))
    chosen = found.select(["left_knee_flexion", "pelvis_tilt"])
    assert found.sigma is not None
    assert chosen.sigma is not None
    at = [found.names.index(name) for name in chosen.names]
    np.testing.assert_array_equal(chosen.sigma, found.sigma[:, at])


@pytest.mark.parametrize("value", [-0.1, np.inf])
def test_a_sigma_that_is_none_is_refused(value: float) -> None:
    rows = angle_table(BODY.table).rows[:1]
    with pytest.raises(ShapeError, match="angle sigma: negative or infinite; write NaN"):
        ClinicalAngles(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1), np.uint8), np.zeros((1, 1), bool),
                       rows, sigma=np.full((1, 1), value))  # fmt: skip


def test_files_and_figures_have_the_bands(tmp_path: Path) -> None:
    analysis = analyse_motion(known(motion(), np.radians(2.0) ** 2 * np.eye(3)))
    write_analysis(analysis, tmp_path)
    with (tmp_path / "angles.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[3]["pelvis_tilt_sigma_deg"]) == pytest.approx(2.0, rel=0.05)
    figure = angles_over_time(analysis)
    assert any(ax.collections for ax in figure.axes)
    assert "95 %" in figure.get_suptitle()
    assert not any(ax.collections for ax in angles_over_time(analyse_motion(motion())).axes)
