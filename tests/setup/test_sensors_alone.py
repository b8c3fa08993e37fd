"""A recording of sensors alone, and `run` on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inertial_support import Worn, walking
from setup_support import write_sensors

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import UndecidedError
from rtof_kin.inertial.pose_calibration import pose_rotations
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.init import make_recording


@pytest.fixture(scope="module")
def worn() -> Worn:
    return walking(pose_rotations("N", SkeletonModel.default())).with_one_reference(1.0)


@pytest.fixture(scope="module")
def files(worn: Worn, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Sensors by serial numbers, and the map of their segments."""
    folder = tmp_path_factory.mktemp("sensors")
    rows = [f"{sensor}, {joint}" for sensor, joint in worn.joints.items()]
    (folder / "map.csv").write_text("\n".join(rows))
    return write_sensors(folder / "sensors.csv", worn.imus), folder / "map.csv"


def test_a_still_pose_gives_the_planted_mounting(worn: Worn, files: tuple[Path, Path], tmp_path: Path) -> None:
    found = make_recording(files, tmp_path / "rec", height=1.72)
    assert "the person stood in the N-pose from" in found.assumed[0]
    recording = Recording.load(tmp_path / "rec")
    assert recording.usual_mode == "imu"
    assert recording.height == 1.72
    assert worn.errors_deg(recording.calibration).max() < 2.0
    stated = recording.calibration.mounting_sd_deg
    assert stated is not None
    assert ((stated > 5) & (stated < 10)).all()  # 10 degrees in all for a pose held by eye


def test_unnamed_sensors_without_a_video_need_a_map(files: tuple[Path, Path], tmp_path: Path) -> None:
    lines = files[0].read_text().splitlines()
    for sensor, serial in (("L_", "A1"), ("R_", "B2")):
        lines[0] = lines[0].replace(sensor, serial)
    unnamed = tmp_path / "unnamed.csv"
    unnamed.write_text("\n".join(lines).replace("Up", "x").replace("Low", "y").replace("Leg", "z"))
    with pytest.raises(UndecidedError, match="it must be known which sensor is where; name their segments") as error:
        make_recording([unnamed], tmp_path / "rec")
    assert error.value.places
    assert set(error.value.places.values()) <= {("", 0.0), ("Hips", 1.0), ("Head", 1.0)}
    assert not (tmp_path / "rec").exists()


def test_run_takes_sensors_alone_from_files_to_a_report(
    worn: Worn, files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rtof_kin.cli import main

    files = write_sensors(tmp_path / "sensors.csv", worn.imus[:210]), files[1]
    out, names = tmp_path / "out", np.array(SkeletonModel.default().names)
    np.savez(tmp_path / "nobody.npz", times=np.arange(300) / 60, names=names, p_world=np.zeros((300, len(names), 3)))
    line = ["run", *map(str, files), "--height", "1,72", "--no-figures", "-o", str(out)]
    assert main([*line, "--lift", str(tmp_path / "nobody.npz")]) == 0
    assert (out / "report.html").is_file()
    summary: Any = json.loads((out / "motion" / "summary.json").read_text())
    assert summary["mode"] == "imu"
    assert "nobody.npz is not used as a lift: it shows nobody: no frame has 8" in summary["warnings"][0]
    assert "overlay" not in capsys.readouterr().out
