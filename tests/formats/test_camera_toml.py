"""Camera calibrations in TOML: what they say, in which axes and units, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError, UnitError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import read_camera_toml, write_camera_toml
from rtof_kin.formats.world_axes import UP

POSE2SIM = """
[cam_01]
name = "left"
size = [1088.0, 1920.0]
matrix = [[1681.0, 0.0, 533.0], [0.0, 1680.0, 948.0], [0.0, 0.0, 1.0]]
distortions = [-0.05, 0.1, 0.001, -0.002]
rotation = [1.688, 1.048, -0.42]
translation = [0.32, 0.96, 2.9]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""


def written(path: Path, text: str) -> Path:
    path = path / "Calib.toml"
    path.write_text(text)
    return path


def test_a_camera_is_read_as_opencv_means_it(tmp_path: Path) -> None:
    cameras = read_camera_toml(written(tmp_path, POSE2SIM))
    assert list(cameras) == ["left"]
    camera = cameras["left"]
    assert (camera.width_px, camera.height_px) == (1088, 1920)
    np.testing.assert_allclose(camera.distortion, [-0.05, 0.1, 0.001, -0.002, 0])
    R = Rotation.from_rotvec([1.688, 1.048, -0.42]).as_matrix()
    p = np.array([0.2, -0.3, 1.1])
    x, y, z = R @ p + [0.32, 0.96, 2.9]
    np.testing.assert_allclose(camera.undistorted().project(p), [1681 * x / z + 533, 1680 * y / z + 948])


@pytest.mark.parametrize(
    "old, new",
    [
        ("rotation = [1.688, 1.048, -0.42]", "rotation = [[1.688], [1.048], [-0.42]]"),
        ("translation = [0.32, 0.96, 2.9]", "translation = [[0.32], [0.96], [2.9]]"),
        (
            "rotation = [1.688, 1.048, -0.42]",
            f"rotation = {Rotation.from_rotvec([1.688, 1.048, -0.42]).as_matrix().tolist()}",
        ),
        ("[-0.05, 0.1, 0.001, -0.002]", "[-0.05, 0.1, 0.001, -0.002, 0.0]"),
        ("fisheye = false", "rotation_count = 0\nexposure = -7\nignore = false"),
    ],
)
def test_other_ways_to_write_the_same_camera_are_read_alike(old: str, new: str, tmp_path: Path) -> None:
    plain = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    assert old in POSE2SIM
    other = read_camera_toml(written(tmp_path, POSE2SIM.replace(old, new)))["left"]
    for field in ("K", "R_camera_world", "t_camera_world", "distortion"):
        np.testing.assert_allclose(getattr(other, field), getattr(plain, field), atol=1e-12)


@pytest.mark.parametrize("up", UP)
def test_what_points_up_in_the_file_points_up_in_world(up: str, tmp_path: Path) -> None:
    path = written(tmp_path, POSE2SIM)
    plain, turned = read_camera_toml(path)["left"], read_camera_toml(path, up=up)["left"]
    above = np.zeros(3)
    above["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    np.testing.assert_allclose(turned.project([0, 0, 1]), plain.project(above), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(turned.center_world), np.linalg.norm(plain.center_world))


def test_millimetres_are_noticed_and_can_be_declared(tmp_path: Path) -> None:
    in_metres = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    path = written(tmp_path, POSE2SIM.replace("[0.32, 0.96, 2.9]", "[320.0, 960.0, 2900.0]"))
    with pytest.raises(UnitError, match="3071 m away.*metres_per_unit, 0.001 if the file has mm"):
        read_camera_toml(path)
    camera = read_camera_toml(path, metres_per_unit=0.001)["left"]
    np.testing.assert_allclose(camera.center_world, in_metres.center_world)


def test_what_is_written_is_read_back(tmp_path: Path, camera: Camera) -> None:
    other = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    path = tmp_path / "out.toml"
    write_camera_toml(path, {"a": camera, "b": other})
    again = read_camera_toml(path)
    assert list(again) == ["a", "b"]
    for name, given in {"a": camera, "b": other}.items():
        for field in ("K", "R_camera_world", "t_camera_world", "distortion"):
            np.testing.assert_allclose(getattr(again[name], field), getattr(given, field), atol=1e-12)
    with pytest.raises(OutputExistsError, match="out.toml: is there already"):
        write_camera_toml(path, again)
    write_camera_toml(path, {"a": again["a"]}, overwrite=True)
    assert list(read_camera_toml(path)) == ["a"]
    with pytest.raises(RtofError, match="cannot be written"):
        write_camera_toml(path / "out.toml", again)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("fisheye = false", "fisheye = true", r"\[cam_01\] fisheye: a fisheye lens.*undistort"),
        ("translation =", "t =", r"\[cam_01\] translation: missing"),
        ("rotation =", "r =", r"\[cam_01\] rotation: missing"),
        ("distortions =", "d =", r"\[cam_01\] distortions: expected k1, k2, p1, p2"),
        ("1.688, 1.048, -0.42", "1.688, 1.048", r"\[cam_01\] rotation: expected 3 numbers"),
        ("1.688, 1.048, -0.42", "1.688, nan, -0.42", r"rotation: .*not finite"),
        ("[[1681.0", "[[-1681.0", r"\[cam_01\]: camera K: singular"),
        ("size = [1088.0, 1920.0]", "size = [0, 0]", r"\[cam_01\]: .*must be positive"),
        ("[metadata]", '[other]\nname = "left"\nsize = [1, 1]', r"\[other\] name: 'left' is another"),
        ("[cam_01]", "cam_01", "not readable as TOML"),
    ],
)
def test_what_is_no_complete_camera_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in POSE2SIM
    with pytest.raises(FileFormatError, match=message):
        read_camera_toml(written(tmp_path, POSE2SIM.replace(old, new)))


def test_a_file_without_cameras_and_arguments_without_sense_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "version = 3\n[project]\nframe_rate = 60\n")
    with pytest.raises(FileFormatError, match="no camera in it.*both size and matrix"):
        read_camera_toml(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_camera_toml(tmp_path / "none.toml")
    with pytest.raises(InvalidInputError, match="up: 'w' is no axis; give one of x, y, z"):
        read_camera_toml(path, up="w")
    with pytest.raises(InvalidInputError, match="metres_per_unit: 0 is not"):
        read_camera_toml(path, metres_per_unit=0)
