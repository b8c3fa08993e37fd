"""The benchmark of sensors alone: its figures on planted rows and on one short motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import planted
import pytest

from benchmarks.inertial_only import FIGURES, NOISE, SETS, Job, recorded, run, table
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.simulation.mocap import MocapClip

BODY = SkeletonModel.default()


def row(motion: str, drift: float, **about: Any) -> dict[str, Any]:
    figures = dict.fromkeys(FIGURES, 2.0)
    where = {"walked_m": 10.0, "drift_m": drift, "vertical_m": 0.02, "sigma_m": 0.3}
    own = {"motion": motion, "category": "walking", "frames": 600, "seconds": 10.0}
    return figures | where | own | about


def rows(**about: Any) -> list[dict[str, Any]]:
    out = []
    for noise in NOISE:
        for count in SETS:
            same = {"noise": noise, "sensors": count}
            out += [row("a", 0.3, **same), row("b", 0.4, **same, **about)]
    return out


def test_drift_is_pooled_by_distance() -> None:
    found = table(rows(category="running"))
    cells = dict(zip(found.columns, found.rows[0], strict=True))
    assert cells["drift % of walked"] == pytest.approx(100 * (0.5 / 200**0.5))
    assert cells["median"] == pytest.approx(3.5)
    assert cells["walking alone"] == pytest.approx(3.0)
    assert cells["drift m/min, median"] == pytest.approx(6 * 0.35)
    assert cells["vertical mm"] == pytest.approx(20.0)
    assert cells["within 2 sigma %"] == pytest.approx(100.0)
    assert len(found.rows) == len(NOISE) * len(SETS)


def test_drift_without_walking_is_by_time_only() -> None:
    found = table(rows(walked_m=1.0, drift_m=9.0))
    cells = dict(zip(found.columns, found.rows[0], strict=True))
    assert cells["drift % of walked"] == pytest.approx(3.0)
    assert cells["drift m/min, median"] == pytest.approx(6 * (0.3 + 9.0) / 2)


def test_a_walk_is_recorded_without_a_camera_reconstructed_and_scored() -> None:
    walk, _ = planted.walking(BODY, 2.0)
    clip = MocapClip("walk", walk.poses, BODY.joint_offsets, "S")
    clip = replace(clip, category="walking")
    job = Job(clip, "8", "exact", 0)
    assert recorded(job).keypoints is None
    scored = run(job)
    assert scored["walked_m"] == pytest.approx(1.6, rel=0.05)
    assert scored["drift_m"] < 0.15
    assert scored["orientation_deg"] < 4.0
