"""The command line: output, files, refusals and exit codes of the commands on recordings and motions."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.metrics import BEGUN_TOGETHER
from rtof_kin.cli import main
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.core.resources import model_path
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.recording.recording import Recording

Cli = Any
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
    replace(demo, keypoints=demo.video[600:720]).save(folder)
    return folder


@pytest.fixture(scope="module")
def reconstructed(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of `reconstruct` on it."""
    out = tmp_path_factory.mktemp("outputs") / "short"
    assert main(["reconstruct", str(short), "-o", str(out), "--no-figures"]) == 0
    return out


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- all commands --------------------------------------------------------------------------------


def test_help_lists_and_explains_every_command(cli: Cli) -> None:
    listed = cli("--help").out.split()
    for command in COMMANDS:
        assert command in listed
        done = cli(command, "--help")
        assert done.code == 0
        assert f"usage: rtof-kin {command}" in done.out
        assert len(done.out) > 300, command


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
def test_ctrl_c_while_importing_exits_with_130(module: str) -> None:
    code = [sys.executable, "-c", INTERRUPTED, module]
    done = subprocess.run(code, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_ctrl_c_while_arguments_are_parsed_exits_with_130(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", interrupt)
    done = cli("inspect", "none")
    assert (done.code, done.err) == (130, "interrupted")


@pytest.mark.parametrize("command", ["reconstruct", "calibrate"])
def test_unwritable_output_is_refused_before_the_work(
    short: Path, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    for work in ("reconstruct", "calibrate_recording"):
        monkeypatch.setattr(f"rtof_kin.reconstruction.pipeline.{work}", None)
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    done = cli(command, short, "-o", blocked / "out")
    assert done.code == 2
    assert str(blocked) in done.err


OWN = ("notes.txt", "report.html", "clinical/angles.csv")


@pytest.mark.parametrize("command, own, named", [
    (["reconstruct", "{short}", "-o", "{out}"], (), "--overwrite"),
    (["export", "{out}", "{out}", "--to", "bvh", "--overwrite"], (), "motion.npz"),
    (["export", "{out}", "{out}", "--to", "bvh", "--overwrite"], OWN, "clinical/, notes.txt, report.html"),
    (["demo", "-o", "{out}", "--overwrite"], OWN, "clinical/, notes.txt, report.html"),
])  # fmt: skip
def test_files_of_the_user_and_of_other_commands_are_not_overwritten(
    short: Path, reconstructed: Path, tmp_path: Path, cli: Cli, command: list[str], own: tuple[str, ...],
    named: str,
) -> None:  # fmt: skip
    out = shutil.copytree(reconstructed, tmp_path / "out")
    for name in own:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    before = contents(out)
    done = cli(*(word.format(short=short, out=out) for word in command))
    assert done.code == 2
    assert named in done.err
    assert contents(out) == before


# --- reconstruct and calibrate -------------------------------------------------------------------


def test_reconstruct_writes_the_whole_output(reconstructed: Path) -> None:
    assert names_in(reconstructed) == {
        "motion.npz", "skeleton.urdf", "joint_trajectory.csv", "joint_trajectory.json",
        "ros_joint_trajectory.json", "ros_base_trajectory.json", "motion.csv", "files.json", "summary.json",
        MANIFEST,
    }  # fmt: skip
    summary = json.loads((reconstructed / "summary.json").read_text())
    assert summary["mode"] == "rtof"
    assert set(summary["metrics"]) == {"lift", "sf2", "rtof"}
    assert summary["metrics"]["rtof"]["mpjpe_rr_mm"] < 90
    assert len(read_motion_npz(reconstructed / "motion.npz").q) == 120


def test_calibrate_prints_a_table_and_writes_what_reconstruct_takes(
    short: Path, tmp_path: Path, cli: Cli
) -> None:
    found, fixed = tmp_path / "found.toml", tmp_path / "fixed"
    command = ("calibrate", short, "-o", found, "--recording-output", fixed)
    done = cli(*command)
    assert done.code == 0
    assert "quantities: " in done.out
    assert "image bias" in done.out
    assert Recording.load(fixed).video.names == Recording.load(short).video.names
    again = cli(*command)
    assert again.code == 2
    assert "overwrite" in again.err
    out = tmp_path / "out"
    assert cli("reconstruct", short, "-o", out, "--no-figures", "--calibration", found).code == 0


def test_mode_names_the_input_that_it_lacks(short: Path, tmp_path: Path, cli: Cli) -> None:
    folder, out = tmp_path / "camera_only", tmp_path / "out"
    replace(Recording.load(short), imus=None, calibration=None).save(folder)
    done = cli("reconstruct", folder, "-o", out)
    assert done.code == 2
    assert "'rto'" in done.err
    assert cli("reconstruct", folder, "-o", out, "--mode", "lift", "--no-figures").code == 0


def test_mode_imu_needs_no_keypoints(short: Path, tmp_path: Path, cli: Cli) -> None:
    folder, out = tmp_path / "sensors_only", tmp_path / "out"
    replace(Recording.load(short), keypoints=None).save(folder)
    refused = cli("reconstruct", folder, "-o", out)
    assert refused.code == 2
    assert "'imu'" in refused.err
    done = cli("reconstruct", folder, "-o", out, "--mode", "imu")
    assert done.code == 0
    assert (out / "figures" / "skeletons.png").is_file()
    score = json.loads((out / "summary.json").read_text())["metrics"]["imu"]["mpjpe_rr_mm"]
    for text in (done.out, cli("evaluate", out, "--truth", folder).out):
        assert re.search(rf"\bimu\W+{score:.1f}\b", text)
        assert BEGUN_TOGETHER in text


def test_acceleration_in_g_is_refused(short: Path, tmp_path: Path, cli: Cli) -> None:
    folder = shutil.copytree(short, tmp_path / "in_g")
    arrays = dict(np.load(folder / "imus.npz"))
    arrays["f_sensor"] = arrays["f_sensor"] / 9.81
    np.savez(folder / "imus.npz", **arrays)
    done = cli("reconstruct", folder, "-o", tmp_path / "out")
    assert done.code == 2
    assert "imus.npz" in done.err
    assert "m/s^2" in done.err
    assert not (tmp_path / "out").exists()


def test_wrong_files_are_refused_in_one_line(short: Path, tmp_path: Path, cli: Cli) -> None:
    out, lifter, motion = tmp_path / "out", tmp_path / "broken.pt", tmp_path / "motion.npz"
    lifter.write_bytes(os.urandom(1000))
    motion.write_bytes(b"PK\x03\x04 not a zip")
    for command, named in (
        (("reconstruct", tmp_path / "none", "-o", out), "recording.toml"),
        (("reconstruct", short, "-o", out, "--lifter", lifter), "broken.pt"),
        (("evaluate", motion, "--truth", short), "motion.npz"),
    ):
        done = cli(*command)
        assert done.code == 2
        assert done.err.startswith("error: ") or "error: " in done.err
        assert named in done.err
        assert not out.exists()


# --- evaluate, export, simulate ------------------------------------------------------------------


def test_evaluate_prints_the_stage_beside_zero_motion(short: Path, reconstructed: Path, cli: Cli) -> None:
    done = cli("evaluate", reconstructed, "--truth", short)
    assert done.code == 0
    for text in ("rtof", "zero", "LeftForeArm", "[m/s2]"):
        assert text in done.out
    assert "\u2026" not in done.out  # no heading is cut at 80 columns


def test_export_writes_what_was_asked(reconstructed: Path, tmp_path: Path, cli: Cli) -> None:
    ros, every = tmp_path / "ros", tmp_path / "all"
    assert cli("export", reconstructed, "-o", ros, "--to", "ros").code == 0
    assert names_in(ros) == {
        "skeleton.urdf", "files.json", "ros_joint_trajectory.json", "ros_base_trajectory.json", MANIFEST,
    }  # fmt: skip
    export = ("export", reconstructed / "motion.npz", every, "--to")
    done = cli(*export, "mot, trc,osim,c3d,bvh,csv,parquet")
    assert done.code == 0
    assert "motion.parquet" in done.out
    index = json.loads((every / "files.json").read_text())
    formats = {facts["format"] for facts in index["files"].values()}
    assert formats == {"urdf", "mot", "trc", "osim", "c3d", "bvh", "csv", "parquet"}
    assert cli(*export, "mot").code == 2
    assert cli(*export, "mot", "--overwrite").code == 0
    assert not (every / "motion.trc").exists()


@pytest.mark.parametrize("arguments, named", [
    (["--to", "fbx", "OUT"], "'fbx'"), (["OUT", "-o", "OUT"], "-o OUT"), (["--to", "mot"], "required: OUT"),
])  # fmt: skip
def test_export_refuses_wrong_arguments(
    reconstructed: Path, tmp_path: Path, cli: Cli, arguments: list[str], named: str
) -> None:
    place = [tmp_path / "out" if word == "OUT" else word for word in arguments]
    done = cli("export", reconstructed, *place)
    assert done.code == 2
    assert named in done.err
    assert list(tmp_path.iterdir()) == []


def test_simulate_writes_a_recording_with_the_sensors_asked_for(tmp_path: Path, cli: Cli) -> None:
    folder = tmp_path / "r [mm] [red]x"  # brackets are no markup
    command = ("simulate", MOCAP / "02_01_excerpt.bvh", "-o", folder, "--keypoints", "perfect", "--sensors")
    wrong = cli(*command, "L_LowrArm")
    assert wrong.code == 2
    assert "'L_LowArm'" in wrong.err
    assert not folder.exists()
    done = cli(*command, "Pelvis,L_LowArm")
    assert done.code == 0
    assert str(folder) in done.out
    recording = Recording.load(folder)
    assert recording.imus is not None
    assert recording.imus.names == ("Pelvis", "L_LowArm")
    assert recording.truth is not None
    again = cli(*command, "Pelvis")
    assert again.code == 2
    assert str(folder) in again.err
