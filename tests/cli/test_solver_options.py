"""Options that choose the solver: what they do, what is written of them, what does not go together."""

from __future__ import annotations

import argparse
import json
import re
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.cli.solver_options import add_solver_options, settings_of
from rtof_kin.core.resources import model_path
from rtof_kin.core.threads import limit_threads, threads
from rtof_kin.reconstruction.result import _energy_name
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.joint_space.settings import JointSpaceSettings


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of the demo with two sensors, of which one says nothing for a while."""
    demo = Recording.load(model_path("demo"))
    assert demo.imus is not None
    imus = demo.imus.select(demo.imus.names[-2:])
    times = demo.video.times[600:632]
    stuck = (imus.times > times[2]) & (imus.times < times[-2])
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    first = int(np.flatnonzero(stuck)[0])
    R[stuck, 0], f[stuck, 0] = R[first, 0], f[first, 0]
    imus = replace(imus, R_inertial_sensor=R, f_sensor=f)
    folder = tmp_path_factory.mktemp("recordings") / "short"
    replace(demo, keypoints=demo.video[600:632], imus=imus, truth=None).save(folder)
    return folder


def settings_after(short: Path, out: Path, *options: str) -> dict[str, Any]:
    """What the summary says that was chosen."""
    command = ["reconstruct", str(short), "-o", str(out), "--no-figures", "--frames", "16", *options]
    assert main(command) == 0
    found: dict[str, Any] = json.loads((out / "summary.json").read_text())["settings"]
    return found


def test_terminal_summary_and_page_say_the_same_and_each_thing_once(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    found = settings_after(short, tmp_path / "out", "--no-calibrate")
    assert found.pop("fragment")["jerk"] == 2.5
    assert found == {
        "space": "joint", "backend": "realtime", "energy": "default", "frames": 16,
        "guard_streams": True, "lift_with_sensors": True, "lifter": "detections", "calibrate": "no",
        "known_of_another_recording": False, "threads": threads(),
    }  # fmt: skip
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    text = " ".join(capsys.readouterr().out.split())
    verdict = summary["verdict"]
    assert text.startswith(f"{verdict['grade']}: {verdict['headline']}")
    assert text.count("the sensor repeated one sample") == 1
    assert "repeated" not in caplog.text
    assert summary["solver"]["outcome"] in text
    assert main(["report", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "joint space, realtime, energy: default; 16 frames a fragment" in page
    first = re.search(r'<h1>.*</h1>\s*<p class="headline">.*</span> (.*)</p>', page)
    assert first is not None
    assert unescape(first[1]) == verdict["headline"]


def test_the_papers_energy_is_solved_in_cartesian_space(short: Path, tmp_path: Path) -> None:
    found = settings_after(
        short, tmp_path / "out", "--paper", "--no-calibrate", "--no-guards", "--no-lift-with-sensors",
        "--lifter", "causal",
    )  # fmt: skip
    assert (found["space"], found["backend"], found["energy"]) == ("cartesian", "ipopt", "as printed")
    assert (found["fragment"]["k_V"], found["fragment"]["bone_lengths"]) == (0.9, "free")
    assert (found["guard_streams"], found["lift_with_sensors"]) == (False, False)
    assert found["lifter"] == "causal"
    assert "stream_faults" not in json.loads((tmp_path / "out" / "summary.json").read_text())


def test_a_recording_that_is_calibrated_keeps_its_energy_with_another_solver(
    short: Path, tmp_path: Path
) -> None:
    found = settings_after(short, tmp_path / "out", "--backend", "ipopt", "--space", "joint")
    assert (found["space"], found["backend"]) == ("joint", "ipopt")
    assert (found["calibrate"], found["energy"]) == ("yes", "default, calibrated")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], JointSpaceSettings()),
        (["--space", "joint", "--backend", "ipopt"], JointSpaceSettings(backend="ipopt")),
        (["--space", "cartesian"], CartesianSettings()),
        (["--space", "cartesian", "--backend", "realtime"], CartesianSettings(backend="realtime")),
        (["--paper"], CartesianSettings.paper()),
        (["--paper", "--backend", "realtime"], CartesianSettings.paper("realtime")),
    ],
)
def test_space_and_backend_are_chosen(options: list[str], expected: object) -> None:
    parser = argparse.ArgumentParser()
    add_solver_options(parser)
    settings = settings_of(parser.parse_args(options))
    assert settings.solver(SkeletonModel.default()) == expected


def test_the_energy_that_is_written_is_the_one_that_was_solved() -> None:
    assert _energy_name(JointSpaceSettings.calibrated()) == "default, calibrated"
    assert _energy_name(JointSpaceSettings(backend="ipopt", floor_height=0.1)) == "default"
    assert _energy_name(JointSpaceSettings(jerk=7.0)) == "own"
    assert _energy_name(CartesianSettings()) == "default"
    assert _energy_name(CartesianSettings.paper("realtime")) == "as printed"


@pytest.mark.parametrize(
    ("command", "remedy"),
    [
        (["reconstruct", "--paper", "--space", "joint"], "leave out --space joint"),
        (["reconstruct", "--space", "cartesian", "--mode", "imu"], "leave out --space cartesian"),
        (["reconstruct", "--paper", "--mode", "imu"], "leave out --paper"),
        (["reconstruct", "--backend", "ipopt", "--mode", "sf2"], "leave out --space, --backend"),
        (["calibrate", "--space", "cartesian"], "leave out --space cartesian"),
        (["calibrate", "--paper"], "leave out --paper"),
        (["study", "--paper", "--space", "joint"], "leave out --space joint"),
        (["reconstruct", "--threads", "0"], "give 1 or more"),
        (["study", "--frames", "7"], "N = 7 must be even"),
    ],
)
def test_what_does_not_go_together_is_one_line_with_a_remedy(
    short: Path, tmp_path: Path, command: list[str], remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *options = command
    assert main([name, str(short), "-o", str(tmp_path / "out"), *options]) == 2
    message = capsys.readouterr().err
    assert remedy in " ".join(message.split())
    assert not (tmp_path / "out").exists()


def test_calibrate_says_first_how_much_it_observed(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found.toml"
    assert main(["calibrate", str(short), "-o", str(out), "--frames", "16", "--no-guards"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert not text.startswith("pass")
    assert text.index("quantities: ") < text.index("calibrated from itself")


def test_threads_are_limited_before_libraries_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "")
    monkeypatch.delitem(sys.modules, "numpy")
    limit_threads(None)
    assert threads() == 1
    limit_threads(3)
    assert threads() == 3
    limit_threads(None)  # what the environment says stands
    assert threads() == 3


def test_threads_of_libraries_that_are_loaded_already_are_refused() -> None:
    limit_threads(threads())
    with pytest.raises(ValueError, match="loaded already; set OMP_NUM_THREADS=77"):
        limit_threads(77)
