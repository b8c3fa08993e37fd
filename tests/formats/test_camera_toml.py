"""Camera calibrations in TOML: values, axes, units, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import OutputExistsError, RtofError, UnitError
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
ROTATION = "rotation = [1.688, 1.048, -0.42]"
R = Rotation.from_rotvec([1.688, 1.048, -0.42]).as_matrix()


def written(path: Path, text: str) -> Path:
    path = path / "Calib.toml"
    path.write_text(text)
    return path


def assert_same(a: Camera, b: Camera) -> None:
    for field in ("K", "R_camera_world", "t_camera_world", "distortion"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), atol=1e-12)


def test_camera_has_opencvs_convention(tmp_path: Path) -> None:
    cameras = read_camera_toml(written(tmp_path, POSE2SIM))
    assert list(cameras) == ["left"]
    camera = cameras["left"]
    assert (camera.width_px, camera.height_px) == (1088, 1920)
    np.testing.assert_allclose(camera.distortion, [-0.05, 0.1, 0.001, -0.002, 0])
    p = np.array([0.2, -0.3, 1.1])
    x, y, z = R @ p + [0.32, 0.96, 2.9]
    np.testing.assert_allclose(camera.undistorted().project(p), [1681 * x / z + 533, 1680 * y / z + 948])


def test_caliscope_has_its_cameras_in_a_table(tmp_path: Path) -> None:
    named = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    table = POSE2SIM[: POSE2SIM.index("[metadata]")].replace("[cam_01]", "[cameras.3]")
    text = "\n".join(line for line in table.splitlines() if not line.startswith("name"))
    cameras = read_camera_toml(written(tmp_path, text + "\ncam_id = 3\nrotation_count = 0\nerror = 0.4\n"))
    assert list(cameras) == ["3"]
    assert_same(cameras["3"], named)


@pytest.mark.parametrize(
    "old, new",
    [
        (ROTATION, "rotation = [[1.688], [1.048], [-0.42]]"),
        (ROTATION, f"rotation = {R.tolist()}"),
        ("translation = [0.32, 0.96, 2.9]", "translation = [[0.32], [0.96], [2.9]]"),
        ("[-0.05, 0.1, 0.001, -0.002]", "[-0.05, 0.1, 0.001, -0.002, 0.0]"),
        ("fisheye = false", "rotation_count = 0\nexposure = -7\nignore = false"),
    ],
)
def test_other_spellings_of_one_camera(old: str, new: str, tmp_path: Path) -> None:
    plain = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    assert old in POSE2SIM
    assert_same(read_camera_toml(written(tmp_path, POSE2SIM.replace(old, new)))["left"], plain)


@pytest.mark.parametrize("up", UP)
def test_up_axis_of_the_file_points_up_in_world(up: str, tmp_path: Path) -> None:
    path = written(tmp_path, POSE2SIM)
    plain, turned = read_camera_toml(path)["left"], read_camera_toml(path, up=up)["left"]
    above = np.zeros(3)
    above["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    np.testing.assert_allclose(turned.project([0, 0, 1]), plain.project(above), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(turned.center_world), np.linalg.norm(plain.center_world))


def test_millimetres_are_noticed_and_can_be_declared(tmp_path: Path) -> None:
    in_metres = read_camera_toml(written(tmp_path, POSE2SIM))["left"]
    path = written(tmp_path, POSE2SIM.replace("[0.32, 0.96, 2.9]", "[320.0, 960.0, 2900.0]"))
    with pytest.raises(UnitError, match="3071 m away.*metres_per_unit, 0.001"):
        read_camera_toml(path)
    assert_same(read_camera_toml(path, metres_per_unit=0.001)["left"], in_metres)


def test_written_cameras_are_read_back(tmp_path: Path, camera: Camera) -> None:
    given = {"a": camera, "b": read_camera_toml(written(tmp_path, POSE2SIM))["left"]}
    path = tmp_path / "out.toml"
    write_camera_toml(path, given)
    again = read_camera_toml(path)
    assert list(again) == ["a", "b"]
    for name in given:
        assert_same(again[name], given[name])
    with pytest.raises(OutputExistsError, match="out.toml"):
        write_camera_toml(path, again)
    write_camera_toml(path, {"a": again["a"]}, overwrite=True)
    assert list(read_camera_toml(path)) == ["a"]
    with pytest.raises(RtofError, match="cannot be written"):
        write_camera_toml(path / "out.toml", again)
