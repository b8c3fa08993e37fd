"""A trial's file becomes a folder with a motion that the rest of the package reads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from marker_support import Planted, planted

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import FileFormatError, OutputExistsError
from rtof_kin.formats.markers import MarkerSequence, write_c3d, write_trc
from rtof_kin.markers.settings import MarkerSettings
from rtof_kin.markers.trials import motion_of_markers, read_trial
from rtof_kin.reporting.export import export_markers
from rtof_kin.reporting.summary_file import read_summary


@pytest.fixture(scope="module")
def truth() -> Planted:
    return planted(4, frames=60)


def write(path: Path, markers: MarkerSequence) -> Path:
    if path.suffix == ".npz":
        np.savez(path, times=markers.times, names=np.array(markers.names), p_world=markers.p_world)
    else:
        (write_c3d if path.suffix == ".c3d" else write_trc)(path, markers)
    return path


@pytest.mark.parametrize("name", ["trial.c3d", "trial.trc", "trial.npz"])
def test_kinds_of_files_give_the_same_markers(truth: Planted, tmp_path: Path, name: str) -> None:
    if name.endswith("c3d"):
        pytest.importorskip("ezc3d")
    read = read_trial(write(tmp_path / name, truth.markers))
    assert read.names == truth.markers.names
    np.testing.assert_allclose(read.p_world, truth.markers.p_world, atol=1e-6)
    np.testing.assert_allclose(read.times, truth.markers.times, atol=1e-6)


def test_a_trial_becomes_a_motion_folder(truth: Planted, tmp_path: Path) -> None:
    file, out = write(tmp_path / "trial.trc", truth.markers), tmp_path / "motion"
    result = motion_of_markers(file)
    assert result.headline.startswith("39 markers (plug_in_gait) on a body of 1.")
    export_markers(result, out)
    read = Motion.load(out)
    np.testing.assert_allclose(read.poses.p_world_joint, result.motion.poses.p_world_joint, atol=1e-6)
    assert read.skeleton.bone_lengths == pytest.approx(result.body.skeleton.bone_lengths)
    facts = json.loads((out / "markers.json").read_text())
    assert facts["markers"]["LKNE"]["segment"] == "LeftUpLeg"
    assert facts["markers"]["LKNE"]["rms_mm"] < 15
    assert (out / "skeleton.urdf").is_file()
    summary = read_summary(out / "summary.json")
    assert (summary.recording, summary.mode) == ("trial", "markers")
    assert summary.results is not None
    assert {result.grade.value for result in summary.results} == {"pass"}
    with pytest.raises(OutputExistsError):
        export_markers(result, out)


def test_a_trial_that_does_not_fit_says_so_first(truth: Planted, tmp_path: Path) -> None:
    """Frames at a tenth of their true distance in time: smoothness and markers contradict each other."""
    fast = replace(truth.markers[::12], times=truth.markers.times[:5] / 50)
    fast, slow = write(tmp_path / "fast.npz", fast), write(tmp_path / "slow.npz", truth.markers)
    result = motion_of_markers(fast, MarkerSettings(trials=(slow,)))
    assert result.headline.startswith("DOES NOT FIT (is the rate of the file right")


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"no marker trial; known: \.c3d, \.trc, \.npz"):
        read_trial(tmp_path / "trial.csv")
    np.savez(tmp_path / "trial.npz", times=np.arange(3.0))
    with pytest.raises(FileFormatError, match="needs times, names and p_world"):
        read_trial(tmp_path / "trial.npz")
