"""Options of the solver: settings that they choose, how they are written, contradictions."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli.solver_options import add_solver_options, settings_of
from rtof_kin.core.threads import limit_threads, threads
from rtof_kin.reconstruction.result import _energy_name
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

Cli = Any


@pytest.fixture(scope="module")
def short(few_sensors: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second; one of the two sensors repeats a sample for most of it."""
    imus, times = few_sensors.imus, few_sensors.video.times[:32]
    assert imus is not None
    stuck = (imus.times > times[2]) & (imus.times < times[-2])
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    first = int(np.flatnonzero(stuck)[0])
    R[stuck, 0], f[stuck, 0] = R[first, 0], f[first, 0]
    imus = replace(imus, R_inertial_sensor=R, f_sensor=f)
    folder = tmp_path_factory.mktemp("recordings") / "short"
    replace(few_sensors, keypoints=few_sensors.video[:32], imus=imus).save(folder)
    return folder


def summary_after(cli: Cli, short: Path, out: Path, *options: str) -> tuple[dict[str, Any], str]:
    """Summary and output of `reconstruct` with options."""
    done = cli("reconstruct", short, "-o", out, "--no-figures", "--frames", "16", *options)
    assert done.code == 0
    return json.loads((out / "summary.json").read_text()), done.out


def test_terminal_summary_and_page_agree_and_state_each_thing_once(
    short: Path, tmp_path: Path, cli: Cli, caplog: pytest.LogCaptureFixture
) -> None:
    summary, text = summary_after(cli, short, tmp_path / "out", "--no-calibrate")
    settings, verdict = summary["settings"], summary["verdict"]
    assert settings.pop("fragment")["jerk"] == 2.5
    assert settings == {
        "space": "joint", "backend": "realtime", "energy": "default", "frames": 16,
        "guard_streams": True, "lift_with_sensors": True, "lifter": "detections", "calibrate": "no",
        "known_of_another_recording": False, "threads": threads(),
    }  # fmt: skip
    assert text.count("repeated one sample") == 1
    assert "repeated" not in caplog.text
    assert verdict["headline"] in text
    assert summary["solver"]["outcome"] in text
    assert cli("report", tmp_path / "out").code == 0
    page = unescape((tmp_path / "out" / "report.html").read_text())
    assert verdict["headline"] in page
    assert "joint space, realtime, energy: default; 16 frames" in page


def test_summary_comes_before_the_tables(short: Path, tmp_path: Path, cli: Cli) -> None:
    _, text = summary_after(cli, short, tmp_path / "out", "--no-calibrate")
    places = [text.index(word) for word in ("recording ", "accuracy ", "caution ", "files ", "next ")]
    assert places == sorted(places)
    assert places[0] == 0
    assert places[-1] < text.index("section verdict")


def test_paper_is_solved_in_cartesian_space(short: Path, tmp_path: Path, cli: Cli) -> None:
    summary, _ = summary_after(
        cli, short, tmp_path / "out", "--paper", "--no-calibrate", "--no-guards", "--no-lift-with-sensors",
        "--lifter", "causal",
    )  # fmt: skip
    found = summary["settings"]
    assert (found["space"], found["backend"], found["energy"]) == ("cartesian", "ipopt", "as printed")
    assert (found["fragment"]["k_V"], found["fragment"]["bone_lengths"]) == (0.9, "free")
    assert (found["guard_streams"], found["lift_with_sensors"]) == (False, False)
    assert found["lifter"] == "causal"
    assert "stream_faults" not in summary


def test_calibrated_recording_keeps_its_energy_with_another_backend(
    short: Path, tmp_path: Path, cli: Cli
) -> None:
    summary, _ = summary_after(cli, short, tmp_path / "out", "--backend", "ipopt", "--space", "joint")
    found = summary["settings"]
    assert (found["space"], found["backend"]) == ("joint", "ipopt")
    assert (found["calibrate"], found["energy"]) == ("yes", "default, calibrated")


@pytest.mark.parametrize("options, expected", [
    ([], JointSpaceSettings()),
    (["--space", "joint", "--backend", "ipopt"], JointSpaceSettings(backend="ipopt")),
    (["--space", "cartesian"], CartesianSettings()),
    (["--space", "cartesian", "--backend", "realtime"], CartesianSettings(backend="realtime")),
    (["--paper"], CartesianSettings.paper()),
    (["--paper", "--backend", "realtime"], CartesianSettings.paper("realtime")),
])  # fmt: skip
def test_options_choose_space_and_backend(options: list[str], expected: object) -> None:
    parser = argparse.ArgumentParser()
    add_solver_options(parser)
    assert settings_of(parser.parse_args(options)).solver(SkeletonModel.default()) == expected


@pytest.mark.parametrize("settings, name", [
    (JointSpaceSettings.calibrated(), "default, calibrated"),
    (JointSpaceSettings(backend="ipopt", floor_height=0.1), "default"), (JointSpaceSettings(jerk=7.0), "own"),
    (CartesianSettings(), "default"), (CartesianSettings.paper("realtime"), "as printed"),
])  # fmt: skip
def test_energy_is_named(settings: JointSpaceSettings | CartesianSettings, name: str) -> None:
    assert _energy_name(settings) == name


@pytest.mark.parametrize("command, remedy", [
    ("reconstruct --paper --space joint", "leave out --space joint"),
    ("reconstruct --space cartesian --mode imu", "leave out --space cartesian"),
    ("reconstruct --paper --mode imu", "leave out --paper"),
    ("reconstruct --backend ipopt --mode sf2", "leave out --space, --backend"),
    ("calibrate --space cartesian", "leave out --space cartesian"),
    ("calibrate --paper", "leave out --paper"),
    ("study --paper --space joint", "leave out --space joint"),
    ("reconstruct --threads 0", "1 or more"),
    ("study --frames 7", "even"),
])  # fmt: skip
def test_contradicting_options_are_refused_with_a_remedy(
    short: Path, tmp_path: Path, cli: Cli, command: str, remedy: str
) -> None:
    name, *options = command.split()
    done = cli(name, short, "-o", tmp_path / "out", *options)
    assert done.code == 2
    assert remedy in done.err
    assert not (tmp_path / "out").exists()


def test_calibrate_prints_its_verdict_before_the_table(short: Path, tmp_path: Path, cli: Cli) -> None:
    done = cli("calibrate", short, "-o", tmp_path / "found.toml", "--frames", "16", "--no-guards")
    assert done.code == 0
    assert not done.out.startswith("pass")
    assert done.out.index("quantities: ") < done.out.index("prior +-")


def test_threads_are_limited_before_libraries_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "")
    monkeypatch.delitem(sys.modules, "numpy")
    for count, expected in ((None, 1), (3, 3), (None, 3)):  # without a count the environment decides
        limit_threads(count)
        assert threads() == expected


def test_threads_of_loaded_libraries_cannot_be_changed() -> None:
    limit_threads(threads())
    with pytest.raises(ValueError, match="OMP_NUM_THREADS=77"):
        limit_threads(77)
