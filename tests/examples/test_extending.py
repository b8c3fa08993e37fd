"""The worked examples of CONTRIBUTING.md, and what it quotes of them."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtof_kin import FragmentSolver, Recording
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.resources import model_path
from rtof_kin.formats.sensors import files
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.terms import PointData
from rtof_kin.vision import layouts

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "extending"
QUOTED = {"sensor_reader": ["reader"], "detector_layout": ["layout"], "residual": ["residual", "term"]}


@pytest.fixture(autouse=True)
def _added(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test adds is gone after it."""
    for added in (files.ADDED, layouts.ADDED):
        monkeypatch.setattr(added, "_added", {})


def example(name: str) -> Any:
    return SimpleNamespace(**runpy.run_path(str(EXAMPLES / f"{name}.py")))


@pytest.mark.parametrize("name", QUOTED)
def test_the_guide_quotes_the_example(name: str) -> None:
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    for part in QUOTED[name]:
        found = re.search(rf"# \[{part}\]\n(.*?)# \[end\]", text, re.DOTALL)
        assert found is not None
        assert f"```python\n{found[1].strip()}\n```" in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_reader_gives_si_units(capsys: pytest.CaptureFixture[str]) -> None:
    example("sensor_reader").main()
    printed = capsys.readouterr().out
    assert "Acme CSV ('A17', 'A18') 100 Hz" in printed
    assert re.search(r"A18: 9\.8\d m/s\^2", printed)


def test_the_reader_refuses_a_file_that_is_not_in_order(tmp_path: Path) -> None:
    acme, path = example("sensor_reader"), tmp_path / "trial.csv"
    acme.write_sample(path, 0.1)
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:4], lines[2], *lines[5:]]), encoding="utf-8")
    with pytest.raises(FileFormatError, match="do not increase"):
        acme.read_acme(path)


def test_an_installed_package_adds_a_reader_to_the_commands(tmp_path: Path) -> None:
    package, trial = tmp_path / "site", tmp_path / "trial.csv"
    info = package / "acme_imu-1.0.dist-info"
    info.mkdir(parents=True)
    info.joinpath("METADATA").write_text("Metadata-Version: 2.1\nName: acme-imu\nVersion: 1.0\n", encoding="utf-8")
    points = "[rtof_kin.sensor_formats]\nacme = acme_imu:ACME\n"
    info.joinpath("entry_points.txt").write_text(points, encoding="utf-8")
    text = (EXAMPLES / "sensor_reader.py").read_text(encoding="utf-8")
    package.joinpath("acme_imu.py").write_text(text, encoding="utf-8")
    example("sensor_reader").write_sample(trial)
    code = f"import sys; sys.path.insert(0, {str(package)!r}); from rtof_kin.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "inspect", str(trial)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert "Acme CSV" in done.stdout, done.stdout + done.stderr


def test_a_layout_of_known_points_needs_nothing_trained(capsys: pytest.CaptureFixture[str]) -> None:
    example("detector_layout").main()
    printed = capsys.readouterr().out
    assert "CrowdPose, 14 points: confirmed by geometry" in printed
    off = re.search(r"21 joints regressed from 14 points, (\S+) px off", printed)
    assert off is not None
    assert float(off[1]) < 12
    assert "14 points are compared with the body" in printed


def test_a_recording_names_an_added_layout(tmp_path: Path) -> None:
    own, demo = example("detector_layout"), Recording.load(model_path("demo"))
    layouts.add_layout(own.CROWDPOSE)
    replace(demo, imus=None, truth=None, calibration=None).save(tmp_path / "r")
    own.write_detections(tmp_path / "r" / "detections.npz", demo, frames=12)
    toml = tmp_path / "r" / "recording.toml"
    text = re.sub(
        r"\[keypoints\]\n.*?\n(?=\[|\Z)",
        '[keypoints]\nfile = "detections.npz"\nlayout = "crowdpose14"\nrate_hz = 60.0\n\n',
        toml.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    toml.write_text(text, encoding="utf-8")
    keypoints = Recording.load(tmp_path / "r").keypoints
    assert keypoints is not None
    assert "crowdpose14:UpperNeck" in keypoints.names


def test_the_residuals_jacobian_equals_central_differences() -> None:
    own, rng = example("residual"), np.random.default_rng(0)
    for _ in range(5):
        p, anchor = rng.normal(size=3), 3 + rng.normal(size=3)
        assert own.jacobian_error(own.RANGE, p, np.append(anchor, 2.5)) < 1e-8


def test_distances_bring_the_root_back() -> None:
    own, recording = example("residual"), Recording.load(model_path("demo"))
    truth, keypoints = recording.truth, recording.keypoints
    assert truth is not None
    assert keypoints is not None
    truth, keypoints = truth[:24], keypoints[:24]
    root = truth.p_world_joint[:, 0]
    anchor = np.array([3.0, -2.0, 2.2])
    distances = np.linalg.norm(root - anchor, axis=1)
    values = np.column_stack([np.tile(anchor, (24, 1)), distances])
    away = truth.with_poses(
        slice(None), truth.p_world_joint + 0.3 * keypoints.camera.R_camera_world[2], truth.R_world_bone
    )
    solver = FragmentSolver(recording.skeleton, 24, JointSpaceSettings(), terms=[own.RANGE])
    off = [
        np.linalg.norm(solver.solve(away, keypoints, observed=observed).poses.p_world_joint[:, 0] - root, axis=1).mean()
        for observed in ({}, {"anchor": PointData(values, 0.05)})
    ]
    assert off[1] < 0.08 < 0.15 < off[0]


def test_an_inclinometer_straightens_the_chest() -> None:
    """A term of another kind than positions: the start leans by 20 degrees, the sensor does not."""
    own, recording = example("residual"), Recording.load(model_path("demo"))
    assert recording.truth is not None
    truth, chest = recording.truth[:24], recording.skeleton.names.index("Spine3")
    R = truth.R_world_bone @ so3.exp([0.35, 0.0, 0.0])
    start = truth.with_poses(slice(None), truth.p_world_joint, R)
    data = PointData(truth.R_world_bone[:, chest, 2], 0.01)
    solver = FragmentSolver(recording.skeleton, 24, JointSpaceSettings(), terms=[own.TILT])
    off = []
    for observed in ({}, {"tilt": data}):
        found = solver.solve(start, recording.keypoints[:24], observed=observed).poses.R_world_bone[:, chest, 2]
        off.append(np.degrees(np.arccos(np.clip(np.sum(found * data.values, axis=1), -1, 1))).mean())
    assert off[1] < 3 < off[0]
