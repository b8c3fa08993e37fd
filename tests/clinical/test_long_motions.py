"""Analyses, pages and files of a motion that is read in blocks are those of the whole, in little memory."""

from __future__ import annotations

import filecmp
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clinical_support import walk, write_analysis
from long_motion import with_confidence

from benchmarks.long_outputs import repeated, write_repeated
from rtof_kin.body import motion_source
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.core.array_types import Array
from rtof_kin.formats.motion_files import FORMATS, write_motion_files

RANGES = ("low", "high", "mean", "peak_velocity", "range_sigma", "known_share", "trusted_share")
EXPORTING_MB, ANALYSING_MB = 30, 40
"""Growth of the memory with four minutes; read in one piece they take 75 and 87."""


@pytest.fixture(scope="module")
def motion() -> Motion:
    """Walking forth and back for 15 s with a gap of half a second in it."""
    motion = repeated(with_confidence(walk()), 0, 900)
    valid = np.array(motion.poses.valid)
    valid[400:430] = False
    return replace(motion, poses=replace(motion.poses, valid=valid))


@pytest.fixture
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_source, "BLOCK", 130)


def analysed(motion: Motion) -> MotionAnalysis:
    return analyse(motion, weight_kg=70.0, repetitions="squat")


@pytest.fixture(scope="module")
def whole(motion: Motion) -> MotionAnalysis:
    assert len(motion.q) < motion_source.BLOCK
    return analysed(motion)


@pytest.mark.usefixtures("short_blocks")
def test_analysis_by_blocks_is_that_of_the_whole(motion: Motion, whole: MotionAnalysis) -> None:
    found = analysed(motion)
    for name in ("values", "sigma", "provenance", "trusted", "singular"):
        np.testing.assert_array_equal(getattr(found.angles, name), getattr(whole.angles, name))
    for one, other in zip(found.ranges, whole.ranges, strict=True):
        np.testing.assert_array_equal(
            [getattr(one, name) for name in RANGES], [getattr(other, name) for name in RANGES]
        )
    assert found.gait.strides == whole.gait.strides != ()
    assert found.travel == whole.travel
    assert found.notes == whole.notes
    assert found.torques is not None
    assert whole.torques is not None
    for name in ("torques", "root_wrench", "unexplained"):  # blocks are filtered with two seconds beside them
        np.testing.assert_allclose(getattr(found.torques, name), getattr(whole.torques, name), rtol=0, atol=1e-8)


def test_files_by_blocks_are_those_of_the_whole(
    motion: Motion, whole: MotionAnalysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunked = "parquet", "c3d", "glb", "rrd", "mcap", "rosbag"  # by block, or not the same bytes twice
    formats = [name for name in FORMATS if name not in chunked]
    for name, block in (("whole", motion_source.BLOCK), ("blocks", 130)):
        monkeypatch.setattr(motion_source, "BLOCK", block)
        folder = tmp_path / name
        folder.mkdir()
        write_motion_files(folder, motion, formats)
        write_analysis(whole, folder)
    names = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert {"motion_2.sto", "ros_base_trajectory.json", "angles.csv"} <= {*names}
    _, differ, missing = filecmp.cmpfiles(tmp_path / "whole", tmp_path / "blocks", names, shallow=False)
    assert not missing
    assert {Path(name).suffix for name in differ} <= {".sto", ".bvh"}  # the last decimal is rounded another way
    for name in differ:
        before, after = (numbers(tmp_path / part / name) for part in ("whole", "blocks"))
        assert len(before) > 100
        np.testing.assert_allclose(after, before, rtol=0, atol=2e-9)


def numbers(path: Path) -> Array:
    """The rows of a text file that have as many numbers as the last one."""
    cells = [line.split() for line in path.read_text().splitlines()]
    return np.array([row for row in cells if len(row) == len(cells[-1]) and row[0] != "time"], dtype=float)


MEASURED = """
import resource, sys
from rtof_kin.clinical.analysis import analyse
from rtof_kin.formats.motion_files import write_motion_files
from rtof_kin.body.motion_file import MotionReader

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

before = peak()
with MotionReader(sys.argv[1]) as reader:
    write_motion_files(sys.argv[2], reader, ["mot"])
    written = peak()
    analyse(reader)
    print(written - before, peak() - before)
"""


@pytest.fixture(scope="module")
def four_minutes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file that repeats a minute of walking."""
    path = tmp_path_factory.mktemp("long") / "motion.h5"
    write_repeated(path, walk(), 4)
    return path


def test_memory_of_four_minutes(four_minutes: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, str(four_minutes), str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    exporting, analysing = map(float, done.stdout.split())
    assert exporting < EXPORTING_MB
    assert analysing < ANALYSING_MB
