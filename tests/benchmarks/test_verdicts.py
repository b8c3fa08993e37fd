"""The study of sigma and verdicts: its scores on known answers, its recordings, its tables."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.verdicts import __main__ as command
from benchmarks.verdicts import measuring, recordings, scores, study
from benchmarks.verdicts.tables import tables
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.confidence import Confidence
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.joint_space.covariance import segment_pairs

Array = NDArray[np.float64]
BODY = SkeletonModel.default()


def test_area_under_the_roc_curve_counts_pairs() -> None:
    rng = np.random.default_rng(0)
    score, bad = rng.integers(0, 6, 60).astype(float), rng.random(60) < 0.3
    pairs = [(a > b) + 0.5 * (a == b) for a in score[bad] for b in score[~bad]]
    assert scores.area(score, bad) == pytest.approx(np.mean(pairs))
    odd = np.arange(9999) % 2 == 1
    false, true = scores.roc(rng.normal(size=9999) + 2.0 * odd, odd)
    assert np.trapezoid(true, false) == pytest.approx(0.921, abs=0.01)  # Phi(2 / sqrt(2))
    assert np.isnan(scores.area(score, np.ones(60, dtype=bool)))


def test_scores_within_recordings_ignore_differences_between_them() -> None:
    rng = np.random.default_rng(1)
    recording = np.repeat(np.arange(20), 50)
    error = recording + rng.normal(size=1000)
    sigma, bad = recording.astype(float), error > 10
    assert scores.area(sigma, bad) > 0.9
    assert scores.area_within(sigma, bad, recording) == pytest.approx(0.5)
    noisy = sigma + 1e-3 * rng.normal(size=1000)
    assert abs(scores.rank_correlation_within(noisy, error, recording)) < 0.1
    assert scores.rank_correlation(noisy, error) == pytest.approx(spearmanr(noisy, error).statistic)


def test_calibration_error_of_exact_and_doubled_sigmas() -> None:
    rng = np.random.default_rng(2)
    axes = np.exp(rng.normal(size=(40000, 3)))  # standard deviations of three axes
    error = np.linalg.norm(axes * rng.normal(size=axes.shape), axis=1)
    mean, spread = np.sum(axes**2, axis=1), np.sum(axes**4, axis=1)
    sigma, freedom = np.sqrt(mean), mean**2 / spread
    for factor, low, high in ((1.0, 0.0, 0.02), (2.0, 0.1, 0.5)):
        stated = scores.probability_above(2.0, factor * sigma, freedom)
        assert low <= scores.calibration_error(stated, error > 2.0) < high
        assert low <= scores.interval_error(error, factor * sigma, freedom) < high


def clips() -> list[tuple[str, MocapClip]]:
    poses = planted.moving(BODY, 60, 1).poses
    return [("people", MocapClip(f"m{i}", poses, BODY.joint_offsets, subject="s1", category="walk")) for i in range(2)]


SAMPLER = """
import numpy as np
def sample(p, R, K, Rc, t, seed, rate, size, camera_error):
    assert not camera_error and size == (1920, 1080) and round(rate) == 60
    pc = p @ Rc.T + t
    uv = pc[..., :2] / pc[..., 2:] * K[0, 0] + K[:2, 2]
    of = [6] * 11 + [12, 8, 13, 9, 14, 10] + [14, 10] * 3 + [18, 15, 19, 16] + [20, 17] * 3
    rng = np.random.default_rng(seed)
    return uv[:, of] + rng.normal(size=(len(p), 33, 2)), np.ones((len(p), 33))
"""


def test_sampled_detections_become_keypoints_of_the_skeleton(tmp_path: Path) -> None:
    (tmp_path / "sampler.py").write_text(SAMPLER)
    (group, clip), *_ = clips()
    work = recordings.jobs([(group, clip)], (recordings.SAMPLED,), 0, tmp_path / "sampler.py")
    recording = next(job for job in work if job.sensors == "8").recording()
    assert {*BODY.names} <= {*recording.video.names}
    assert recording.imus is not None
    with_fault = next(job for job in work if job.fault != recordings.ORDINARY).recording()
    assert with_fault.truth is not None


def result(apart: float) -> Any:
    """As `reconstruct` returns it: all places off by `apart` m along x, stated 10 mm per axis."""
    truth = planted.moving(BODY, 30, 4).poses
    poses = replace(
        truth,
        p_world_joint=truth.p_world_joint + np.array([apart, 0.0, 0.0]),
        orientation_observed=np.ones(len(BODY.names), dtype=np.bool_),
    )
    pairs, J = segment_pairs(BODY), len(BODY.names)
    unit = np.tile(np.eye(3), (30, J, 1, 1))
    turn = np.tile(np.radians(2.0) ** 2 * np.eye(3), (30, len(pairs), 1, 1))
    confidence = Confidence(truth.times, BODY.names, 1e-4 * unit, 2e-4 * unit, pairs, turn)
    q = np.tile(BODY.t_pose(), (30, 1))
    bent = BODY.dof_names.index(BODY.table.joints[BODY.index("LeftLeg")[0]].dofs[1].urdf)
    q[:, 7 + bent] = BODY.limits[bent, 1] + 0.5
    motion = Motion(BODY, q, poses, BODY.check(q), confidence)
    fault = SimpleNamespace(start=truth.times[0] - 1, stop=truth.times[0])
    return SimpleNamespace(motion=motion, recording=SimpleNamespace(truth=truth), faults=(fault,))


def test_errors_and_sigmas_are_in_mm_and_deg() -> None:
    found = measuring.stated(result(0.05))
    position, relative = found["position"], found["relative"]
    np.testing.assert_allclose(position.error, 50.0)
    np.testing.assert_allclose(position.sigma, 10.0 * np.sqrt(3))
    np.testing.assert_allclose(position.freedom, 3.0)
    np.testing.assert_allclose(relative.error, 0.0, atol=1e-9)
    assert "Hips" in position.names
    assert "Hips" not in relative.names
    np.testing.assert_allclose(found["orientation"].sigma, 2.0 * np.sqrt(3))
    known = np.isfinite(found["angle"].error)
    assert known.any()
    assert found["angle"].error[known].max() < 1e-6


def rows(count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Recordings whose sigma is right in each frame, and whose audit tells bad recordings."""
    rng, found = np.random.default_rng(seed), []
    for i in range(count):
        row: dict[str, Any] = {
            "group": ("people", "rigs")[i % 2],
            "person": f"p{i % 3}",
            "motion": f"m{i}",
            "keypoints": "realistic",
            "sensors": ("0", "8")[i % 2],
            "fault": ("ordinary", "slipped")[i % 2],
            "verdict": {"grades": float(i), "excess": float(i)},
        }
        for quantity in ("position", "relative", "orientation", "angle"):
            usual = 40.0 if quantity in ("position", "relative") else 8.0
            sigma = usual * (1 + i) / count * np.exp(rng.normal(size=(5, 40)))
            error = np.abs(sigma * rng.normal(size=sigma.shape))
            one = np.ones(sigma.shape)
            sigma[0, 0] = np.nan
            row[quantity] = {
                "names": ["a"] * 5,
                "error": error.tolist(),
                "sigma": sigma.tolist(),
                "freedom": one.tolist(),
                "flags": (0 * one).tolist(),
            }
        found.append(row)
    return found


def test_exact_sigmas_score_well_and_tables_are_complete(tmp_path: Path) -> None:
    found = rows(6)
    shown, numbers = tables(found)
    own = numbers["sigma"]["positions relative to the root > 50 mm"]["all"]
    assert own["count"] == 6 * 199
    assert own["auc_entry"] > 0.8
    assert own["ece"] < 0.04
    assert 0.93 < own["coverage"] < 0.97
    verdict = numbers["verdicts"]["clinical angles > 10 deg"]
    assert verdict["auc_excess"] == 1.0
    assert verdict["auc_flags"] == 0.5
    low, high = numbers["intervals"]["clinical angles > 10 deg"]["auc"]
    assert low < high
    text = command.write(
        [*found, {"motion": "x", "fault": "y", "failed": "lost"}], tmp_path / "v.json", {"how": "Here."}
    )
    assert len(shown) == 3
    for words in ("Here.", "x, y: lost", "with a fault", "realistic, 8 sensors"):
        assert words in text
    assert json.loads((tmp_path / "v.json").read_text())["failed"] == ["x, y: lost"]
    assert (tmp_path / "v.png").stat().st_size > 10000
    assert {*study.parts(found)} >= {"all", "people", "rigs", "ordinary"}
