"""The command run: recording, motion, angles and report, and the recording alone."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest
from detector_support import walking, watching
from setup_support import SIZE, beside, pair, walker, write_keypoints

from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.formats.camera_toml import write_camera_toml


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    return write_keypoints(folder / "walk.npz", walker(), beside(walker(), 0.4, (1100.0, 400.0)))


def options(given: Path, out: Path) -> list[object]:
    """With the camera calibrated, as its estimation takes longest and is tested elsewhere."""
    calibration = Path(given).parent / "calib.toml"
    if not calibration.exists():
        write_camera_toml(calibration, {"camera": watching(walking())})
    return ["run", given, calibration, "--height", 1.72, "--no-figures", "-o", out]


@pytest.fixture(scope="module")
def done(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a complete run."""
    from rtof_kin.cli import main

    folder = tmp_path_factory.mktemp("run") / "out"
    assert main([str(argument) for argument in options(walk, folder)]) == 0
    return folder


def written(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def test_one_command_makes_recording_motion_angles_and_report(cli: Any, walk: Path, done: Path) -> None:
    assert {path.name for path in done.iterdir()} == {"recording", "motion", "angles", "report.html", MANIFEST}
    before = written(done)
    again = cli.ok(*options(walk, done))
    assert written(done) == before
    assert again.err.count("its inputs are the same; kept") == 4
    again.says(
        "given the person is 1.72 m tall",
        "found person 1 of 2 in frames.png",
        "focal length",
        "doubtful the take lasts 1.6 s",
        "accuracy expected",
        "caution",
        f"report {done}/report.html",
    )


def test_a_run_that_was_stopped_goes_on(cli: Any, walk: Path, tmp_path: Path, done: Path) -> None:
    shutil.copytree(done, tmp_path / "out")
    shutil.rmtree(tmp_path / "out" / "angles")
    (tmp_path / "out" / "report.html").unlink()
    before = written(tmp_path / "out" / "motion")
    assert cli(*options(walk, tmp_path / "out")).code == 0
    assert (tmp_path / "out" / "angles" / "angles.csv").is_file()
    assert (tmp_path / "out" / "report.html").is_file()
    assert written(tmp_path / "out" / "motion") == before


def test_a_corrected_recording_is_used_and_never_replaced(cli: Any, walk: Path, tmp_path: Path, done: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(done, out)
    text = (out / "recording" / "recording.toml").read_text()
    corrected = text.replace("height_m = 1.72", "height_m = 1.80")
    assert corrected != text
    (out / "recording" / "recording.toml").write_text(corrected)
    assert cli(*options(walk, out)).code == 0
    assert (out / "recording" / "recording.toml").read_text() == corrected
    summary = json.loads((out / "motion" / "summary.json").read_text())
    assert summary["inputs"]["subject"]["height_m"] == 1.8
    assert (
        "recording.toml (changed); move it elsewhere or name another folder"
        in cli.refused(*options(walk, out), "--person", 2).err
    )


def test_results_of_one_person_are_not_replaced_by_those_of_another(
    cli: Any, walk: Path, tmp_path: Path, done: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(done, out)
    before = written(out)
    assert (
        "is of another person of the video; name another folder by -o, or add --overwrite"
        in cli.refused(*options(walk, out), "--person", 2).err
    )
    assert written(out) == before
    assert cli(*options(walk, out), "--person", 1).code == 0


def test_a_folder_of_other_files_or_of_the_user_is_refused(cli: Any, walk: Path, tmp_path: Path, done: Path) -> None:
    other = write_keypoints(tmp_path / "other.npz", beside(walker(), 0.9, (50.0, 50.0)))
    assert (
        "was made from other files; name another folder by -o, or add --overwrite"
        in cli.refused(*options(other, done)).err
    )
    (tmp_path / "mine" / "recording").mkdir(parents=True)
    (tmp_path / "mine" / "recording" / "notes.txt").write_text("mine")
    assert cli(*options(walk, tmp_path / "mine")).code == 2
    assert [path.name for path in (tmp_path / "mine").rglob("*.*")] == ["notes.txt"]


def test_the_recording_alone_is_written_and_says_what_comes_next(cli: Any, walk: Path, tmp_path: Path) -> None:
    found = cli.ok("run", walk, "--only", "recording", "--size", SIZE, "-o", tmp_path / "rec")
    found.says(f"rtof-kin reconstruct {tmp_path}/rec -o OUT", "doubtful the take lasts 1.6 s")
    table = tomllib.loads((tmp_path / "rec" / "recording.toml").read_text())
    assert table["name"] == "rec"
    assert {path.name for path in (tmp_path / "rec").iterdir()} == {
        "recording.toml",
        "keypoints.npz",
        "frames.png",
        "findings.json",
        MANIFEST,
    }


def test_two_people_are_chosen_without_detecting_again(
    cli: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = write_keypoints(tmp_path / "two.npz", *pair())
    command = ["run", given, "--only", "recording", "--size", SIZE, "--height", 1.7, "-o", tmp_path / "rec"]
    assert (
        f"look at {tmp_path}/rec/frames.png and choose one with --person 1 or --person 2" in cli.refused(*command).err
    )
    before = written(tmp_path / "rec")["keypoints.npz"]
    assert cli(*command, "--person", 2).code == 0
    assert written(tmp_path / "rec")["keypoints.npz"] >= before
    assert tomllib.loads((tmp_path / "rec" / "recording.toml").read_text())["keypoints"]["person_number"] == 2


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("run", "WALK", "--size", SIZE), "the person's height is not given, and every length follows it: add"),
        (("run", "WALK", "--size", SIZE, "--height", "1.7m"), "'1.7m' is not a number, such as 1.72"),
        (("run", "WALK", "--size", SIZE, "--height", 1.7, "--lift", "a.trc"), "a.trc: there is no such file"),
        (("run", "WALK", "--size", SIZE, "--height", 1.7, "--events", "a.c3d"), "a.c3d: there is no such file"),
        (("run", "none.mp4", "--height", 1.7), "none.mp4: there is no such file or folder"),
        (("run", "WALK", "--only", "recording"), "give the video beside them, its calibration, or --size 1920x1080"),
        (("run", "WALK", "--size", "1920"), "'1920' is not width x height, such as 1920x1080"),
        (("run", "WALK", "--size", SIZE, "--height", 172), "is no human height in metres; give"),
        (("run", "WALK", "--size", "100x100", "--height", 1.7), "give the camera that belongs to this video"),
    ],
)
def test_bad_input_is_one_sentence_that_says_what_to_do(
    cli: Any, walk: Path, tmp_path: Path, arguments: tuple[object, ...], sentence: str
) -> None:
    given = [walk if argument == "WALK" else argument for argument in arguments]
    assert sentence in cli.refused(*given, "-o", tmp_path / "out").err
