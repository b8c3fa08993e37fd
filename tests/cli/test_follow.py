"""The command follow: what is printed, written and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from follow_support import visit_folders


@pytest.fixture(scope="module")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits of two walks each, at another speed."""
    folder = tmp_path_factory.mktemp("follow")
    return visit_folders(folder, {"2026-01-10": 1.0, "2026-02-14": 1.4})


def test_the_change_is_printed_and_written(cli: Any, visits: Path, tmp_path: Path) -> None:
    done = cli("follow", visits, "--measures", "gait_speed,right_knee_flexion", "-o", tmp_path / "out")
    assert done.code == 0, done.err
    assert done.out.startswith("2 visits with their trials: 2026-01-10 (2), 2026-02-14 (2).")
    assert "gait speed improved (+0.4" in done.out
    assert "gait speed [m/s]" in done.out
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"follow.html", "follow.csv", "follow.json"}
    data = json.loads((tmp_path / "out" / "follow.json").read_text())
    outcomes = {row["measure"]: row["outcome"] for row in data["rows"] if row["visit"] == "2026-02-14"}
    assert outcomes["gait_speed"] == "improved"
    assert len(outcomes) == 5


def test_another_baseline_turns_the_change(cli: Any, visits: Path) -> None:
    done = cli("follow", visits, "--measures", "gait_speed", "--baseline", "2026-02-14")
    assert done.code == 0, done.err
    assert "gait speed worse (-0.4" in done.out


def test_existing_output_is_replaced_only_on_request(cli: Any, visits: Path, tmp_path: Path) -> None:
    arguments = ("follow", visits, "--measures", "gait_speed", "-o", tmp_path / "twice")
    assert cli(*arguments).code == 0
    assert cli(*arguments).code == 2
    assert cli(*arguments, "--overwrite").code == 0


@pytest.mark.parametrize(
    "arguments, named",
    [
        (("--measures", "gait_sped"), "gait_speed"),
        (("--baseline", "2026-01-11"), "2026-01-10"),
        (("--by", "repetition", "--repetitions", "squat"), "squat"),
    ],
)
def test_wrong_input_is_one_line(arguments: tuple[str, ...], named: str, cli: Any, visits: Path) -> None:
    done = cli("follow", visits, *arguments)
    assert done.code == 2
    assert "error:" in done.err
    assert named in done.err
