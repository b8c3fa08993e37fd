"""A recording reconstructed in parts is written part by part, as one motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.resources import model_path
from rtof_kin.formats.measurements_file import read_measurements
from rtof_kin.reconstruction.part_results import joined
from rtof_kin.reconstruction.parts import reconstruct_in_parts
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting import export as exporting
from rtof_kin.reporting.export import export
from rtof_kin.reporting.statistics import ReconstructionStatistics


@pytest.fixture(scope="module")
def parts() -> list[Reconstruction]:
    demo = Recording.load(model_path("demo")).between(0.0, 3.0)
    return list(reconstruct_in_parts(demo, mode="rtof", seconds=1.0))


def test_the_files_have_the_motion_of_all_parts(parts: list[Reconstruction], tmp_path: Path) -> None:
    found = export(parts, tmp_path / "out")
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
    export(parts, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").glob("[a-z]*")) == [
        "files.json",
        "measurements.h5",
        "motion.h5",
        "skeleton.urdf",
        "summary.json",
    ]
    export(parts, tmp_path / "asked", formats=("csv",))
    assert (tmp_path / "asked" / "motion.csv").is_file()


def test_parts_joined_to_one_result_are_written_as_the_parts(parts: list[Reconstruction], tmp_path: Path) -> None:
    whole = joined(parts)
    p = np.concatenate([part.motion.poses.p_world_joint for part in parts])
    np.testing.assert_array_equal(whole.motion.poses.p_world_joint, p)
    frames = len(p)
    assert len(whole.keypoints.times) == len(whole.bone_imus.times) == len(whole.stages["rtof"]) == frames
    assert len(whole.recording.video.times) == frames
    assert len(whole.solution.fragments) == sum(len(part.solution.fragments) for part in parts)
    assert whole.metrics["mpjpe_mm"] == pytest.approx(ReconstructionStatistics.of(whole).metrics["mpjpe_mm"], rel=1e-3)
    export(whole, tmp_path / "whole")
    export(parts, tmp_path / "parts")
    for name in ("motion.h5", "measurements.h5", "summary.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()


def test_an_error_in_a_later_part_leaves_no_folder(parts: list[Reconstruction], tmp_path: Path) -> None:
    def broken() -> object:
        yield parts[0]
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        export(broken(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
