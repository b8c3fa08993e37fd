"""Text formats of Total Capture: planted values, spellings, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import total_capture_support as support

from benchmarks import total_capture_files as files
from benchmarks.total_capture_motion import cameras
from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.total_capture import read_cameras, read_imu_calibration, read_joints, read_sensors
from rtof_kin.simulation.mocap import NAMES

READERS = {
    "positions": lambda path: read_joints(path, 3),
    "orientations": lambda path: read_joints(path, 4),
    "sensors": read_sensors,
    "aux": read_sensors,
    "ref": read_imu_calibration,
    "bone": read_imu_calibration,
    "cameras": read_cameras,
}


@pytest.fixture
def paths(tmp_path: Path) -> dict[str, Path]:
    """Files of one perfect take, to be spoiled."""
    return support.dataset(tmp_path)


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def test_written_positions_and_orientations_are_read(paths: dict[str, Path]) -> None:
    poses = support.motion()
    positions = read_joints(paths["positions"], 3)
    assert positions.names == NAMES
    expected = files.tc_positions(poses.p_world_joint)
    np.testing.assert_allclose(positions.values, expected, rtol=6e-6, atol=1e-9)
    orientations = read_joints(paths["orientations"], 4)
    expected = files.quat_xyzw(files.tc_rotations(poses.R_world_bone))
    np.testing.assert_allclose(orientations.values, expected, rtol=6e-6, atol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "Hips\tSpine\n1 2 3\t4 5.0E+0 6\n",
        "Hips\tSpine\t\r\n1 2 3\t4 5 6\t\r\n",
        "Hips\tSpine\t\n1 2 3\t4 5 6\t\n\n\n",
        "Hips\tSpine\t\n1 2 3\t4 5 6\t",
        "Hips Spine\n1  2 3 4\t5 6\n",
    ],
    ids=["no tab at the end", "CRLF", "blank lines at the end", "no newline at the end", "spaces"],
)
def test_every_spacing_of_a_joint_table(text: str, tmp_path: Path) -> None:
    table = read_joints(write(tmp_path / "p.txt", text), 3)
    assert table.names == ("Hips", "Spine")
    np.testing.assert_array_equal(table.values, [[[1, 2, 3], [4, 5, 6]]])


@pytest.mark.parametrize("kind", ["sensors", "aux"])
def test_written_sensors_are_read_from_both_kinds_of_file(kind: str, paths: dict[str, Path]) -> None:
    imus = support.take().imus
    table = read_sensors(paths[kind])
    assert table.names == imus.names
    R = files.so3.from_quat_wxyz(table.quat_wxyz)
    assert support.degrees_apart(R, imus.R_inertial_sensor) < 1e-3
    np.testing.assert_allclose(table.f_sensor, imus.f_sensor, rtol=6e-6, atol=1e-9)


def test_sensors_by_hand_with_mixed_spacing(tmp_path: Path) -> None:
    text = "2 2\n1\nHead\t1 0 0 0 0.1 0.2 9.8\nPelvis\t0 1 0 0 1 2 3\n"
    text += "2\r\nHead\t0\t0\t1\t0\t4\t5\t6\r\nPelvis 0 0 0 1 7 8 9e0\r\n\r\n"
    table = read_sensors(write(tmp_path / "x.sensors", text))
    assert table.names == ("Head", "Pelvis")
    np.testing.assert_array_equal(table.quat_wxyz[:, 0], [[1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_array_equal(table.f_sensor[:, 1], [[1, 2, 3], [7, 8, 9]])


def test_calibration_by_hand_is_x_y_z_w(tmp_path: Path) -> None:
    text = "2\r\nHead -0.698693 -0.000693276 0.030256 0.714781 \r\n\r\nPelvis\t0 0 0 1\r\n"
    found = read_imu_calibration(write(tmp_path / "ref.txt", text))
    assert list(found) == ["Head", "Pelvis"]
    np.testing.assert_allclose(found["Head"], [-0.698693, -0.000693276, 0.030256, 0.714781], atol=1e-5)
    np.testing.assert_array_equal(found["Pelvis"], [0, 0, 0, 1])


def test_written_cameras_are_read_in_the_files_world(paths: dict[str, Path]) -> None:
    found = read_cameras(paths["cameras"])
    assert sorted(found) == list(range(1, 9))
    for number, planted in cameras().items():
        camera = found[number]
        assert (camera.width_px, camera.height_px) == (1920, 1080)
        np.testing.assert_allclose(camera.K, planted.K)
        p_world = np.array([[0.3, -0.4, 1.7], [-1.0, 0.5, 0.2]])
        seen = camera.project(p_world @ files.C_WORLD_TC)
        np.testing.assert_allclose(seen, planted.project(p_world), atol=1e-5)
    assert found[1].center_world == pytest.approx([1.19, 2.45, -4.70], abs=1e-6)


def one_camera(**changed: str) -> str:
    """A calibration.cal of one camera at (1, 2, 5) that looks along -z, upright."""
    rows = {
        "head": "1 1",
        "size": "0 1079 0 1919",
        "focal": "1200 1210 959.5 539.5",
        "distortion": "0.5",
        "x": "1 0 0",
        "y": "0 -1 0",
        "z": "0 0 -1",
        "t": "-1 2 5",
    }
    return "".join(f"{row} \r\n" for row in (rows | changed).values())


def test_camera_by_hand(tmp_path: Path) -> None:
    (camera,) = read_cameras(write(tmp_path / "c.cal", one_camera())).values()
    assert camera.center_world == pytest.approx([1, 2, 5])
    (other,) = read_cameras(write(tmp_path / "c.cal", "\t".join(one_camera().split()))).values()
    np.testing.assert_array_equal(other.R_camera_world, camera.R_camera_world)
    # Half a metre right of and below the axis, two metres away: r2 = 0.125.
    x = 0.25 * (1 + 0.5 * 0.125)
    expected = [1200 * x + 959.5, 1210 * x + 539.5]
    np.testing.assert_allclose(camera.project([1.5, 1.5, 3.0]), expected)


@pytest.mark.parametrize("kind", ["positions", "orientations", "sensors", "aux", "cameras"])
def test_incomplete_download_is_refused(kind: str, paths: dict[str, Path]) -> None:
    data = paths[kind].read_bytes()
    for share in (0.02, 0.3, 0.77, 0.97):
        paths[kind].write_bytes(data[: int(share * len(data)) - 3])
        with pytest.raises(FileFormatError, match=paths[kind].name):
            READERS[kind](paths[kind])
