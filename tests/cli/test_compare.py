"""The command compare of two motions, both sides of one and visits: what is printed, written and refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import walk
from follow_support import visit_folders
from report_support import certain_to, folder_of

from rtof_kin.body.skeleton import Motion


def bent(factor: float) -> Motion:
    """Real walking with the right knee's flexion scaled and bands of 2 degrees."""
    motion = walk()
    q = np.array(motion.q)
    q[:, 7 + motion.skeleton.dof_names.index("RightLeg_y")] *= factor
    p, R = motion.skeleton.forward_kinematics(q)
    motion = replace(motion, q=q, poses=replace(motion.poses, p_world_joint=p, R_world_bone=R))
    return replace(motion, confidence=certain_to(2.0, motion))


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs before and after a change of the right knee, of two recordings."""
    folder = tmp_path_factory.mktemp("compare")
    folder_of(bent(1.0), folder / "before", recording="first")
    folder_of(bent(1.6), folder / "after", recording="second")
    return folder


def test_two_recordings_are_compared_by_cycle_and_the_change_is_named(cli: Any, outputs: Path) -> None:
    done = cli.ok("compare", outputs / "before", outputs / "after", "-o", outputs / "out")
    done.says(
        "A is before (rtof), B is after (rtof)",
        "over the gait cycle",
        "Chosen because both are walking, with complete gait cycles",
    )
    assert "right knee flexion (mean) by +" in done.out
    assert {p.name for p in (outputs / "out").iterdir()} >= {"comparison.html", "comparison.csv", "comparison.json"}
    data = json.loads((outputs / "out" / "comparison.json").read_text())
    assert data["by"] == "cycle"
    changed = {row["angle"] for row in data["angles"] if row["verdict"] == "changed"}
    assert "right_knee_flexion" in changed
    assert not any(name.startswith("left") for name in changed)


def test_existing_output_is_replaced_only_on_request(cli: Any, outputs: Path) -> None:
    arguments = ("compare", outputs / "before", outputs / "after", "--by", "range", "-o", outputs / "twice")
    assert cli(*arguments).code == 0
    assert cli(*arguments).code == 2
    assert cli(*arguments, "--overwrite").code == 0
    (outputs / "twice" / "mine.txt").write_text("mine")
    assert "mine.txt" in cli.refused(*arguments, "--overwrite").err


def test_an_exported_mot_differs_by_nothing(cli: Any, outputs: Path) -> None:
    assert cli("export", outputs / "before", outputs / "files", "--to", "mot").code == 0
    mots = sorted((outputs / "files").glob("*.mot"))
    done = cli.ok("compare", outputs / "before", mots[0], "--angles", "right_knee_flexion,spine_flexion")
    assert done.out.startswith("A and B have the same values, to 0.01 deg")
    done.says(
        "has no bands and is taken as exact",
        "None of 2 angles is shown to have changed",
        "right knee flexion 0.0 \u00b1 3.9 0.0 \u00b1 5.5 0.0 0.0 0.0 0.0 not shown",
    )


def test_sides_of_one_motion(cli: Any, outputs: Path) -> None:
    done = cli("compare", outputs / "after", "--sides", "--angles", "knee_flexion")
    assert "they share errors" not in done.out
    assert done.code == 0, done.err
    done.says("A is left, B is right", "knee flexion", "changed")


@pytest.mark.parametrize(
    "arguments, named",
    [
        (("before",), "is one motion; give the folder"),
        (("before", "after", "--by", "cycle", "--align"), "--by time"),
        (("before", "after", "--sides"), "--sides"),
        (("before", "none"), "none"),
        (("before", "after", "--angles", "right_nee_flexion"), "right_knee_flexion"),
        (("before", "after", "--by", "repetition"), "squat"),
        (("before", "broken.mot"), "endheader"),
    ],
)
def test_wrong_input_is_one_line(arguments: tuple[str, ...], named: str, cli: Any, outputs: Path) -> None:
    (outputs / "broken.mot").write_text("nothing\n")
    names = ("before", "after", "none", "broken.mot")
    done = cli.refused("compare", *(outputs / a if a in names else a for a in arguments))
    assert done.err.startswith("error:")
    assert named in done.err


# --- visits ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits of two walks each, at another speed."""
    folder = tmp_path_factory.mktemp("follow")
    return visit_folders(folder, {"2026-01-10": 1.0, "2026-02-14": 1.4})


def test_the_change_is_printed_and_written(cli: Any, visits: Path, tmp_path: Path) -> None:
    done = cli.ok("compare", visits, "--measures", "gait_speed,right_knee_flexion", "-o", tmp_path / "out")
    assert done.out.startswith("2 visits with their trials: 2026-01-10 (2), 2026-02-14 (2).")
    done.says("gait speed improved (+0.4", "gait speed [m/s]")
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"follow.html", "follow.csv", "follow.json"}
    data = json.loads((tmp_path / "out" / "follow.json").read_text())
    outcomes = {row["measure"]: row["outcome"] for row in data["rows"] if row["visit"] == "2026-02-14"}
    assert outcomes["gait_speed"] == "improved"
    assert len(outcomes) == 5


def test_folders_of_three_visits_are_compared_as_one_that_has_them(cli: Any, tmp_path: Path) -> None:
    visit_folders(tmp_path, {"2026-01-10": 1.0, "2026-02-14": 1.4, "2026-03-14": 1.2})
    done = cli.ok("compare", *sorted(tmp_path.iterdir()), "--measures", "gait_speed")
    assert done.out.startswith("3 visits with their trials: ")


def test_another_baseline_turns_the_change(cli: Any, visits: Path) -> None:
    done = cli.ok("compare", visits, "--measures", "gait_speed", "--baseline", "2026-02-14")
    assert "gait speed worse (-0.4" in done.out


@pytest.mark.parametrize(
    "arguments, named",
    [
        (("--measures", "gait_sped"), "gait_speed"),
        (("--baseline", "2026-01-11"), "2026-01-10"),
        (("--by", "repetition", "--repetitions", "squat"), "squat"),
    ],
)
def test_wrong_input_on_visits_is_one_line(arguments: tuple[str, ...], named: str, cli: Any, visits: Path) -> None:
    done = cli.refused("compare", visits, *arguments)
    assert "error:" in done.err
    assert named in done.err
