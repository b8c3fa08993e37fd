"""The commands gait-reference and report --gait-reference, and compare --spm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import posture, squatting, walking
from report_support import folder_of

from rtof_kin.body.skeleton import Motion, SkeletonModel

TERMS = ("--licence", "CC0-1.0", "--origin", "planted walking")


def person(stride_time: float, speed: float) -> Motion:
    return walking(9.0, stride_time=stride_time, speed=speed)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six people, one of them in two recordings, and one motion that cannot be used."""
    folder = tmp_path_factory.mktemp("healthy")
    for k in range(6):
        session = {"session": {"subject": f"P{k}"}}
        folder_of(person(1.1 + 0.04 * k, 1.0 + 0.06 * k), folder / f"r{k}", inputs=session)
    folder_of(person(1.2, 1.1), folder / "again", inputs={"session": {"subject": "P0"}})
    folder_of(squatting(), folder / "squats")
    return folder


@pytest.fixture(scope="module")
def reference(healthy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from rtof_kin.cli import main

    path = tmp_path_factory.mktemp("reference") / "own.json"
    assert main(["gait-reference", str(healthy), "-o", str(path), *TERMS]) == 0
    return path


def test_a_reference_says_who_is_in_it_and_who_is_not(cli: Any, healthy: Path, tmp_path: Path) -> None:
    done = cli.ok("gait-reference", healthy, "-o", tmp_path / "own.json", *TERMS)
    done.says("reference of 6 people at 1.0", "left out: squats: ", "fewer than 10 people")
    data = json.loads((tmp_path / "own.json").read_text())
    assert [one["person"] for one in data["curves"]] == [f"P{k}" for k in range(6)]
    assert sum(data["curves"][0]["strides"]) > sum(data["curves"][1]["strides"])
    assert cli("gait-reference", healthy, "-o", tmp_path / "own.json", *TERMS).code == 2


def test_scores_of_a_person_of_the_reference(cli: Any, healthy: Path, reference: Path, tmp_path: Path) -> None:
    done = cli.ok("report", healthy / "r3", "--gait-reference", reference, "--analysis", tmp_path / "out")
    done.says("r3: GPS", "GDI right", "no covariances")
    files = {path.name for path in (tmp_path / "out" / "gait_scores").iterdir()}
    assert files >= {"gait_scores.json", "gait_scores.csv", "gait_curves.csv", "gait_scores.png"}
    data = json.loads((tmp_path / "out" / "gait_scores" / "gait_scores.json").read_text())
    rows = {(row["score"], row["side"]): row["value_deg"] for row in data["scores"]}
    assert len(rows) == 21
    squares = [rows[name, "left"] ** 2 for name, side in rows if side == "left" and name != "gps"]
    assert rows["gps", "left"] ** 2 == pytest.approx(np.mean(squares), rel=1e-4)


def test_a_table_needs_what_recordings_have_by_themselves(cli: Any, healthy: Path, tmp_path: Path) -> None:
    lines = ["variable,percent,mean,sd"]
    lines += [f"knee_flexion,{percent},{20 + percent / 10},3" for percent in range(0, 101, 2)]
    table = tmp_path / "normal.csv"
    table.write_text("\n".join(lines))
    done = cli.refused("gait-reference", table, "-o", tmp_path / "t.json", *TERMS)
    assert "--people" in done.err
    more = ("--people", 40, "--system", "Vicon, Plug-in Gait", "--zero", "static trial", "--walking-speed", 1, 1.5)
    done = cli.ok("gait-reference", table, "-o", tmp_path / "t.json", *TERMS, *more)
    done.says("reference of 40 people at 1.00 to 1.50 m/s", "without pelvic_tilt", "GDI will not be computed")
    assert cli("gait-reference", healthy, "-o", tmp_path / "r.json", *TERMS, "--people", 3).code == 2


@pytest.mark.parametrize("wrong, named", [("none", "none"), ("empty", "empty"), ("standing", "0 of 0 people")])
def test_a_folder_without_walking_is_refused(cli: Any, tmp_path: Path, wrong: str, named: str) -> None:
    (tmp_path / "empty").mkdir()
    skeleton = SkeletonModel.default()
    folder_of(skeleton.motion(posture(skeleton, 120)), tmp_path / "standing" / "one")
    assert named in cli.refused("gait-reference", tmp_path / wrong, "-o", tmp_path / "r.json", *TERMS).err


def test_compare_writes_spm(cli: Any, healthy: Path, tmp_path: Path) -> None:
    for name, speed in (("a", 0.9), ("b", 1.4)):
        folder_of(walking(9.0, speed=speed, jitter=0.01), tmp_path / name, recording=name)
    arguments = ("compare", tmp_path / "a", tmp_path / "b", "--by", "cycle", "--angles", "right_hip_flexion")
    done = cli.ok(*arguments, "--spm", "-o", tmp_path / "out")
    done.says("SPM{t} of 1 angles", "B larger")
    data = json.loads((tmp_path / "out" / "spm.json").read_text())
    assert data["correction"] == "Bonferroni over angles"
    assert data["angles"][0]["clusters"]
    assert (tmp_path / "out" / "spm.png").exists()
    alike = cli("compare", healthy / "r0", healthy / "r5", "--by", "cycle", "--spm")
    assert "no angle can be tested" in alike.out
    assert "--by cycle" in cli.refused("compare", healthy / "r0", healthy / "r5", "--by", "range", "--spm").err
