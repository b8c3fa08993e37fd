"""OpenCap's camera pickles: what their writer put in comes out, and nothing in them runs."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin import Recording
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnitError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.cameras import read_camera, read_opencap

CAMERA = planted.camera()
BOARDS = {  # axis of the board that points up -> R_board_world of a board placed so
    "-y": Rotation.from_euler("x", 90, degrees=True),
    "y": Rotation.from_euler("x", -90, degrees=True),
    "z": Rotation.from_euler("z", 70, degrees=True),
    "-z": Rotation.from_euler("x", 180, degrees=True),
    "x": Rotation.from_euler("y", 90, degrees=True),
}


def content(R_board_world: Rotation, camera: Camera = CAMERA) -> dict[str, Any]:
    """What OpenCap writes for a camera whose checkerboard has this orientation in the world."""
    R = camera.R_camera_world @ R_board_world.as_matrix().T
    return {
        "distortion": camera.distortion[None],
        "intrinsicMat": camera.K,
        "imageSize": np.array([[camera.height_px], [camera.width_px]], dtype=float),
        "rotation": R,
        "translation": 1000 * camera.t_camera_world[:, None],
        "rotation_EulerAngles": Rotation.from_matrix(R).as_rotvec()[:, None],
    }


def write(folder: Path, entries: Any, protocol: int = 4) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / "cameraIntrinsicsExtrinsics.pickle"
    path.write_bytes(pickle.dumps(entries, protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 4, 5])
@pytest.mark.parametrize("up", BOARDS)
def test_camera_sees_what_it_saw_however_the_board_was_put_up(tmp_path: Path, up: str, protocol: int) -> None:
    path = write(tmp_path / "Cam1", content(BOARDS[up]), protocol)
    ((name, camera),) = read_opencap(path).items()
    assert name == "Cam1"
    assert (camera.width_px, camera.height_px) == (CAMERA.width_px, CAMERA.height_px)
    assert np.allclose(camera.K, CAMERA.K)
    # Both worlds have z up and the same origin; they differ by a turn about z.
    turn = camera.R_camera_world.T @ CAMERA.R_camera_world
    assert np.allclose(turn[2], [0, 0, 1], atol=1e-9)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    assert np.allclose(camera.project(points @ turn.T), CAMERA.project(points), atol=1e-6)
    assert np.allclose(read_camera(path).R_camera_world, camera.R_camera_world)
    told = read_camera(path, up=up)
    assert np.allclose(told.R_camera_world, camera.R_camera_world)


def test_a_pose2sim_export_has_its_world_again(tmp_path: Path) -> None:
    # Pose2Sim turns the world by -90 degrees about x, then by 180 about z, before it writes R; t stays.
    turned = Rotation.from_euler("z", 180, degrees=True) * Rotation.from_euler("x", -90, degrees=True)
    path = write(tmp_path / "Cam0", content(turned))
    camera = read_opencap(path)["Cam0"]
    assert np.allclose((camera.R_camera_world.T @ CAMERA.R_camera_world)[2], [0, 0, 1])
    assert camera.center_world[2] == pytest.approx(CAMERA.center_world[2])


def test_a_recording_names_it_as_its_camera(tmp_path: Path) -> None:
    write(tmp_path / "Cam0", content(BOARDS["-y"]))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 2, 3))
    uv = CAMERA.project(points + np.array([0, 0, 1]))
    np.savez(tmp_path / "keypoints.npz", uv_px=uv)
    (tmp_path / "recording.toml").write_text(
        'schema_version = 1\n[camera]\nfile = "Cam0/cameraIntrinsicsExtrinsics.pickle"\n'
        '[keypoints]\nfile = "keypoints.npz"\nrate_hz = 30\nlandmarks = ["Hips", "Head"]\n'
    )
    camera = Recording.load(tmp_path).video.camera
    np.testing.assert_allclose(camera.center_world[2], CAMERA.center_world[2])


def test_a_board_between_two_axes_needs_to_be_told(tmp_path: Path) -> None:
    path = write(tmp_path / "Cam0", content(Rotation.from_euler("xy", [45, 30], degrees=True)))
    with pytest.raises(FileFormatError, match="no axis of the checkerboard is upright.*up = '-y'"):
        read_opencap(path)
    assert read_opencap(path, up="z")["Cam0"].width_px == CAMERA.width_px


def test_what_is_no_camera_is_named(tmp_path: Path) -> None:
    good = content(BOARDS["-y"])
    for entries, problem in (
        ([1.0, 2.0], "no camera of OpenCap: it has no intrinsicMat"),
        ({k: v for k, v in good.items() if k != "imageSize"}, "it has no imageSize"),
        ({**good, "rotation": np.full((3, 3), np.nan)}, "rotation: expected 9 finite numbers"),
        ({**good, "translation": "text"}, "translation: expected 3 finite numbers"),
        ({**good, "rotation": np.ones((3, 3)) / np.sqrt(3)}, "not a rotation"),
    ):
        with pytest.raises(FileFormatError, match=problem):
            read_opencap(write(tmp_path / "Cam0", entries), up="z")
    path = write(tmp_path / "Cam0", good)
    with pytest.raises(UnitError, match="m away from the origin"):
        read_opencap(path, metres_per_unit=1.0)
    with pytest.raises(InvalidInputError, match="no axis"):
        read_opencap(path, up="w")
    with pytest.raises(FileFormatError, match="no such file"):
        read_opencap(tmp_path / "no.pickle")


def test_a_command_is_refused_and_not_run(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, (f"touch '{tmp_path / 'mark'}'",)

    path = write(tmp_path / "Cam0", {**content(BOARDS["-y"]), "rotation": Harm()})
    with pytest.raises(FileFormatError, match="wants to run .*Do not trust this file"):
        read_opencap(path)
    assert not (tmp_path / "mark").exists()


def test_a_pickle_that_goes_on_after_its_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pickle"
    path.write_bytes(pickle.dumps(content(BOARDS["y"]), 4) + b"x")
    with pytest.raises(FileFormatError, match="data after the end"):
        read_opencap(path)
