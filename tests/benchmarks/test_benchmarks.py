"""The harness' arithmetic, and that split and checkpoint keep their promises."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.harness import COLUMNS, KEYPOINTS, pooled, split, table
from rtof_kin.simulation.simulate import SimulationSettings


def row(motion: str, frames: int, value: float, **fields: Any) -> dict[str, Any]:
    """One row of results with the same value everywhere."""
    figures = dict.fromkeys(COLUMNS, value)
    base = {"motion": motion, "frames": frames, "coverage": 1.0, "keypoints": "perfect"}
    return {**base, "mode": "rtof", **figures, **fields}


def test_pooling_weights_motions_by_their_frames() -> None:
    figures = pooled([row("a", 300, 10.0), row("b", 100, 50.0)])
    assert figures["mpjpe_rr_mm"] == pytest.approx(20.0)
    assert figures["mpjje"] == pytest.approx(20.0)


def test_the_interval_covers_the_mean_and_motions_are_its_unit() -> None:
    rows = [row(str(i), 100, float(i)) for i in range(20)]
    low, high = pooled(rows)["rr_interval"]
    assert low < 9.5 < high
    # Ten cameras of one motion tell no more than one.
    same = [row("a", 100, 5.0) for _ in range(10)]
    assert pooled(same)["rr_interval"] == pytest.approx([5.0, 5.0])


def test_the_table_has_a_line_for_every_kind_and_mode() -> None:
    rows = [row("a", 10, 1.0, keypoints=k, mode=m) for k in KEYPOINTS for m in ("lift", "rtof")]
    lines = table(rows).splitlines()
    assert len(lines) == 2 + 2 * len(KEYPOINTS)
    assert lines[2].startswith("| perfect | lift |")


def test_parts_of_the_split_are_disjoint() -> None:
    rows = split()
    parts = [set(rows[name]) for name in ("test", "validation", "excluded")]
    assert sum(map(len, parts)) == len(set.union(*parts))


def test_half_of_the_motions_are_not_walking() -> None:
    walking_or_running = {"02_01", "02_03", "09_01", "09_12", "12_01", "16_15", "16_31"}
    motions = split()["benchmark"]["motions"]
    assert len(motions) == len(set(motions))
    assert len(walking_or_running & set(motions)) <= len(motions) / 2


def test_every_benchmark_motion_is_of_a_test_subject() -> None:
    subjects = {f"CMU{int(name.split('_')[0]):03d}" for name in split()["benchmark"]["motions"]}
    assert subjects <= set(split()["test"])


def test_the_three_kinds_of_2d_differ_only_in_2d() -> None:
    kinds = [make() for make in KEYPOINTS.values()]
    assert all(isinstance(kind, SimulationSettings) for kind in kinds)
    assert len({kind.keypoints for kind in kinds}) == 3
    assert len({kind.imu for kind in kinds}) == 1
    assert all(np.isclose(kind.imu_rate_hz, 60.0) for kind in kinds)
