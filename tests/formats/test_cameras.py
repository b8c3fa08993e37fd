"""Cameras in OpenCV's YAML: files of OpenCV, files of people, and what is refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
import tomli_w

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnitError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.cameras import read_camera, read_opencv_yaml
from rtof_kin.recording.recording import Recording

cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
K = np.array([[1250.5, 0.0, 960.25], [0.0, 1240.125, 540.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.05, 0.1, 1e-5, -0.002, 0.01])
RVEC = np.array([1.688, 1.048, -0.42])
TVEC = np.array([0.32, 0.96, 2.9])
R = cv2.Rodrigues(RVEC)[0]
POSE = np.hstack([R, TVEC[:, None]])
PLAIN = f"""
image_width: 1920
image_height: 1080
K: {K.tolist()}
dist: {DISTORTION.tolist()}
rvec: {RVEC.tolist()}
tvec: {TVEC.tolist()}
"""
PLACED = f"rvec: {RVEC.tolist()}\ntvec: {TVEC.tolist()}"


def stored(path: Path, entries: dict[str, object]) -> Path:
    """A file that OpenCV itself writes."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()
    return path


def written(folder: Path, text: str) -> Path:
    path = folder / "camera.yml"
    path.write_text(text)
    return path


def assert_same(a: Camera, b: Camera) -> None:
    assert (a.width_px, a.height_px) == (b.width_px, b.height_px)
    for field in ("K", "R_camera_world", "t_camera_world", "distortion"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), atol=1e-7)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "json"])
@pytest.mark.parametrize("rotation", [R, RVEC, RVEC[:, None]], ids=["matrix", "row", "column"])
def test_file_of_opencv_projects_as_opencv_does(rotation: np.ndarray, suffix: str, tmp_path: Path) -> None:
    entries = {"image_width": 1920, "image_height": 1080, "camera_matrix": K, "R": rotation}
    entries |= {"distortion_coefficients": DISTORTION[None], "T": TVEC[:, None]}
    path = stored(tmp_path / f"left.{suffix}", entries)
    cameras = read_opencv_yaml(path)
    assert list(cameras) == ["left"]
    p = np.array([[0.2, -0.3, 1.1], [-0.4, 0.6, 0.9]])
    expected = cv2.projectPoints(p, RVEC, TVEC, K, DISTORTION)[0][:, 0]
    np.testing.assert_allclose(read_camera(path).project(p), expected, atol=1e-6)


@pytest.mark.parametrize(
    "old, new",
    [
        ("K:", "camera_matrix:"),
        (f"K: {K.tolist()}", f"cameraMatrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}"),
        ("dist:", "distortion_model: plumb_bob\ndistCoeffs:"),
        (PLACED, f"extrinsics: {POSE.tolist()}"),
        (PLACED, f"extrinsic_matrix: {[*POSE.tolist(), [0, 0, 0, 1]]}"),
        ("image_width: 1920\nimage_height: 1080", "image_size: [1920, 1080]"),
        (f"dist: {DISTORTION.tolist()}", f"dist: {[*DISTORTION.tolist(), 0, 0, 0.0]}"),
        ("1e-05", "1.0E-05"),
        ("\nimage_width", "\nflags: !!opencv-matrix {rows: 1, cols: 1, dt: d, data: [1]}\nimage_width"),
    ],
)
def test_other_spellings_of_one_camera(old: str, new: str, tmp_path: Path) -> None:
    plain = read_opencv_yaml(written(tmp_path, PLAIN))["camera"]
    assert old in PLAIN
    assert_same(read_opencv_yaml(written(tmp_path, PLAIN.replace(old, new)))["camera"], plain)


@pytest.mark.parametrize(
    "text",
    ["left:{0}\nright:{0}", "cameras:\n  left:{0}\n  right:{0}", "cameras:\n  - name: left{0}\n  - name: right{0}"],
)
def test_several_cameras_in_one_file(text: str, tmp_path: Path) -> None:
    plain = read_opencv_yaml(written(tmp_path, PLAIN))["camera"]
    path = written(tmp_path, text.format(PLAIN.replace("\n", "\n    ")))
    assert list(read_opencv_yaml(path)) == ["left", "right"]
    assert_same(read_camera(path, "right"), plain)
    with pytest.raises(FileFormatError, match="name one of left, right"):
        read_camera(path)
    with pytest.raises(UnknownNameError, match="'rigth'.*'right'"):
        read_camera(path, "rigth")


@pytest.mark.parametrize("table", [{"name": "left"}, {"name": "left", "metres_per_unit": 0.001}])
def test_recording_takes_its_camera_from_a_file(table: dict[str, object], tmp_path: Path) -> None:
    planted.recording(planted.moving(SkeletonModel.default(), 12)).save(tmp_path / "take")
    written(tmp_path / "take", "left:" + PLAIN.replace("\n", "\n    "))
    index = tmp_path / "take" / "recording.toml"
    content = tomllib.loads(index.read_text()) | {"camera": {"file": "camera.yml", **table}}
    index.write_text(tomli_w.dumps(content))
    keypoints = Recording.load(tmp_path / "take").keypoints
    unit = float(table.get("metres_per_unit", 1.0))  # type: ignore[arg-type]
    np.testing.assert_allclose(keypoints.camera.t_camera_world, TVEC * unit)
    index.write_text(tomli_w.dumps(content | {"camera": {"file": "camera.yml", "width_px": 9}}))
    with pytest.raises(FileFormatError, match="width_px: stands beside file"):
        Recording.load(tmp_path / "take")


def test_read_camera_takes_the_reader_of_the_suffix(tmp_path: Path, camera: Camera) -> None:
    write_camera_toml(tmp_path / "a.toml", {"only": camera})
    assert_same(read_camera(tmp_path / "a.toml"), camera)
    with pytest.raises(FileFormatError, match=r"known suffixes: \.toml, \.yml"):
        read_camera(tmp_path / "a.xml")


def test_stereo_pair_has_its_first_camera_as_world_and_ignores_rectification(tmp_path: Path) -> None:
    intrinsics = {"image_width": 640, "image_height": 480, "M1": K, "D1": np.zeros((1, 5)), "M2": K}
    inner = stored(tmp_path / "intrinsics.yml", intrinsics | {"D2": DISTORTION})
    other = cv2.Rodrigues(np.array([0.1, 0.2, 0.3]))[0]
    extrinsics = {"R": R, "T": TVEC, "R1": other, "R2": other, "P1": POSE, "P2": POSE, "Q": np.eye(4)}
    outer = stored(tmp_path / "extrinsics.yml", extrinsics)
    cameras = read_opencv_yaml(inner, extrinsics=outer, up="-y")
    assert list(cameras) == ["camera_1", "camera_2"]
    first, second = cameras.values()
    p_first = np.array([0.3, 0.2, 2.0])
    p_world = (p_first - first.t_camera_world) @ first.R_camera_world
    np.testing.assert_allclose(second.to_camera(p_world), R @ p_first + TVEC, atol=1e-12)
    np.testing.assert_allclose(first.rays_world(K[:2, 2])[2], 0, atol=1e-12)  # level
    with pytest.raises(FileFormatError, match="viewing direction.*up='-y'"):
        read_opencv_yaml(inner, extrinsics=outer)
    with pytest.raises(FileFormatError, match="camera_2, R: missing"):
        read_opencv_yaml(inner, up="-y")


def test_up_axis_unit_and_size_are_declared(tmp_path: Path) -> None:
    path = written(tmp_path, PLAIN)
    plain = read_opencv_yaml(path)["camera"]
    turned = read_opencv_yaml(path, up="-y")["camera"]
    np.testing.assert_allclose(turned.project([0, 0, 1]), plain.project([0, -1, 0]), atol=1e-9)
    with pytest.raises(InvalidInputError, match="up: 'w'"):
        read_opencv_yaml(path, up="w")
    with pytest.raises(InvalidInputError, match="metres_per_unit: 0"):
        read_opencv_yaml(path, metres_per_unit=0)
    in_mm = written(tmp_path, PLAIN.replace("[0.32, 0.96, 2.9]", "[320.0, 960.0, 2900.0]"))
    with pytest.raises(UnitError, match="3071 m away.*metres_per_unit, 0.001"):
        read_opencv_yaml(in_mm)
    assert_same(read_camera(in_mm, metres_per_unit=0.001), plain)
    sizeless = written(tmp_path, PLAIN.replace("image_width: 1920\nimage_height: 1080", ""))
    with pytest.raises(FileFormatError, match="camera, image_width: missing"):
        read_opencv_yaml(sizeless)
    assert_same(read_opencv_yaml(sizeless, size_px=(1920, 1080))["camera"], plain)


def test_two_cameras_with_their_own_poses_are_no_stereo_pair(tmp_path: Path) -> None:
    both = {"K1": K, "R1": R, "T1": TVEC, "K2": K, "R2": R.T, "T2": TVEC}
    path = stored(tmp_path / "two.yml", {"image_width": 640, "image_height": 480, **both})
    first, second = read_opencv_yaml(path).values()
    np.testing.assert_allclose(first.R_camera_world, R, atol=1e-12)
    np.testing.assert_allclose(second.R_camera_world, R.T, atol=1e-12)
