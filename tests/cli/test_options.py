"""Options: from the fields of settings, and what those of the solver choose."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from cyclopts import App

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import COMMANDS, OLD_COMMANDS, command_names, main
from rtof_kin.cli.options import Fields, command, descriptions
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.choices import GUARDS
from rtof_kin.core.environment import limit_threads, threads
from rtof_kin.reconstruction.result import _energy_name
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings


def summary_after(cli: Any, recording: Path, out: Path, *options: str) -> tuple[dict[str, Any], str]:
    """Summary and output of `reconstruct` with options."""
    done = cli.ok("reconstruct", recording, "-o", out, "--frames", "16", *options)
    return json.loads((out / "summary.json").read_text()), done.out


def test_terminal_summary_and_page_agree_and_state_each_thing_once(
    stuck: Path, tmp_path: Path, cli: Any, caplog: pytest.LogCaptureFixture
) -> None:
    summary, text = summary_after(cli, stuck, tmp_path / "out")
    settings, verdict = summary["settings"], summary["verdict"]
    assert settings.pop("fragment")["jerk"] == 2.5
    assert settings == {
        "space": "joint",
        "energy": "default",
        "frames": 16,
        "guards": ",".join(GUARDS),
        "lift_with_sensors": True,
        "lifter": "detections",
        "calibrate": "no",
        "known_of_another_recording": False,
        "threads": threads(),
    }
    words = ("recording ", "accuracy ", "caution ", verdict["headline"], "files ", "next ", "section verdict")
    places = [text.index(word) for word in words]
    assert places == sorted(places)
    assert places[0] == 0
    assert summary["solver"]["outcome"] in text
    assert text.count("repeated one sample") == 1
    assert "repeated" not in caplog.text
    assert cli("report", tmp_path / "out").code == 0
    page = unescape((tmp_path / "out" / "report.html").read_text())
    cause = plain_words(verdict["headline"].partition("; more")[0], angle_table(SkeletonModel.default().table))
    assert f"{cause[:1].upper()}{cause[1:]}." in page
    assert "joint space, energy: default; 16 frames" in page


def test_paper_is_solved_in_cartesian_space(stuck: Path, tmp_path: Path, cli: Any) -> None:
    options = "--paper --guards none --no-lift-with-sensors --model live"
    summary, _ = summary_after(cli, stuck, tmp_path / "out", *options.split())
    found = summary["settings"]
    assert (found["space"], found["energy"]) == ("cartesian", "as printed")
    assert (found["fragment"]["k_V"], found["fragment"]["as_printed"]) == (0.9, True)
    assert (found["guards"], found["lift_with_sensors"]) == ("", False)
    assert found["lifter"] == "live"
    assert "stream_faults" not in summary


@pytest.mark.parametrize(
    "options, expected",
    [
        ("", JointSpaceSettings()),
        ("--space joint", JointSpaceSettings()),
        ("--space cartesian", CartesianSettings()),
        ("--paper", CartesianSettings.paper()),
    ],
)
def test_options_choose_the_space(options: str, expected: object, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[Any] = []
    monkeypatch.setattr("rtof_kin.cli.reconstruction.reconstruct_and_print", lambda *given: found.append(given) or Any)
    monkeypatch.setattr(Any, "stage_metrics", {}, raising=False)
    assert main(["reconstruct", "a", "-o", "b", *options.split()]) == 0
    assert found[0][3].solver(SkeletonModel.default()) == expected


@pytest.mark.parametrize(
    "settings, name",
    [
        (JointSpaceSettings(max_iterations=9, floor_height=0.1), "default"),
        (JointSpaceSettings(jerk=7.0), "own"),
        (CartesianSettings(), "default"),
        (CartesianSettings.paper(), "as printed"),
    ],
)
def test_energy_is_named(settings: JointSpaceSettings | CartesianSettings, name: str) -> None:
    assert _energy_name(settings) == name


def test_threads_are_limited_before_libraries_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "")
    monkeypatch.delitem(sys.modules, "numpy")
    limit_threads()
    assert threads() == 1
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    limit_threads()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"


def test_threads_of_loaded_libraries_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    limit_threads()
    assert threads() is None


@dataclass(frozen=True)
class Settings:
    """Of a test."""

    length_m: float = 1.5
    """Length of the way, m."""
    names: tuple[str, ...] = ("a", "b")
    """Names that are used."""
    kind: Literal["sit_to_stand", "squat"] | None = None
    """Movement."""
    fast: bool = True
    """Whether it is fast."""
    inner: int = 3


def test_fields_are_described_once() -> None:
    assert descriptions(Settings) == {
        "length_m": "length of the way, m",
        "names": "names that are used",
        "kind": "movement",
        "fast": "whether it is fast",
    }


@pytest.mark.parametrize(
    "words, expected",
    [
        ([], Settings()),
        (["--length", "1,25", "--names", "c, d,c"], Settings(1.25, ("c", "d"))),
        (["--kind", "sit-to-stand", "--no-fast", "--names", "none"], Settings(1.5, (), "sit_to_stand", False)),
    ],
)
def test_fields_become_options_with_their_types_and_defaults(words: list[str], expected: Settings) -> None:
    @command
    def walk(*, how: Annotated[Settings, Fields("names kind fast", length_m="length")]) -> Settings:
        """Walk."""
        return how

    whole = App(name="test", result_action="return_value")
    whole.command(walk)
    assert whole(["walk", *words]) == expected


def test_commands_of_an_earlier_version_are_named(cli: Any) -> None:
    assert not {*OLD_COMMANDS} & command_names()
    assert len(command_names()) <= 19
    for name, now in OLD_COMMANDS.items():
        done = cli(name, "a")
        assert (done.code, done.err) == (2, f"error: {name}: is now rtof-kin {now}")
        assert now.split()[0].removesuffix(",") in command_names()
    assert "report --subject: is now --code;" in cli("report", "a", "--subject=P07").err


def test_help_is_that_of_the_docstring(cli: Any) -> None:
    for purpose, commands in COMMANDS.items():
        assert purpose in cli("--help").out
        for name in commands:
            done = cli.ok(name, "--help")
            assert f"Usage: rtof-kin {name}" in done.out
            assert len(done.out) > 300, name


def test_help_of_commands_is_printed_without_the_solver() -> None:
    code = "import sys; from rtof_kin.cli import main\n"
    code += "for name in ('run', 'reconstruct', 'report', 'live'): assert main([name, '--help']) == 0\n"
    code += "assert not {'casadi', 'pinocchio', 'scipy'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
