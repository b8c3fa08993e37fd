"""Standard deviations and reliability of clinical angles, and their files and figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from clinical_support import LEG, posture, write_analysis
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.clinical.decomposition import UNIFORM_SIGMA, angle_rates, decompose, reliable_samples, turns_too_fast
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PAIRS = tuple((joint.parent, joint.child) for joint in angle_table(BODY.table).joints)
DISTINCT = tuple(dict.fromkeys(PAIRS))
TIMES = np.arange(60) / 60


def motion(frames: int = 20) -> Motion:
    moving = planted.moving(BODY, frames)
    return replace(moving, poses=all_observed(moving.poses))


def with_covariance(given: Motion, turn: Array) -> Motion:
    """A motion in which all rotations have the same covariance."""
    T, J = given.poses.p_world_joint.shape[:2]
    zero, turns = np.zeros((T, J, 3, 3)), np.broadcast_to(turn, (T, len(DISTINCT), 3, 3))
    return replace(given, confidence=Confidence(given.times, BODY.names, zero, zero, DISTINCT, turns))


@pytest.mark.parametrize("parent, child", [p for p in DISTINCT if p[0] != "LeftForeArm"])
def test_sigmas_equal_the_spread_of_perturbed_rotations(parent: str, child: str) -> None:
    """One segment is rotated by samples of a known covariance in its own axes."""
    root = np.radians(0.05) * np.random.default_rng(0).normal(size=(3, 3))
    one = motion(1)
    expected = clinical_angles(with_covariance(one, root @ root.T))
    draws = 3000
    poses = one.poses
    R = np.repeat(poses.R_world_bone, draws, axis=0)
    errors = np.random.default_rng(1).normal(size=(draws, 3)) @ root.T
    c = BODY.names.index(child)
    R[:, c] = R[:, c] @ so3.exp(errors)
    p = np.repeat(poses.p_world_joint, draws, axis=0)
    many = all_observed(PoseSequence(np.arange(draws) / 60, p, R, BODY.names))
    scattered = clinical_angles(many, BODY)
    assert expected.sigma is not None
    rows = [i for i, pair in enumerate(PAIRS) if pair == (parent, child)]
    columns = [3 * i + k for i in rows for k in range(3)]
    found = np.std(scattered.values[:, columns], axis=0)
    np.testing.assert_allclose(found, expected.sigma[0, columns], rtol=0.06)


def test_angle_rates_are_derivatives() -> None:
    R = so3.exp(np.random.default_rng(0).normal(size=(5, 3)))
    e = 1e-5 * np.array([0.3, -0.5, 0.8])
    for sequence in ("zxy", "yxy", "xzy"):
        moved = decompose(sequence, R @ so3.exp(e)) - decompose(sequence, R)
        np.testing.assert_allclose(angle_rates(sequence, R) @ e, moved, rtol=1e-3, atol=1e-9)


def test_sigmas_are_at_most_those_of_a_uniform_angle() -> None:
    found = clinical_angles(with_covariance(motion(), 100 * np.eye(3))).sigma
    assert found is not None
    np.testing.assert_allclose(found[np.isfinite(found)], UNIFORM_SIGMA)


def test_unobserved_angles_have_no_sigma() -> None:
    whole = motion()
    whole = replace(whole, poses=replace(whole.poses, orientation_observed=np.zeros(21, dtype=bool)))
    found = clinical_angles(with_covariance(whole, 1e-4 * np.eye(3)))
    assert found.sigma is not None
    np.testing.assert_array_equal(np.isfinite(found.sigma), np.isfinite(found.values))
    assert np.isnan(found.values).any()


def test_segment_pairs_without_covariance_have_no_sigma() -> None:
    whole = with_covariance(motion(), 1e-4 * np.eye(3))
    assert whole.confidence is not None
    turn = whole.confidence.turn_covariance[:, :1]
    pelvis = replace(whole.confidence, pairs=((WORLD, "Hips"),), turn_covariance=turn)
    found = clinical_angles(replace(whole, confidence=pelvis))
    assert found.sigma is not None
    finite = {name for name, s in zip(found.names, found.sigma.T, strict=True) if np.isfinite(s).any()}
    assert finite == {name for name in found.names if name.startswith("pelvis")}
    assert clinical_angles(motion()).sigma is None


@pytest.mark.parametrize("value", [-0.1, np.inf])
def test_negative_or_infinite_sigmas_are_rejected(value: float) -> None:
    rows = angle_table(BODY.table).rows[:1]
    with pytest.raises(InvalidInputError, match="angle sigma"):
        ClinicalAngles(
            np.zeros(1),
            np.zeros((1, 1)),
            np.zeros((1, 1), np.uint8),
            np.zeros((1, 1), bool),
            rows,
            sigma=np.full((1, 1), value),
        )


def test_files_have_the_bands(tmp_path: Path) -> None:
    analysis = analyse(with_covariance(motion(), np.radians(2.0) ** 2 * np.eye(3)))
    write_analysis(analysis, tmp_path)
    columns = read_csv(tmp_path / "angles.csv")
    assert columns["pelvis_tilt_sigma_deg"][3] == pytest.approx(2.0, rel=0.05)


def reliable(sigma: Array | None, hip: Array | None = None) -> tuple[NDArray[np.bool_], str]:
    """Reliable samples of known angles, with unknown rotations except those of the left hip."""
    table = angle_table(BODY.table)
    R = {joint.name: np.full((len(TIMES), 3, 3), np.nan) for joint in table.joints}
    R |= {} if hip is None else {"left_hip": hip}
    too_fast = np.stack([turns_too_fast(joint, TIMES, R[joint.name]) for joint in table.joints], axis=1)
    known = np.ones((len(TIMES), len(table.rows)), dtype=bool)
    return reliable_samples(table, TIMES, too_fast, sigma, known)


def test_uncertain_samples_are_excluded_from_ranges() -> None:
    lifted = so3.about_axis("y", -np.radians(60) * np.sin(np.pi * TIMES) ** 2)
    leg = {f"left_{segment}": lifted for segment in LEG}
    angles = clinical_angles(replace(posture(BODY, len(TIMES), **leg), times=TIMES), BODY)
    sigma = np.radians(np.where(np.abs(TIMES - 0.5) < 0.1, 20.0, 5.0))
    trusted, note = reliable(np.tile(sigma[:, None], (1, len(angles.rows))))
    assert "0.40 to 0.60 s" in note
    hip, whole = (
        next(row for row in ranges_of_motion(own) if row.name == "left_hip_flexion")
        for own in (replace(angles, trusted=trusted), replace(angles, trusted=None))
    )
    assert np.degrees(whole.range) == pytest.approx(60, abs=1)
    assert np.degrees(hip.range) < 56
    assert abs(hip.time_high - 0.5) >= 0.1 - 1e-9
    assert hip.trusted_share == pytest.approx(1 - 0.2, abs=0.03)
    assert (hip.known_share, whole.trusted_share) == (1, 1)


@pytest.mark.parametrize("speed_deg_s", [900.0, 1700.0])
def test_samples_around_implausibly_fast_turns_are_unreliable(speed_deg_s: float) -> None:
    angle = np.radians(speed_deg_s) * np.clip(TIMES - 0.5, 0.0, 0.1)
    found, note = reliable(None, so3.about_axis("z", angle))
    fast = speed_deg_s > 1200.0
    assert found.all() == (not fast)
    assert ("left_hip" in note) == fast
    if fast:
        assert found[TIMES < 0.35].all()
        assert (~found[(TIMES > 0.45) & (TIMES < 0.65)]).any(axis=1).all()


def test_gaps_and_unknown_sigmas_are_reliable() -> None:
    R = so3.about_axis("z", np.where(TIMES > 0.5, 3.0, 0.0))
    R[30:32] = np.nan
    assert reliable(None, R)[0].all()
    assert reliable(np.full((len(TIMES), 51), np.nan))[0].all()
