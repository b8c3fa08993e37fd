"""The command line: what it prints, writes, refuses and returns."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.cli import main
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.core.resources import model_path
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.recording.recording import Recording

COMMANDS = (
    "demo", "reconstruct", "inspect", "calibrate", "analyse", "evaluate", "simulate", "train", "export",
    "report", "study",
)  # fmt: skip
MOCAP = Path(__file__).parents[1] / "fixtures" / "mocap"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of the demo as a recording folder."""
    demo = Recording.load(model_path("demo"))
    folder = tmp_path_factory.mktemp("recordings") / "short"
    replace(demo, keypoints=demo.keypoints[600:720]).save(folder)
    return folder


@pytest.fixture(scope="module")
def reconstructed(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of `reconstruct` on it."""
    out = tmp_path_factory.mktemp("outputs") / "short"
    assert main(["reconstruct", str(short), "-o", str(out), "--no-figures"]) == 0
    return out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_explains_it(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "usage: rtof-kin " + command in text
    assert len(text) > 400


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    words = text.split()
    assert all(command in words for command in COMMANDS)


def test_reconstruct_writes_the_whole_output(reconstructed: Path) -> None:
    names = {path.name for path in reconstructed.iterdir()}
    assert names == {
        "motion.npz",
        "skeleton.urdf",
        "joint_trajectory.csv",
        "joint_trajectory.json",
        "ros_joint_trajectory.json",
        "ros_base_trajectory.json",
        "motion.csv",
        "files.json",
        "summary.json",
        MANIFEST,
    }
    summary = json.loads((reconstructed / "summary.json").read_text())
    assert summary["mode"] == "rtof"
    assert set(summary["metrics"]) == {"lift", "sf2", "rtof"}
    assert summary["metrics"]["rtof"]["mpjpe_rr_mm"] < 90
    assert len(read_motion_npz(reconstructed / "motion.npz").q) == 120


def test_calibrate_prints_a_table_and_writes_what_reconstruct_takes(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, fixed = tmp_path / "found.toml", tmp_path / "fixed"
    command = ["calibrate", str(short), "-o", str(found), "--recording-output", str(fixed)]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "calibrated from itself" in text
    assert "image bias" in text
    assert Recording.load(fixed).keypoints.names == Recording.load(short).keypoints.names
    assert main(command) == 2
    assert "overwrite" in capsys.readouterr().err
    again = ["reconstruct", str(short), "-o", str(tmp_path / "out"), "--no-figures"]
    assert main([*again, "--calibration", str(found)]) == 0


def test_nothing_is_overwritten_unless_asked(
    short: Path, reconstructed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (reconstructed / "motion.npz").read_bytes()
    assert main(["reconstruct", str(short), "-o", str(reconstructed)]) == 2
    assert "overwrite" in capsys.readouterr().err
    assert (reconstructed / "motion.npz").read_bytes() == before


OWN = ("notes.txt", "report.html", "clinical/angles.csv")


@pytest.mark.parametrize(
    ("command", "own", "named"),
    [
        (["export", "{out}", "{out}", "--to", "bvh"], (), "motion.npz"),
        (["export", "{out}", "{out}", "--to", "bvh"], OWN, "clinical/, notes.txt, report.html"),
        (["demo", "-o", "{out}"], OWN, "clinical/, notes.txt, report.html"),
    ],
)
def test_overwriting_loses_nothing_of_the_user_and_nothing_of_another_command(
    reconstructed: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
    own: tuple[str, ...],
    named: str,
) -> None:
    out = shutil.copytree(reconstructed, tmp_path / "out")
    for name in own:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert main([*(word.format(out=out) for word in command), "--overwrite"]) == 2
    assert named in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


INTERRUPTED = """
import sys
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            exec("raise KeyboardInterrupt")
sys.meta_path.insert(0, CtrlC())
from rtof_kin.cli import main
sys.exit(main(["inspect", "none"]))
"""


@pytest.mark.parametrize("module", ["argparse", "rich.console", "numpy"])
def test_ctrl_c_while_importing_is_one_line_and_its_exit_code(module: str) -> None:
    code = [sys.executable, "-c", INTERRUPTED, module]
    done = subprocess.run(code, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_ctrl_c_while_arguments_are_read_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", interrupt)
    assert main(["inspect", "none"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_evaluate_prints_the_stage_beside_zero_motion(
    short: Path, reconstructed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(reconstructed), "--truth", str(short)]) == 0
    text = capsys.readouterr().out
    assert "rtof" in text
    assert "zero" in text
    assert "LeftForeArm" in text
    assert "[m/s2]" in text
    assert "\u2026" not in text  # no heading is cut at 80 columns


def test_a_folder_whose_name_has_square_brackets_is_named_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "r [mm] [red]x"
    command = ["simulate", str(MOCAP / "02_01_excerpt.bvh"), "-o", str(folder)]
    assert main(command) == 0
    assert f"wrote {folder}: " in capsys.readouterr().out
    assert main(command) == 2
    assert str(folder) in capsys.readouterr().err


def test_export_writes_only_what_was_asked(reconstructed: Path, tmp_path: Path) -> None:
    out = tmp_path / "ros"
    assert main(["export", str(reconstructed), "-o", str(out), "--to", "ros"]) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {
        "skeleton.urdf", "files.json", "ros_joint_trajectory.json", "ros_base_trajectory.json",
        MANIFEST,
    }  # fmt: skip


def test_export_writes_for_every_tool(
    reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["export", str(reconstructed / "motion.npz"), "--to"]
    out = str(tmp_path / "all")
    assert main([*arguments, "mot, trc,osim,c3d,bvh,csv,parquet", out]) == 0
    assert "motion.parquet" in capsys.readouterr().out
    index = json.loads((tmp_path / "all" / "files.json").read_text())
    formats = {facts["format"] for facts in index["files"].values()}
    assert formats == {"urdf", "mot", "trc", "osim", "c3d", "bvh", "csv", "parquet"}
    assert main([*arguments, "mot", out]) == 2
    assert "ask to overwrite" in capsys.readouterr().err
    assert main([*arguments, "mot", out, "--overwrite"]) == 0
    assert not (tmp_path / "all" / "motion.trc").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--to", "fbx", "OUT"], "unknown format 'fbx'"),
        (["OUT", "-o", "OUT"], "name one folder to write, as OUT or with -o OUT"),
    ],
)
def test_export_says_what_it_cannot_do_and_writes_nothing(
    reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    place = [str(tmp_path / "out") if word == "OUT" else word for word in arguments]
    assert main(["export", str(reconstructed), *place]) == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_export_needs_a_folder(reconstructed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["export", str(reconstructed), "--to", "mot"])
    assert stop.value.code == 2
    assert "required: OUT" in capsys.readouterr().err


def test_simulate_makes_a_recording_that_loads(tmp_path: Path) -> None:
    motion = sorted(MOCAP.rglob("*.bvh"))[0]
    out = tmp_path / "simulated"
    arguments = ["simulate", str(motion), "-o", str(out), "--keypoints", "perfect"]
    assert main([*arguments, "--sensors", "Pelvis,L_LowArm"]) == 0
    recording = Recording.load(out)
    assert recording.imus is not None
    assert recording.imus.names == ("Pelvis", "L_LowArm")
    assert recording.truth is not None


def test_a_missing_recording_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(tmp_path / "none"), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert "recording.toml" in message
    assert not (tmp_path / "out").exists()


def test_an_unknown_sensor_is_named_with_a_hint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion = sorted(MOCAP.rglob("*.bvh"))[0]
    out = tmp_path / "out"
    assert main(["simulate", str(motion), "-o", str(out), "--sensors", "L_LowrArm"]) == 2
    assert "Did you mean 'L_LowArm'?" in capsys.readouterr().err
    assert not out.exists()


def test_a_corrupt_checkpoint_is_refused(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.pt"
    broken.write_bytes(os.urandom(1000))
    out = tmp_path / "out"
    assert main(["reconstruct", str(short), "-o", str(out), "--lifter", str(broken)]) == 2
    assert "broken.pt" in capsys.readouterr().err
    assert not out.exists()


def test_a_corrupt_motion_file_is_refused(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "motion.npz"
    broken.write_bytes(b"PK\x03\x04 not a zip")
    assert main(["evaluate", str(broken), "--truth", str(short)]) == 2
    assert "motion.npz" in capsys.readouterr().err


def test_acceleration_in_g_is_recognised(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = Recording.load(short)
    assert recording.imus is not None
    folder = tmp_path / "in_g"
    recording.save(folder)
    arrays = dict(np.load(folder / "imus.npz"))
    arrays["f_sensor"] = arrays["f_sensor"] / 9.81
    np.savez(folder / "imus.npz", **arrays)
    assert main(["reconstruct", str(folder), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert "imus" in message.lower()
    assert "9.81" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["reconstruct", "calibrate"])
def test_an_unwritable_output_is_refused_before_the_work(
    short: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    for work in ("reconstruct", "calibrate_recording"):
        monkeypatch.setattr(f"rtof_kin.reconstruction.pipeline.{work}", None)
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert main([command, str(short), "-o", str(blocked / "out")]) == 2
    assert "file is no folder to write to" in capsys.readouterr().err


def test_a_mode_that_needs_imus_says_so_without_them(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "camera_only"
    replace(Recording.load(short), imus=None, calibration=None).save(folder)
    assert main(["reconstruct", str(folder), "-o", str(tmp_path / "out")]) == 2
    assert "'rto'" in capsys.readouterr().err
    assert main(["reconstruct", str(folder), "-o", str(tmp_path / "out"), "--mode", "lift"]) == 0


def test_sensors_are_enough_for_mode_imu(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "sensors_only"
    replace(Recording.load(short), keypoints=None).save(folder)
    out = str(tmp_path / "out")
    assert main(["reconstruct", str(folder), "-o", out]) == 2
    assert "mode rtof needs keypoints and the recording has none; use 'imu'" in capsys.readouterr().err
    assert main(["reconstruct", str(folder), "-o", out, "--mode", "imu"]) == 0
    assert (tmp_path / "out" / "figures" / "skeletons.png").is_file()
    told = capsys.readouterr().out
    assert main(["evaluate", out, "--truth", str(folder)]) == 0
    again = capsys.readouterr().out
    (scores,) = (line for line in told.splitlines() if "imu " in line[:6])
    assert scores in again
    for text in (told, again):
        assert "the estimate is shifted to start at the truth" in text
