"""The examples of a phone and of sensors alone, on small data."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from inertial_support import exercising
from setup_support import write_demo, write_sensors

from rtof_kin.core.resources import model_path
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import sensors

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *arguments: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name))


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtof_kin.setup.init.write_frames_picture", lambda path, *_: path.write_bytes(b""))


def test_a_phone_and_dots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    keypoints, log, segments = write_demo(tmp_path, 10, 12)
    (tmp_path / "map.csv").write_text("".join(f"{name};{joint}\n" for name, joint in segments.items()))
    write_camera_toml(tmp_path / "calib.toml", {"cam": Recording.load(model_path("demo")).video.camera})
    monkeypatch.setattr(sensors, "calibrate_recording", None)
    files = (keypoints, log, tmp_path / "map.csv", tmp_path / "calib.toml")
    run("phone_and_dots.py", 1.73, tmp_path / "out", *files, monkeypatch=monkeypatch)
    printed = capsys.readouterr().out
    for name, joint in segments.items():
        assert f"{name} is on {joint}" in printed
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_walk_of_sensors_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    worn = exercising().with_one_reference(0.4)
    serials = {f"00B4{s:04}": joint for s, joint in enumerate(worn.joints.values())}
    first = slice(0, 200)
    imus = replace(
        worn.imus,
        names=tuple(serials),
        times=worn.imus.times[first],
        R_inertial_sensor=worn.imus.R_inertial_sensor[first],
        f_sensor=worn.imus.f_sensor[first],
    )
    log = write_sensors(tmp_path / "sensors.csv", imus)
    (tmp_path / "map.csv").write_text("".join(f"{name}\t{joint}\n" for name, joint in serials.items()))
    run("opensense_walk.py", log, tmp_path / "map.csv", tmp_path / "out", monkeypatch=monkeypatch)
    assert "frames of 8 sensors; OpenSim opens" in capsys.readouterr().out
    assert (tmp_path / "out" / "motion.mot").is_file()
