"""The command compare: what is printed, written and refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import walk
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
    done = cli("compare", outputs / "before", outputs / "after", "-o", outputs / "out")
    assert done.code == 0, done.err
    assert "A is before (rtof), B is after (rtof)" in done.out
    assert "over the gait cycle" in done.out
    assert "Chosen because both are walking, with complete gait cycles" in done.out
    assert "right knee flexion (range) by +" in done.out or "right knee flexion (mean) by +" in done.out
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
    done = cli(*arguments, "--overwrite")
    assert done.code == 2
    assert "mine.txt" in done.err


def test_an_exported_mot_differs_by_nothing(cli: Any, outputs: Path) -> None:
    assert cli("export", outputs / "before", outputs / "files", "--to", "mot").code == 0
    mots = sorted((outputs / "files").glob("*.mot"))
    done = cli("compare", outputs / "before", mots[0], "--angles", "right_knee_flexion,spine_flexion")
    assert done.code == 0, done.err
    assert done.out.startswith("A and B have the same values, to 0.01 deg")
    assert "has no bands and is taken as exact" in done.out
    assert "None of 2 angles is shown to have changed" in done.out
    assert "right knee flexion 0.0 \u00b1 3.9 0.0 \u00b1 5.5 0.0 0.0 0.0 0.0 not shown" in done.out


def test_a_reconstruction_is_identical_to_itself(cli: Any, reconstructed: Path) -> None:
    done = cli("compare", reconstructed, reconstructed / "motion.h5")
    assert done.code == 0, done.err
    assert done.out.startswith("A and B are identical")
    assert "None of" in done.out


def test_sides_of_one_motion(cli: Any, outputs: Path) -> None:
    done = cli("compare", outputs / "after", "--sides", "--angles", "knee_flexion")
    assert "they share errors" not in done.out
    assert done.code == 0, done.err
    assert "A is left, B is right" in done.out
    assert "knee flexion" in done.out
    assert "changed" in done.out


def test_align_states_the_shift(cli: Any, outputs: Path) -> None:
    motion = bent(1.0)
    times = motion.poses.times + 2.5
    assert motion.confidence is not None
    later = replace(
        motion, poses=replace(motion.poses, times=times), confidence=replace(motion.confidence, times=times)
    )
    folder_of(later, outputs / "late", recording="first")
    done = cli("compare", outputs / "before", outputs / "late", "--align", "--angles", "right_knee_flexion")
    assert done.code == 0, done.err
    assert "with B shifted by -2.500 s" in done.out
    given = cli("compare", outputs / "before", outputs / "late", "--shift", "-2.5", "--angles", "right_hip_flexion")
    assert "with B shifted by -2.500 s" in given.out
    refused = cli("compare", outputs / "before", outputs / "late", "--by", "cycle", "--align")
    assert refused.code == 2
    assert "--by time" in refused.err


@pytest.mark.parametrize(
    "arguments, named",
    [
        (("before",), "--sides"),
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
    done = cli("compare", *(outputs / a if a in names else a for a in arguments))
    assert done.code == 2
    assert done.err.startswith("error:")
    assert named in done.err
