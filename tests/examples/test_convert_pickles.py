"""Pickles of public data sets, converted to files that the package reads."""

from __future__ import annotations

import pickle
import runpy
from pathlib import Path
from typing import Any

import human36m_files
import numpy as np
import planted
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import FileFormatError
from rtof_kin.datasets.human36m import Human36M
from rtof_kin.formats.cameras import read_camera

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "convert_pickles.py"))
CAMERA = planted.camera()
BOARDS = {  # axis of the board that points up -> R_board_world of a board placed so
    "-y": Rotation.from_euler("x", 90, degrees=True),
    "y": Rotation.from_euler("x", -90, degrees=True),
    "z": Rotation.from_euler("z", 70, degrees=True),
    "-z": Rotation.from_euler("x", 180, degrees=True),
    "x": Rotation.from_euler("y", 90, degrees=True),
}


def opencap(folder: Path, R_board_world: Rotation) -> Path:
    """What OpenCap writes for a camera whose checkerboard has this orientation in the world."""
    contents = {
        "distortion": CAMERA.distortion[None],
        "intrinsicMat": CAMERA.K,
        "imageSize": np.array([[CAMERA.height_px], [CAMERA.width_px]], dtype=float),
        "rotation": CAMERA.R_camera_world @ R_board_world.as_matrix().T,
        "translation": 1000 * CAMERA.t_camera_world[:, None],
    }
    folder.mkdir()
    path = folder / "cameraIntrinsicsExtrinsics.pickle"
    path.write_bytes(pickle.dumps(contents))
    return path


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("up", BOARDS)
def test_a_camera_sees_what_it_saw_however_the_board_was_put_up(tmp_path: Path, up: str, told: bool) -> None:
    camera = read_camera(SCRIPT["camera"](opencap(tmp_path / "Cam1", BOARDS[up]), up if told else None), "Cam1")
    assert (camera.width_px, camera.height_px) == (CAMERA.width_px, CAMERA.height_px)
    # Both worlds have z up and the same origin; they differ by a turn about z.
    turn = camera.R_camera_world.T @ CAMERA.R_camera_world
    np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-9)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(camera.project(points @ turn.T), CAMERA.project(points), atol=1e-6)


def test_a_board_between_two_axes_needs_to_be_told(tmp_path: Path) -> None:
    path = opencap(tmp_path / "Cam0", Rotation.from_euler("xy", [45, 30], degrees=True))
    with pytest.raises(SystemExit, match=r"no axis of the checkerboard is upright.*--up -y"):
        SCRIPT["camera"](path, None)
    assert read_camera(SCRIPT["camera"](path, "z")).width_px == CAMERA.width_px


def test_archives_of_videopose3d_are_plain_arrays_afterwards(tmp_path: Path) -> None:
    positions = human36m_files.motions(("S9", "S11"), frames=8)
    wide = {s: {a: human36m_files.of_32(p) for a, p in actions.items()} for s, actions in positions.items()}
    seen: dict[str, Any] = human36m_files.keypoints(positions)
    archives: dict[str, dict[str, Any]] = {
        "data_3d_h36m.npz": {"positions_3d": wide},
        "data_2d_h36m_gt.npz": {"positions_2d": seen, "metadata": human36m_files.METADATA},
    }
    for name, contents in archives.items():
        np.savez_compressed(tmp_path / name, **contents)
    human36m_files.write_camera_json(tmp_path, ("S9", "S11"))
    with pytest.raises(FileFormatError, match=r"data_3d_h36m\.npz: no array positions_3d.*convert_pickles\.py"):
        Human36M(tmp_path).motion("S9", "Action 0")
    for name in archives:
        SCRIPT["archive"](tmp_path / name, tmp_path / "plain")
    data = Human36M(tmp_path / "plain", tmp_path / "camera-parameters.json")
    for subject, action in data.sequences:
        np.testing.assert_array_equal(data.positions(subject, action), positions[subject][action])
        np.testing.assert_array_equal(data.keypoints(subject, action, 2), seen[subject][action][2])
    assert data.recording("S11", "Action 1", 3).notes == ""
