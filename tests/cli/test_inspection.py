"""`rtof-kin inspect` names sensors that are elsewhere, and writes the correction where it is told to."""

from __future__ import annotations

from pathlib import Path

import pytest
from assignment_support import exchanged, some

from rtof_kin.cli import main
from rtof_kin.recording.recording import Recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose thighs' samples are exchanged."""
    folder = tmp_path_factory.mktemp("walk") / "recording"
    exchanged(some(), "L_UpLeg", "R_UpLeg").save(folder)
    return folder


def test_wrong_sensors_are_named_and_corrected_in_a_new_folder(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    out = folder.parent / "corrected"
    assert main(["inspect", str(folder), "--fix", "-o", str(out)]) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "L_UpLeg, declared on LeftUpLeg, is on RightUpLeg" in text
    assert "L_UpLeg on RightUpLeg" in text
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    calibration = Recording.load(out).calibration
    assert calibration is not None
    assert calibration.joints[calibration.sensors.index("R_UpLeg")] == "LeftUpLeg"

    assert main(["inspect", str(out), "--fix", "-o", str(out / "again")]) == 0
    assert "nothing to correct, and nothing was written" in capsys.readouterr().out
    assert not (out / "again").exists()


def test_fix_needs_one_recording_and_a_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--fix"], ["-o", "x"], [str(folder), "--fix", "-o", "x"]):
        assert main(["inspect", str(folder), *arguments]) == 2
        assert "--fix -o OUT" in capsys.readouterr().err
