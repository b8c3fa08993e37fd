"""The command line: output, files, refusals and exit codes of the commands on recordings and motions."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.metrics import BEGUN_TOGETHER, at_times
from rtof_kin.body.skeleton import Motion
from rtof_kin.cli.terminal import STYLES, accuracy, log_handler, print_headline
from rtof_kin.core.errors import FileFormatError, OutputExistsError, RtofError, plain
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit_results import AuditResult, headline

MOCAP = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"
OWN = ("notes.txt", "report.html", "clinical/angles.csv")
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


@pytest.fixture(scope="module")
def wrong(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of recordings and files that lack something."""
    folder, recording = tmp_path_factory.mktemp("wrong"), Recording.load(short)
    assert recording.imus is not None
    replace(recording, imus=None, calibration=None).save(folder / "camera_only")
    replace(recording, keypoints=None, imus=recording.imus[:180]).save(folder / "sensors_only")
    shutil.copytree(short, folder / "in_g")
    arrays = dict(np.load(short / "imus.npz"))
    np.savez(folder / "in_g" / "imus.npz", **arrays | {"f_sensor": arrays["f_sensor"] / 9.81})
    (folder / "broken.pt").write_bytes(os.urandom(1000))
    (folder / "motion.h5").write_bytes(b"PK\x03\x04 not a zip")
    return folder


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("module", ["cyclopts", "rich.console", "numpy"])
def test_ctrl_c_exits_with_130_even_while_importing(module: str) -> None:
    code = [sys.executable, "-c", INTERRUPTED, module]
    done = subprocess.run(code, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


@pytest.mark.parametrize(
    "command, named",
    [
        ("reconstruct {wrong}/none -o {out}", "recording.toml"),
        ("reconstruct {wrong}/in_g -o {out}", "m/s^2"),
        ("reconstruct {wrong}/camera_only -o {out} --mode rtof", "'rto'"),
        ("reconstruct {wrong}/sensors_only -o {out} --mode rtof", "'imu'"),
        ("reconstruct {short} -o {out} --model {wrong}/broken.pt", "broken.pt"),
        ("reconstruct {short} -o {out} --threads 0", "1 or more"),
        ("reconstruct {short} -o {out} --paper --space joint", "leave out --space joint"),
        ("reconstruct {short} -o {out} --space cartesian --mode imu", "leave out --space cartesian"),
        ("reconstruct {short} -o {out} --paper --mode imu", "leave out --paper"),
        ("reconstruct {short} -o {out} --space joint --mode sf2", "leave out --space and --paper"),
        ("reconstruct {short} --calibrate-only -o {out} --space cartesian", "leave out --space cartesian"),
        ("reconstruct {short} --calibrate-only -o {out} --paper", "leave out --paper"),
        ("study {short} -o {out} --paper --space joint", "leave out --space joint"),
        ("study {short} -o {out} --frames 7", "even"),
        ("study {wrong}/camera_only -o {out}", "no IMUs"),
        ("evaluate {wrong}/motion.h5 --truth {short}", "motion.h5"),
        ("simulate {mocap} -o {out} --sensors L_LowrArm", "'L_LowArm'"),
        ("export {motion} {out} --to fbx", "'fbx'"),
        ("export {motion} {out} -o {out}", "-o OUT"),
        ("export {motion} --to mot", "as OUT or with -o OUT"),
        ("report {wrong}/none -o {out}", "no such file"),
        ("report {motion} -o {out} --date 31.1.2026", "31.1.2026"),
        ("report {motion} -o {out} --weight -3", "-3 kg"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    short: Path, reconstructed: Path, wrong: Path, tmp_path: Path, cli: Any, command: str, named: str
) -> None:
    paths = {"short": short, "motion": reconstructed, "wrong": wrong, "mocap": MOCAP, "out": tmp_path / "out"}
    done = cli.refused(*(word.format(**paths) for word in command.split()))
    assert done.err.count("error: ") == 1
    assert named in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [(), ("--calibrate-only",)])
def test_unwritable_output_is_refused_before_the_work(
    short: Path, wrong: Path, cli: Any, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...]
) -> None:
    monkeypatch.setattr("rtof_kin.reconstruction.pipeline.reconstruct", None)
    monkeypatch.setattr("rtof_kin.reconstruction.self_calibration.calibrate_recording", None)
    assert "broken.pt" in cli.refused("reconstruct", short, *options, "-o", wrong / "broken.pt" / "out").err


@pytest.mark.parametrize(
    "command, own, named",
    [
        ("reconstruct {short} -o {out}", (), "--overwrite"),
        ("export {out} {out} --to bvh --overwrite", (), "motion.h5"),
        ("export {out} {out} --to bvh --overwrite", OWN, "clinical/, notes.txt, report.html"),
        ("run --demo -o {out} --overwrite", OWN, "clinical/, notes.txt, report.html"),
    ],
)
def test_files_of_the_user_and_of_other_commands_are_not_overwritten(
    short: Path, reconstructed: Path, tmp_path: Path, cli: Any, command: str, own: tuple[str, ...], named: str
) -> None:
    out = shutil.copytree(reconstructed, tmp_path / "out")
    for name in own:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    before = contents(out)
    assert named in cli.refused(*(word.format(short=short, out=out) for word in command.split())).err
    assert contents(out) == before


def test_reconstruct_writes_the_whole_output(reconstructed: Path) -> None:
    assert names_in(reconstructed) == {
        "motion.h5",
        "skeleton.urdf",
        "joint_trajectory.csv",
        "joint_trajectory.json",
        "ros_joint_trajectory.json",
        "ros_base_trajectory.json",
        "motion.csv",
        "files.json",
        "summary.json",
        "measurements.h5",
        MANIFEST,
    }
    summary = json.loads((reconstructed / "summary.json").read_text())
    assert summary["mode"] == "rtof"
    assert set(summary["metrics"]) == {"lift", "sf2", "rtof"}
    assert summary["metrics"]["rtof"]["mpjpe_rr_mm"] < 90
    assert len(Motion.load(reconstructed / "motion.h5").q) == 120
    sizes = [(reconstructed / name).stat().st_size for name in ("motion.h5", "measurements.h5")]
    assert sum(sizes) / 120 * 3600 <= 4e6  # bytes a minute at 60 Hz; docs/output.md has those of a longer one


def test_calibrate_prints_a_table_and_writes_what_reconstruct_takes(short: Path, tmp_path: Path, cli: Any) -> None:
    found, fixed = tmp_path / "found.toml", tmp_path / "fixed"
    command = ("reconstruct", short, "--calibrate-only", "-o", found, "--calibrated", fixed)
    done = cli.ok(*command)
    assert done.out.index("quantities: ") < done.out.index("prior +-") < done.out.index("image bias")
    assert Recording.load(fixed).video.names == Recording.load(short).video.names
    assert "overwrite" in cli(*command).err
    out = tmp_path / "out"
    assert cli("reconstruct", short, "-o", out, "--calibration", found).code == 0


def test_reconstruct_takes_the_mode_of_what_was_recorded(short: Path, tmp_path: Path, cli: Any) -> None:
    both = Recording.load(short)
    few = both.video[:60]
    replace(both, keypoints=few, imus=None, calibration=None).save(tmp_path / "seen")
    assert cli("reconstruct", tmp_path / "seen", "-o", tmp_path / "out").code == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["mode"] == "rto"
    assert "reconstructed motion" in cli("inspect", tmp_path / "out").out
    assert both.usual_mode == "rtof"


def test_points_of_other_models_count_beside_the_own_lift_and_are_named(short: Path, tmp_path: Path, cli: Any) -> None:
    recording = replace(Recording.load(short), imus=None, calibration=None)
    assert recording.truth is not None
    at = at_times(recording.truth, recording.times)
    names, other = tmp_path / "names.npz", tmp_path / "joints.npz"
    wrong = tmp_path / "mirrored.npz"
    np.savez(names, times=at.times, names=np.array(at.names), p_world=1000 * at.p_world_joint)
    np.savez(other, joints=at.p_world_joint)
    np.savez(wrong, times=at.times, names=np.array(at.names), p_world=at.p_world_joint * [-1, 1, 1])
    recording.save(tmp_path / "seen")
    options = ("--mode", "lift", "-o")
    alone = cli.ok("reconstruct", tmp_path / "seen", *options, tmp_path / "alone")
    lifts = ("--lift", names, "--lift", f"{other}:joints", "--lift", wrong)
    done = cli.ok("reconstruct", tmp_path / "seen", *options, tmp_path / "out", *lifts)
    done.says(
        "lift names.npz (the skeleton's own joints): in mm (scale 0.00",
        "lift joints.npz (the skeleton's own joints): in m (scale 1",
        "lift mirrored.npz (the skeleton's own joints): left out, its points are mirrored",
    )
    assert "lift names" not in alone.out
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("alone", "out")]
    errors = [one["metrics"]["lift"]["mpjpe_rr_mm"] for one in summaries]
    assert errors[1] < 0.75 * errors[0]
    assert summaries[1]["inputs"]["lifts"] == ["names.npz", "joints.npz"]
    assert len(summaries[1]["run"]["lift_sha256"]) == 3
    assert [one for one in summaries[1]["warnings"] if one.startswith("mirrored.npz is not used as a lift: its points")]
    cli.ok("report", tmp_path / "out", "-o", tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert "with the 3D points of names.npz and joints.npz" in page
    assert "mirrored.npz (the skeleton&#39;s own joints): left out" in page
    done = cli.refused("export", tmp_path / "out", tmp_path / "a.zip", "--to", "archive")
    assert "made with --lift, and the archive has the recording only; name the points in its [lift]" in done.err
    for file in (names, other, wrong):
        file.rename(tmp_path / "seen" / file.name)
    with (tmp_path / "seen" / INDEX).open("a") as stream:
        stream.write('[lift]\nfiles = ["names.npz", "joints.npz:joints", "mirrored.npz"]\n')
    cli.ok("reconstruct", tmp_path / "seen", *options, tmp_path / "same")
    same = (tmp_path / name / "motion.h5" for name in ("out", "same"))
    assert next(same).read_bytes() == next(same).read_bytes()
    cli.ok("export", tmp_path / "same", tmp_path / "a.zip", "--to", "archive", "--recording", tmp_path / "seen")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert "recording/lift_3.npz" in archive.namelist()
        assert b"mirrored.npz" not in archive.read("result/summary.json")


def test_a_lift_stands_beside_sensors_without_a_video(short: Path, tmp_path: Path, cli: Any) -> None:
    recording, given = Recording.load(short), tmp_path / "joints.npz"
    assert recording.truth is not None
    assert recording.imus is not None
    recording = replace(recording, keypoints=None, imus=recording.imus[:150])
    at = at_times(recording.truth, recording.times[::2])
    np.savez(given, times=at.times - 7.0, names=np.array(at.names), p_world=at.p_world_joint)
    recording.save(tmp_path / "sensed")
    command = ("reconstruct", tmp_path / "sensed", "-o")
    cli.ok(*command, tmp_path / "out", "--lift", given).says(
        "lift joints.npz (the skeleton's own joints): in m (scale 1"
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["mode"], summary["inputs"]["lifts"]) == ("imu", ["joints.npz"])
    done = cli.refused(*command, tmp_path / "no", "--lift", tmp_path / "a.mot")
    assert "angles of a model that is not here; give the .trc of points beside it" in done.err


def test_a_mistyped_choice_is_one_line_with_what_was_meant(cli: Any) -> None:
    done = cli.refused("recnstruct")
    assert done.err.startswith('error: Unknown command "recnstruct". Did you mean "reconstruct"?')


def test_modes_lift_and_imu_need_one_stream(wrong: Path, tmp_path: Path, cli: Any) -> None:
    recording, out = wrong / "sensors_only", tmp_path / "out"
    done = cli.ok("reconstruct", recording, "-o", out, "--mode", "imu")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["root_drift_sigma_m"]["last_frame"] > 0
    score = summary["metrics"]["imu"]["mpjpe_rr_mm"]
    for text in (done.out, cli("evaluate", out, "--truth", recording).out):
        assert re.search(rf"\bimu\W+{score:.1f}\b", text)
        assert BEGUN_TOGETHER in text
    options = ("-o", tmp_path / "lift", "--mode", "lift")
    assert cli("reconstruct", wrong / "camera_only", *options).code == 0


def test_evaluate_prints_the_stage_beside_zero_motion(short: Path, reconstructed: Path, cli: Any) -> None:
    done = cli.ok("evaluate", reconstructed, "--truth", short)
    done.says("rtof", "zero", "LeftForeArm", "[m/s2]", "worlds aligned: the motion is turned by")
    assert "\u2026" not in done.out  # no heading is cut at 80 columns


def test_export_writes_what_was_asked(reconstructed: Path, tmp_path: Path, cli: Any) -> None:
    ros, every = tmp_path / "ros", tmp_path / "all"
    assert cli("export", reconstructed, "-o", ros, "--to", "ros").code == 0
    assert names_in(ros) == {
        "skeleton.urdf",
        "files.json",
        "ros_joint_trajectory.json",
        "ros_base_trajectory.json",
        MANIFEST,
    }
    export = ("export", reconstructed / "motion.h5", every, "--to")
    done = cli.ok(*export, "mot, trc,osim,c3d,bvh,csv,parquet")
    assert "motion.parquet" in done.out
    index = json.loads((every / "files.json").read_text())
    formats = {facts["format"] for facts in index["files"].values()}
    assert formats == {"urdf", "mot", "trc", "osim", "c3d", "bvh", "csv", "parquet"}
    assert cli(*export, "mot").code == 2
    assert cli(*export, "mot", "--overwrite").code == 0
    assert not (every / "motion.trc").exists()


def test_simulate_writes_a_recording_with_the_sensors_asked_for(tmp_path: Path, cli: Any) -> None:
    folder = tmp_path / "r [mm] [red]x"  # brackets are no markup
    command = ("simulate", MOCAP, "-o", folder, "--noise", "perfect", "--sensors", "Pelvis,L_LowArm")
    done = cli.ok(*command)
    assert str(folder) in done.out
    recording = Recording.load(folder)
    assert recording.imus is not None
    assert recording.imus.names == ("Pelvis", "L_LowArm")
    assert recording.truth is not None
    assert str(folder) in cli(*command).err


def test_paths_longer_than_the_system_takes_are_one_sentence(cli, tmp_path: Path) -> None:
    name, path = "x" * 300, "/".join(["y" * 200] * 25)
    for long in (name, path):
        for arguments in (
            ("reconstruct", long, "-o", tmp_path / "out"),
            ("reconstruct", tmp_path, "-o", tmp_path / long),
            ("inspect", long),
            ("batch", tmp_path, "-o", tmp_path / long),
            ("live", long, "--imus", long),
            ("export", long, "--to", "osim", tmp_path / "a"),
        ):
            done = cli(*arguments)
            assert (done.code, done.err.count("error: ")) == (2, 1), (arguments, done.err)
            assert "Traceback" not in done.err


def test_escape_codes_of_others_do_not_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    text = "\x1b[1mWeights only\x1b[0m \x1b]0;title\x07\x1b]8;;http://x\x1b\\load\x9b2J\x08 failed\n\x1b[3"
    assert plain(text) == "Weights only load2J failed\n"
    assert str(RtofError(text)) == str(FileFormatError("a", text)).removeprefix("a: ") == plain(text)
    assert str(OutputExistsError(text)) == plain(text)
    handler = log_handler()
    handler.handle(logging.LogRecord("torch", logging.WARNING, "", 0, "%s", (text,), None))
    assert capsys.readouterr().err == "WARNING: Weights only load2J failed\n\n"


@pytest.mark.parametrize("sigma, words", [(np.nan, "unknown"), (0.01, "expected 16 mm relative")])
def test_accuracy_without_truth_is_that_of_the_covariances_or_unknown(sigma: float, words: str) -> None:
    assert words in accuracy(None, (sigma, sigma), "rto")


def test_a_plausible_verdict_is_printed_with_what_would_prove_it(capsys: pytest.CaptureFixture[str]) -> None:
    lone = AuditResult.not_checked("certificate", "motion", "a camera alone proves no angle: add a sensor")
    print_headline(headline([AuditResult("image", "error", "Head", 1.0, "px", 2.0, 5.0), lone]))
    line, *table = capsys.readouterr().out.splitlines()
    assert line == f"plausible: checked, no problem found in image; not proven: {lone.note}"
    assert re.search(r"certificate\s+not checked\s+motion: a camera alone", "\n".join(table))
    assert len({STYLES[grade] for grade in ("pass", "plausible", "warn", "fail")}) == 4
