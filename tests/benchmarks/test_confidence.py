"""The study of the bands: what it fits, counts and shows, on errors of known size."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks import harness
from benchmarks.confidence.cases import Case
from benchmarks.confidence.curves import (
    LEVEL,
    Curve,
    as_toml,
    conformal_quantile,
    coverage,
    curve_factors,
    curves,
    section,
    split_file,
)
from benchmarks.confidence.figure import reliability
from benchmarks.confidence.fitting import fitted, sharpest
from benchmarks.confidence.motions import EXERCISES, FITTED_ON, SAME_PEOPLE, curve_people
from benchmarks.confidence.sharpness import sharpness
from benchmarks.confidence.study import NOMINAL, rows
from benchmarks.confidence.tables import report
from lifting.training.corpus import Corpus
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.joint_space.covariance import segment_pairs
from rtof_kin.solve.uncertainty import (
    OTHER,
    SEEN,
    CovarianceInflation,
    CurveFactors,
    ResidualStatistics,
    Widening,
    disagreement,
)

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PAIRS = segment_pairs(BODY)
CARRIERS = {"0": (), "8": ("LeftUpLeg", "LeftLeg"), "10": ("Hips", "LeftUpLeg", "LeftLeg")}
SIGMA_M, SIGMA_RAD = 0.01, np.radians(1.0)


def case(number: int, sensors: str = "8", sigma: float = 1.0) -> Case:
    """A case with white errors, and a stated sigma `sigma` times as large.

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
    stated = Confidence(truth.times, BODY.names, one, 2 * one, PAIRS, turn)
    q = np.tile(BODY.t_pose(), (T, 1))
    motion = Motion(BODY, q, poses, BODY.check(q), stated)
    apart = disagreement(poses, poses, stated)
    told_of = ResidualStatistics(CARRIERS[sensors])
    away = truth.p_world_joint + np.array([0.0, 4.0, 0.0])
    return Case(f"m{number}/0", "realistic", sensors, told_of, motion, truth, apart, away, "a rig")


def as_stated() -> CovarianceInflation:
    return CovarianceInflation(
        {who: {kind: {OTHER: Widening(1.0, 0.0)} for kind in kinds} for who, kinds in SEEN.items()}
    )


def test_exact_bands_have_their_coverage() -> None:
    for row in rows([case(i) for i in range(4)], as_stated()):
        for share in NOMINAL:
            assert row["coverage"][f"{share:g}"] == pytest.approx(share, abs=0.05), row["name"]
        if row["kind"] != "angle":  # of which some are near a singular posture at times
            assert row["ratio"] == pytest.approx(3.92, abs=0.1)
        low, high = row["interval"]
        assert low <= row["coverage"]["0.95"] <= high
        assert row["recordings"] in (4, 8)


def test_the_fit_recovers_the_inflation() -> None:
    cases = [case(0, sensors, 1 / 3) for sensors in CARRIERS]
    found = fitted(cases)
    for row in rows(cases, found):
        assert 0.9 < row["coverage"]["0.95"] < 0.98, row
    hips = found.widenings["fused"]["position"]["Hips"]
    assert np.hypot(hips.factor[0] * SIGMA_M / 3, hips.floor[0]) == pytest.approx(SIGMA_M, rel=0.1)
    assert set(found.widenings["sensed"]["turn"]) == {
        "world Hips",
        "world UpLeg",
        "world Leg",
        "Hips UpLeg",
        "UpLeg Leg",
        OTHER,
    }


@pytest.mark.parametrize("factor, floor", [(3.0, 0.02), (1.0, 0.05), (5.0, 1e-3)])
def test_a_planted_factor_and_floor_are_recovered(factor: float, floor: float) -> None:
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.001, 0.1, 40000) ** 2
    error = np.sqrt(factor**2 * variance + floor**2) * rng.normal(size=len(variance))
    one = np.ones(len(variance))
    found = sharpest(error, variance, one, one, least=1e-3)
    assert found == pytest.approx((factor, floor), rel=0.05, abs=2e-3)


def test_errors_in_proportion_to_the_distance_from_the_camera_are_recovered() -> None:
    share, rng = 0.03, np.random.default_rng(0)
    cases = []
    for number, sensors in product(range(4), CARRIERS):
        own = case(number, sensors)
        away = own.p_camera_joint * rng.uniform(0.5, 3.0)
        off = share * rng.normal(size=away.shape[:2])[..., None] * away
        poses = replace(own.motion.poses, p_world_joint=own.motion.poses.p_world_joint + off)
        cases.append(replace(own, motion=replace(own.motion, poses=poses), p_camera_joint=away))
    found = fitted(cases)
    assert found.depths["fused"] == pytest.approx(share, rel=0.1)
    assert found.depths["camera"] == pytest.approx(share, rel=0.1)


def test_sharpness_tells_a_varying_sigma_from_a_constant_one() -> None:
    """Errors of one size: the constant band is as good; of two sizes: the stated one is narrower."""
    alike, near, far = case(0), case(2), case(4)
    poses, told = near.motion.poses, near.motion.confidence
    assert told is not None
    true = near.truth.p_world_joint
    poses = replace(poses, p_world_joint=true + 5 * (poses.p_world_joint - true))
    wide = replace(told, position_covariance=25 * told.position_covariance)
    near = replace(near, motion=replace(near.motion, poses=poses, confidence=wide))
    same, different = (
        next(row for row in sharpness(own, as_stated()) if (row["rig"], row["kind"]) == ("all", "position"))
        for own in ([alike, far], [near, far])
    )
    assert same["inside"] == pytest.approx(0.95, abs=0.01)
    assert same["constant"] == pytest.approx(same["half_width"], rel=0.03)
    assert different["inside"] == pytest.approx(0.95, abs=0.01)
    assert different["constant"] > 1.2 * different["half_width"]
    assert different["stated"] == pytest.approx(different["actual"], rel=0.05)


def test_fit_and_test_subjects_are_disjoint() -> None:
    split = harness.split()
    assert not {*FITTED_ON, *EXERCISES} & {*split["test"], *split["validation"]}
    names = {name for motions in FITTED_ON.values() for name in motions}
    assert not names & {*split["benchmark"]["motions"]}


def test_the_report_marks_wrong_bands_and_the_figure_is_drawn(tmp_path: Path) -> None:
    found = rows([case(0), case(1), case(2, "0", 0.3)], as_stated())
    text = report(found, "Here.")
    line = next(line for line in text.splitlines() if line.startswith("| Head |"))
    narrow, right = (cell for cell in line.split(" | ")[1:] if "%" in cell)
    cells = {"**" in narrow, "**" in right}
    assert cells == {True, False}
    assert "| realistic | 0 | 0 of 14 | 0 of 13 |" in text
    reliability(found, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20000


def test_planted_scores_have_their_quantile() -> None:
    scores = [np.array([float(i)]) for i in range(1, 20)]  # 19 people: 18 of 20 are nine tenths
    assert conformal_quantile(scores) == 18.0
    assert conformal_quantile(scores[:9]) == 9.0
    assert conformal_quantile(scores[:8]) == np.inf  # 8 of 9 are less than nine tenths


def test_a_person_of_many_recordings_counts_once() -> None:
    one = [np.array([1.0])] * 18
    loud = np.full(1000, 50.0)
    assert conformal_quantile([*one, loud]) == 1.0
    assert conformal_quantile([*one[:17], loud, loud]) == 50.0
    half = np.array([1.0, 50.0])
    assert conformal_quantile([*one[:17], half, half]) == 1.0


def test_coverage_of_new_people_is_the_level_with_the_stated_slack() -> None:
    rng = np.random.default_rng(0)
    n, m, draws = 21, 4, 4000
    person = np.exp(0.4 * rng.normal(size=(draws, n + 1, 1)))  # people differ, and recordings of each
    scores = person * np.exp(0.3 * rng.normal(size=(draws, n + 1, m)))
    inside = [new[0] <= conformal_quantile(list(known)) for *known, new in scores]
    assert LEVEL - 0.01 < np.mean(inside) < LEVEL + (1 + 1 / m) / (n + 1) + 0.01


def found(scores: dict[str, float], angle: str = "knee_flexion", sensors: int = 8) -> list[Curve]:
    return [Curve(person, sensors, angle, score, 2.0) for person, score in scores.items()]


def test_angles_of_too_few_people_have_no_factor() -> None:
    many, few = ({f"p{i}": 1.0 + i for i in range(count)} for count in (19, 8))
    factors = curve_factors([*found(many), *found(few, "wrist_flexion")], "clips")
    assert (factors.people, factors.factors) == (19, {8: {"knee_flexion": 18.0}})
    assert factors.factor("right_wrist_flexion", 8) is None


def test_a_curve_has_its_largest_error_and_sides_are_pooled() -> None:
    own, (shank,) = case(0), BODY.index("LeftLeg")
    R = own.motion.poses.R_world_bone.copy()
    R[70, shank] = R[70, shank] @ so3.exp(np.array([0.0, 0.5, 0.0]))  # of one frame of 150
    spoiled = replace(own, motion=replace(own.motion, poses=replace(own.motion.poses, R_world_bone=R)))
    knees = [
        [one for one in curves(of, "p", as_stated()) if one.angle == "knee_flexion"] for of in (own, spoiled, own[::4])
    ]
    right, left = knees[0]
    assert 2.0 < min(right.score, left.score) <= max(right.score, left.score) < 6.0  # the largest of normal errors
    scores = sorted(one.score for one in knees[1])
    assert scores[0] in (right.score, left.score)
    assert scores[1] > 15.0
    assert right.sigma_deg == pytest.approx(np.sqrt(2), rel=0.1)
    assert [one.score <= max(right.score, left.score) for one in knees[2]] == [True, True]
    assert not list(curves(own[:20], "p", as_stated()))  # a third of a second


def test_frames_of_a_case_are_those_of_all_its_parts() -> None:
    own = case(0)[::4]
    assert own.motion.confidence is not None
    parts = (own.truth, own.motion.poses, own.motion.confidence, own.p_camera_joint, own.apart)
    assert {len(part) for part in parts} == {38}


def test_the_section_says_what_was_inside() -> None:
    factors = CurveFactors({8: {"knee_flexion": 3.0}}, 21, 0.9)
    rows = coverage(found({"a": 1.0, "b": 2.5, "c": 2.9, "d": 3.1}), factors)
    assert [row["angle"] for row in rows] == ["all", "knee_flexion"]
    assert (rows[0]["inside"], rows[0]["inside_95"], rows[0]["half_deg"]) == (0.75, 0.25, 6.0)
    text = section(rows, factors)
    assert "| 8 | 4 | 75 % | " in text
    assert "| 25 % | 6.0, 3.9 |" in text
    assert "1 / (n + 1) is 4.5 %" in text


def test_the_inflation_is_left_as_it_is() -> None:
    inflation = "# Made.\n[apart]\ncamera = { turn = 1 }\n"
    factors = CurveFactors({0: {"hip_flexion": 2.501}}, 21, 0.9, "clips")
    assert split_file(inflation) == (inflation, False)
    assert split_file(inflation + "\n" + as_toml(factors)) == (inflation, True)
    assert "hip_flexion = 2.51\n" in as_toml(factors)  # rounded up, as a level is a least one


def test_people_of_curves_are_in_no_fit_and_no_test() -> None:
    others = [*FITTED_ON, *SAME_PEOPLE, *EXERCISES, *harness.split()["test"]]
    names, seconds = [*others, "someone", "short"], [3.0] * (len(others) + 1) + [1.9]
    counts = [round(60 * own) for own in seconds]
    N, J = sum(counts), 1
    corpus = Corpus(
        ("Hips",),
        (-1,),
        np.zeros((N, 3), dtype=np.float32),
        np.tile(np.eye(3, dtype=np.float32), (N, J, 1, 1)),
        np.zeros((len(names), J, 3), dtype=np.float32),
        np.cumsum([0, *counts]),
        tuple(names),
        ("train",) * len(names),
    )
    assert curve_people(corpus) == {"someone": [len(others)]}
