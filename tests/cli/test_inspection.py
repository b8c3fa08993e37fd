"""`rtof-kin inspect` names sensors that are elsewhere, and writes the correction where it is told to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from assignment_support import exchanged, some

from rtof_kin.recording.recording import Recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose thighs' samples are exchanged."""
    folder = tmp_path_factory.mktemp("walk") / "recording"
    exchanged(some(), "L_UpLeg", "R_UpLeg").save(folder)
    return folder


def test_wrong_sensors_are_named_and_corrected_in_a_new_folder(folder: Path, cli: Any) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    out = folder.parent / "corrected"
    done = cli("inspect", folder, "--fix", "-o", out)
    assert done.code == 1
    done.says("L_UpLeg, declared on LeftUpLeg, is on RightUpLeg", "L_UpLeg on RightUpLeg")
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    calibration = Recording.load(out).calibration
    assert calibration is not None
    assert calibration.joints[calibration.sensors.index("R_UpLeg")] == "LeftUpLeg"

    cli.ok("inspect", out, "--fix", "-o", out / "again").says("nothing to correct, and nothing was written")
    assert not (out / "again").exists()


def test_fix_needs_one_recording_and_a_folder(folder: Path, cli: Any) -> None:
    for arguments in (["--fix"], ["-o", "x"], [folder, "--fix", "-o", "x"]):
        assert "--fix -o OUT" in cli.refused("inspect", folder, *arguments).err
