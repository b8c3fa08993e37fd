"""A recording reconstructed in parts is written part by part, as one motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.resources import model_path
from rtof_kin.formats.measurements_file import read_measurements
from rtof_kin.reconstruction.parts import reconstruct_in_parts
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting import export as exporting
from rtof_kin.reporting.export import export_parts


@pytest.fixture(scope="module")
def parts() -> list[Reconstruction]:
    demo = Recording.load(model_path("demo")).between(0.0, 3.0)
    return list(reconstruct_in_parts(demo, "rtof", seconds=1.0))


def test_the_files_have_the_motion_of_all_parts(parts: list[Reconstruction], tmp_path: Path) -> None:
    found = export_parts(parts, tmp_path / "out")
    motion = Motion.load(tmp_path / "out" / "motion.h5")
    p = np.concatenate([part.motion.poses.p_world_joint for part in parts])
    np.testing.assert_allclose(motion.poses.p_world_joint, p, atol=1e-5)
    measured = read_measurements(tmp_path / "out" / "measurements.h5")
    np.testing.assert_allclose(measured.times, motion.times)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == found.frames == len(motion.times)
    assert summary["parts"] == len(parts) > 1
    assert summary["solver"]["fragments"] == sum(len(part.solution.fragments) for part in parts)
    assert (tmp_path / "out" / "motion.csv").is_file()
    assert not (tmp_path / "out" / "figures").exists()


def test_long_motions_are_not_written_as_text_unless_asked_for(
    parts: list[Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "MOST_SECONDS", 2.0)
    export_parts(parts, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").glob("[a-z]*")) == [
        "files.json",
        "measurements.h5",
        "motion.h5",
        "skeleton.urdf",
        "summary.json",
    ]
    export_parts(parts, tmp_path / "asked", formats=("csv",))
    assert (tmp_path / "asked" / "motion.csv").is_file()


def test_an_error_in_a_later_part_leaves_no_folder(parts: list[Reconstruction], tmp_path: Path) -> None:
    def broken() -> object:
        yield parts[0]
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        export_parts(broken(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
