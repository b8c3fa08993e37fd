"""The harness' arithmetic, and that split and checkpoint keep their promises."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from typing import Any

import pytest

from benchmarks.harness import COLUMNS, KEYPOINTS, pooled, split, table


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


@pytest.mark.parametrize(
    "name",
    [
        "accuracy", "audit", "calibration", "calibration.optimum", "calibration.planted",
        "calibration_by_pose", "confidence", "detectors", "harness", "inertial_only", "input_checks",
        "lifter", "lifter_speed", "mounting", "sensor_checks", "solvers", "total_capture_standin",
        "unchanged", "verdicts",
    ],
)  # fmt: skip
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
