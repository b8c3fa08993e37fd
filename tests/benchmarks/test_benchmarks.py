"""The harness' arithmetic, and that split and checkpoint keep their promises."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest

from benchmarks import scoring
from benchmarks.harness import BANDS, COLUMNS, KEYPOINTS, pooled, split, tables
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import Confidence


def row(motion: str, frames: int, value: float, **fields: Any) -> dict[str, Any]:
    """One row of results with the same value everywhere."""
    figures = dict.fromkeys(COLUMNS, value)
    base = {"motion": motion, "rig": "snu", "held out": "rigs", "frames": frames, "keypoints": "perfect"}
    return {**base, "mode": "rtof", **figures, **fields}


def test_pooling_weights_motions_by_their_frames() -> None:
    figures = pooled([row("a", 300, 10.0), row("b", 100, 50.0)])
    assert figures["mpjpe_rr_mm"] == pytest.approx(20.0)
    assert figures["mpjje"] == pytest.approx(20.0)
    assert np.isnan(figures["rho_world"])  # not every stage states its errors
    stated = [row("a", 300, 10.0, rms_world_mm=10.0), row("b", 100, 50.0, rms_world_mm=50.0)]
    assert pooled(stated)["rms_world_mm"] == pytest.approx(np.sqrt(700.0))


def test_the_interval_covers_the_mean_and_motions_are_its_unit() -> None:
    rows = [row(str(i), 100, float(i)) for i in range(20)]
    low, high = pooled(rows)["rr_interval"]
    assert low < 9.5 < high
    # Ten cameras of one motion tell no more than one.
    same = [row("a", 100, 5.0) for _ in range(10)]
    assert pooled(same)["rr_interval"] == pytest.approx([5.0, 5.0])


def test_tables_have_a_line_for_every_kind_mode_and_rig() -> None:
    rows = [row("a", 10, 1.0, keypoints=k, mode=m) for k in KEYPOINTS for m in ("lift", "rtof")]
    stated = dict.fromkeys(BANDS, 1.0)
    rows += [row("b", 10, 2.0, mode="rtof", rig="cmu_bvh", **stated)]
    found = {table.name: [line[:-1] for line in table.text()] for table in tables(rows)}
    kinds = list(KEYPOINTS)
    assert [line[:3] for line in found["all"][:2]] == [["perfect", "lift", "1.0"], ["perfect", "rtof", "1.5"]]
    assert [line[:2] for line in found["rigs"]] == [["perfect", "cmu_bvh"], *([k, "snu"] for k in kinds)]
    assert len(found["bands"]) == len(found["bands_rigs"]) == 1


@pytest.mark.parametrize(("stated", "inside"), [(1.0, 0.95), (0.5, 0.673)])
def test_torso_and_bands_of_planted_errors(stated: float, inside: float) -> None:
    motion, rng = planted.human(SkeletonModel.default(), 600), np.random.default_rng(0)
    truth, names = motion.poses, motion.poses.names
    sigma = rng.uniform(0.005, 0.05, truth.p_world_joint.shape) * np.array([0.5, 1.0, 2.0])
    R = truth.R_world_bone.copy()
    for name, degrees in (("Hips", 4.0), ("Spine3", 9.0)):
        R[:, names.index(name)] @= so3.exp(np.array([0.0, np.radians(degrees), 0.0]))
    p = truth.p_world_joint + sigma * rng.normal(size=sigma.shape)
    estimate = replace(truth, p_world_joint=p, R_world_bone=R)
    assert scoring.torso(estimate, truth) == pytest.approx({"hips_deg": 4.0, "trunk_deg": 9.0})
    own = (stated * sigma[..., None]) ** 2 * np.eye(3)
    confidence = Confidence(truth.times, names, own, own + own[:, :1], (), np.zeros((600, 0, 3, 3)))
    found = scoring.bands(replace(motion, poses=estimate, confidence=confidence), truth)
    for kind in ("relative", "world"):
        assert found[f"inside_{kind}"] == pytest.approx(inside, abs=0.02)
        assert found[f"sigma_{kind}_mm"] == pytest.approx(stated * found[f"rms_{kind}_mm"], rel=0.05)
        assert 0.3 < found[f"rho_{kind}"] < 0.8


def test_parts_of_the_split_are_disjoint() -> None:
    rows = split()
    parts = [set(rows[name]) for name in ("test", "validation")]
    assert sum(map(len, parts)) == len(set.union(*parts))


def test_half_of_the_motions_are_not_walking() -> None:
    walking_or_running = {"09_12", "12_01", "16_15", "16_16"}
    motions = split()["benchmark"]["motions"]
    assert len(motions) == len(set(motions))
    assert len(walking_or_running & set(motions)) <= len(motions) / 2


@pytest.mark.parametrize(
    "name",
    [
        "accuracy",
        "calibration",
        "calibration.optimum",
        "calibration.planted",
        "calibration_by_pose",
        "confidence",
        "detectors",
        "harness",
        "hinge_zero",
        "inertial_only",
        "lifter",
        "mounting",
        "planted",
        "scale",
        "solvers",
        "total_capture_standin",
        "unchanged",
        "verdicts",
    ],
)
def test_every_command_has_a_help_text(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        main_of(f"benchmarks.{name}")()
    assert "usage: " in capsys.readouterr().out


def main_of(module: str) -> Callable[[], object]:
    found = importlib.util.find_spec(module)
    assert found is not None
    package = ".__main__" if found.submodule_search_locations else ""
    main: Callable[[], object] = importlib.import_module(module + package).main
    return main
