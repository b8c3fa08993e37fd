"""Every written file is complete or absent on a full disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import planted
import pytest
import torch
from full_disk import ROOM, full_disk
from matplotlib.figure import Figure

from lifting.training.run import save_tensors
from lifting.training.train import write_curves
from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.cli import files
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.text import write_text
from rtof_kin.formats.joint_trajectory import write_ros_trajectory
from rtof_kin.formats.markers import write_c3d
from rtof_kin.formats.motion_files import write_csv, write_motion_parquet
from rtof_kin.formats.motion_views import landmark_markers
from rtof_kin.reporting import document
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.video import write_detections

NOISE = np.random.default_rng(0).uniform(size=(4, 2, 17, 2))
DETECTIONS = Detections(NOISE, NOISE[..., 0])


@pytest.fixture(scope="module")
def motion() -> Motion:
    return planted.moving(SkeletonModel.default(), 12)


WRITERS: dict[str, Callable[[Path, Motion], object]] = {
    "page.html": lambda path, motion: write_text(path, "x" * 2 * ROOM, overwrite=True),
    "motion.c3d": lambda path, motion: write_c3d(path, landmark_markers(motion), overwrite=True),
    "motion.h5": write_motion,
    "motion.parquet": lambda path, motion: write_motion_parquet(path, motion, overwrite=True),
    "motion.csv": lambda path, motion: write_csv(path.parent, motion),
    "ros_joint_trajectory.json": lambda path, motion: write_ros_trajectory(path.parent, motion),
    "keypoints.npz": lambda path, motion: write_detections(path, DETECTIONS, overwrite=True),
    "skeletons.png": lambda path, motion: document.write_figures(
        [document.Figure("skeletons", "", Figure)], path.parent
    ),
    "x.curves.json": lambda path, motion: write_curves(path.parent / "x", {"seed": "x" * ROOM}, []),
    "lifter.npz.state": lambda path, motion: save_tensors({"weights": torch.rand(ROOM)}, path),
}


def test_figure_of_inspect_is_complete_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtof_kin.reporting.inspection.picture", lambda found: Figure())
    with full_disk(), pytest.raises(RtofError, match=r"wrong\.png: cannot be written"):
        files._draw(None, tmp_path / "wrong.png", False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_truncated_c3d_file_is_an_error(share: float, motion: Motion, tmp_path: Path) -> None:
    path, markers = tmp_path / "motion.c3d", landmark_markers(motion)
    write_c3d(path, markers)
    room = int(share * path.stat().st_size)
    with full_disk(room), pytest.raises(RtofError, match=r"motion\.c3d: cannot be written"):
        write_c3d(path, markers, overwrite=True)
    assert path.stat().st_size > room


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_is_one_error_and_leaves_the_old_file(name: str, motion: Motion, tmp_path: Path) -> None:
    (tmp_path / name).write_text("old")
    with full_disk(), pytest.raises(RtofError, match=name):
        WRITERS[name](tmp_path / name, motion)
    assert (tmp_path / name).read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == [name]
    WRITERS[name](tmp_path / name, motion)
    assert (tmp_path / name).read_bytes() != b"old"
