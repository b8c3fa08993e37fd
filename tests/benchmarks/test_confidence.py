"""The study of the bands: what it fits, counts and shows, on errors of known size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks import harness
from benchmarks.confidence import __main__ as command
from benchmarks.confidence.cases import Case, angle_errors, errors
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import fitted, sharpest
from benchmarks.confidence.motions import FITTED_ON, person
from benchmarks.confidence.study import NOMINAL, honest, rows
from benchmarks.confidence.tables import report
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.joint_space.covariance import segment_pairs
from rtof_kin.solve.uncertainty.covariance_inflation import (
    OTHER,
    SEEN,
    CovarianceInflation,
    ResidualStatistics,
    Widening,
    correlated_factor,
)
from rtof_kin.solve.uncertainty.disagreement import disagreement

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PAIRS = segment_pairs(BODY)
CARRIERS = {"0": (), "8": ("LeftUpLeg", "LeftLeg"), "10": ("Hips", "LeftUpLeg", "LeftLeg")}
SIGMA_M, SIGMA_RAD = 0.01, np.radians(1.0)


def case(number: int, sensors: str = "8", sigma: float = 1.0) -> Case:
    """Somebody whose estimate is off by white errors; what is told of these is `sigma` times as large.

    Positions and orientations are off independently, all joints' positions alike but the root's.
    """
    rng = np.random.default_rng(number)
    truth = all_observed(planted.moving(BODY, 150, number).poses)
    T, J = truth.p_world_joint.shape[:2]
    p = truth.p_world_joint + SIGMA_M * rng.normal(size=(T, J, 3))
    R = truth.R_world_bone @ so3.exp(SIGMA_RAD * rng.normal(size=(T, J, 3)))
    poses = PoseSequence(truth.times, p, R, BODY.names, orientation_observed=np.ones(J, dtype=bool))
    one = np.tile(np.eye(3), (T, J, 1, 1)) * (sigma * SIGMA_M) ** 2
    twice = np.array([1.0 if parent == "world" else 2.0 for parent, _ in PAIRS])
    turn = np.tile(np.eye(3), (T, len(PAIRS), 1, 1)) * twice[:, None, None] * (sigma * SIGMA_RAD) ** 2
    told = Confidence(truth.times, BODY.names, one, 2 * one, PAIRS, turn)
    q = np.tile(BODY.t_pose(), (T, 1))
    motion = MotionSequence(BODY, q, poses, BODY.check(q), told)
    apart = disagreement(poses, poses, PAIRS)
    told_of = ResidualStatistics(CARRIERS[sensors])
    return Case(f"m{number}/0", "realistic", sensors, told_of, motion, truth, apart)


def as_told() -> CovarianceInflation:
    return CovarianceInflation({
        who: {kind: {OTHER: Widening(1.0, 0.0)} for kind in kinds} for who, kinds in SEEN.items()
    })  # fmt: skip


def test_bands_of_the_right_width_cover_what_they_are_meant_to() -> None:
    for row in rows([case(i) for i in range(4)], as_told()):
        for share in NOMINAL:
            assert row["coverage"][f"{share:g}"] == pytest.approx(share, abs=0.05), row["name"]
        if row["kind"] != "angle":  # of which some are near a singular posture at times
            assert row["ratio"] == pytest.approx(3.92, abs=0.1)
        low, high = row["interval"]
        assert low <= row["coverage"]["0.95"] <= high
        assert row["recordings"] in (4, 8)


@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_bands_that_are_too_narrow_or_too_wide_are_not_honest(sigma: float) -> None:
    found = rows([case(i, sigma=sigma) for i in range(2)], as_told())
    assert not any(honest(row) for row in found)
    assert all((row["coverage"]["0.95"] < 0.9) == (sigma < 1) for row in found)


def test_errors_of_a_truth_against_itself_are_nothing() -> None:
    given = case(0)
    exact = replace(given, circumstances=ResidualStatistics(), truth=given.motion.poses)
    for kind, name, both in errors(exact):
        assert np.abs(both.error).max(initial=0.0) < 1e-6, (kind, name)
    assert given.motion.confidence is not None
    for name, off, _ in angle_errors(exact, given.motion.confidence):
        assert np.abs(off).max() < 1e-6, name


def test_the_fit_finds_by_how_much_the_hessian_is_too_sure() -> None:
    cases = [case(0, sensors, 1 / 3) for sensors in CARRIERS]
    found = fitted(cases)
    for row in rows(cases, found):
        assert 0.9 < row["coverage"]["0.95"] < 0.98, row
    hips = found.widenings["fused"]["position"]["Hips"]
    assert np.hypot(hips.factor[0] * SIGMA_M / 3, hips.floor[0]) == pytest.approx(SIGMA_M, rel=0.1)
    assert set(found.widenings["sensed"]["turn"]) == {
        "world Hips", "world UpLeg", "world Leg", "Hips UpLeg", "UpLeg Leg", OTHER
    }  # fmt: skip


@pytest.mark.parametrize("factor, floor", [(3.0, 0.02), (1.0, 0.05), (5.0, 1e-3)])
def test_a_planted_factor_and_floor_are_recovered(factor: float, floor: float) -> None:
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.001, 0.1, 40000) ** 2
    error = np.sqrt(factor**2 * variance + floor**2) * rng.normal(size=len(variance))
    one = np.ones(len(variance))
    found = sharpest(error, variance, one, one, 0 * one, 1e-3)[:2]
    assert found == pytest.approx((factor, floor), rel=0.05, abs=2e-3)


def test_they_are_recovered_from_recordings_that_tell_different_things_of_themselves() -> None:
    rng = np.random.default_rng(1)
    variance = rng.uniform(0.01, 0.1, 40000) ** 2
    lasting, doubt = rng.uniform(0.0, 1.0, 40000), rng.uniform(0.5, 2.0, 40000)
    size = np.sqrt(correlated_factor(3.0, lasting) ** 2 * variance + (0.05 * lasting * doubt) ** 2)
    error = size * rng.normal(size=len(size))
    found = sharpest(error, variance, lasting, doubt, 0 * size, 1e-3)[:2]
    assert found == pytest.approx((3.0, 0.05), rel=0.1)


def test_the_share_is_that_by_which_errors_follow_the_distance_from_the_start() -> None:
    """Errors have half the size of a distance that differs from frame to frame; the root is exact."""
    rng, given = np.random.default_rng(7), case(3, "0", 0.01)
    along = np.array([0.2, -0.1, 0.1]) * np.exp(rng.normal(size=(150, 21, 1)))
    along[:, 0] = 0.0
    p = given.truth.p_world_joint + 0.5 * rng.normal(size=(150, 21, 1)) * along
    poses = replace(given.motion.poses, p_world_joint=p)
    apart = disagreement(poses, replace(poses, p_world_joint=p - along), PAIRS, window=0.0)
    cases = [case(3, sensors) for sensors in CARRIERS]
    cases[0] = replace(given, motion=replace(given.motion, poses=poses), apart=apart)
    found = fitted(cases)
    assert found.shares["camera"]["position"] == pytest.approx(0.5, abs=0.06)
    assert found.shares["camera"]["relative"] == pytest.approx(0.5, abs=0.06)


def test_a_freedom_that_the_model_has_not_is_told_by_its_floor_alone() -> None:
    error, one = 0.2 * np.random.default_rng(0).normal(size=5000), np.ones(5000)
    assert sharpest(error, 0 * one, one, one, 0 * one, 1e-3)[:2] == pytest.approx((1.0, 0.2), rel=0.05)


def test_nobody_of_the_test_is_among_those_who_are_fitted_on() -> None:
    split = harness.split()
    assert not {*FITTED_ON} & {*split["test"], *split["excluded"]}
    names = {name for motions in FITTED_ON.values() for name in motions}
    assert not names & {*split["benchmark"]["motions"]}


def test_the_report_sets_apart_what_is_not_honest_and_the_figure_is_drawn(tmp_path: Path) -> None:
    found = rows([case(0), case(1), case(2, "0", 0.3)], as_told())
    text = report(found, "Here.")
    line = next(line for line in text.splitlines() if line.startswith("| Head |"))
    narrow, right = (cell for cell in line.split(" | ")[1:] if "%" in cell)
    cells = {"**" in narrow, "**" in right}
    assert cells == {True, False}
    assert "| realistic | 0 | 0 of 14 | 0 of 13 |" in text
    reliability(found, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20000


def test_results_are_written_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = rows([case(0)], as_told())
    command.write(found, tmp_path / "deep" / "a.json", report(found, "Here."))
    assert sorted(path.name for path in (tmp_path / "deep").iterdir()) == ["a.json", "a.md", "a.png"]
    assert "Here." in capsys.readouterr().out


def test_who_is_held_out_is_told_by_what_the_others_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    fits: dict[tuple[int, ...], CovarianceInflation] = {}

    def once(cases: Sequence[Case]) -> CovarianceInflation:
        key = tuple(map(id, cases))
        if key not in fits:
            fits[key] = fitted(cases)
        return fits[key]

    monkeypatch.setattr(command, "fitted", once)
    fair, sure = ([case(i, sensors, told) for sensors in CARRIERS] for i, told in ((0, 1.0), (1, 0.2)))
    found = command.held_out([*fair, *sure], lambda motion: motion)
    swapped = zip(rows(fair, once(sure)), rows(sure, once(fair)), strict=True)
    for row, (wide, narrow) in zip(found, swapped, strict=True):
        shares = [one["coverage"]["0.95"] for one in (narrow, wide)]
        assert row["coverage"]["0.95"] == pytest.approx(np.mean(shares), abs=1e-9)
        if row["kind"] == "position":
            assert shares[0] < 0.7 < 0.99 < shares[1]
            assert row["interval"] == pytest.approx(shares, abs=0.01)  # over people


def test_every_motion_of_the_fit_is_somebodys() -> None:
    assert person("05_12") == "CMU005"
    assert person("01_14[0:1516]-2") == "CMU001"
    with pytest.raises(KeyError):
        person("02_04")
