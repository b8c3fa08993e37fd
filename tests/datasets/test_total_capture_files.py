"""Files of Total Capture are found by name at any depth, and none is assigned by guessing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import flat, points_px, walking, watching

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.datasets.total_capture_files import KINDS, find_files, read_detections

POSITIONS = "gt_skel_gbl_pos.txt"


def put(root: Path, *paths: str) -> None:
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(path)


@pytest.mark.parametrize(
    ("path", "take", "kind"),
    [
        (f"S1/acting3/{POSITIONS}", ("S1", "acting3"), "positions"),
        ("s1_vicon_pos_ori/Acting3/GT_SKEL_GBL_ORI.TXT", ("S1", "acting3"), "orientations"),
        (f"S1_acting3/{POSITIONS}", ("S1", "acting3"), "positions"),
        (f"TotalCapture S4/Freestyle1 (copy)/{POSITIONS}", ("S4", "freestyle1"), "positions"),
        ("imu/s2_walking2_Xsens.sensors", ("S2", "walking2"), "sensors"),
        ("gyro_mag/s2/Walking2_Xsens_AuxFields.sensors", ("S2", "walking2"), "aux_sensors"),
        ("S3/s3_rom1_calib_imu_bone.txt", ("S3", "rom1"), "calib_bone"),
        ("S3/rom1/calib_imu_ref.txt", ("S3", "rom1"), "calib_ref"),
        ("S5/rom3_Xsens_AuxFields.sensors", ("S5", "rom3"), "aux_sensors"),
        ("S2/acting1/s1_acting3_Xsens.sensors", ("S1", "acting3"), "sensors"),
    ],
)
def test_subject_and_take_come_from_path(path: str, take: tuple[str, str], kind: str, tmp_path: Path) -> None:
    put(tmp_path, path)
    index = find_files(tmp_path)
    assert index.files == {take: {kind: [tmp_path / path]}}
    assert not index.unassigned


@pytest.mark.parametrize(
    "path",
    [
        f"acting3/{POSITIONS}",
        f"S1/{POSITIONS}",
        f"S1-S3/walking1/{POSITIONS}",
        f"S3/from2017/{POSITIONS}",
        f"S1/acting1-acting3/{POSITIONS}",
        f"S6/acting3/{POSITIONS}",
        f"S1/acting13/{POSITIONS}",
        "Acting3_Xsens_AuxFields.sensors",
        f"class1/acting3/{POSITIONS}",
    ],
)
def test_ambiguous_paths_are_not_assigned(path: str, tmp_path: Path) -> None:
    put(tmp_path, path)
    with pytest.raises(FileFormatError, match=r"subject and take of .*name the folder"):
        find_files(tmp_path)
    put(tmp_path, f"S5/walking2/{POSITIONS}")
    index = find_files(tmp_path)
    assert list(index.files) == [("S5", "walking2")]
    assert index.unassigned == [tmp_path / path]


def test_equal_files_are_allowed_and_different_ones_refused(tmp_path: Path) -> None:
    put(tmp_path, f"b/S5/acting3/{POSITIONS}")
    shutil.copytree(tmp_path / "b", tmp_path / "a")
    one, two = (tmp_path / x / "S5" / "acting3" / POSITIONS for x in "ab")
    assert find_files(tmp_path).one(("S5", "acting3"), "positions") == one
    two.write_text("other")
    index = find_files(tmp_path)
    with pytest.raises(FileFormatError) as caught:
        index.one(("S5", "acting3"), "positions")
    assert str(one) in str(caught.value)
    assert str(two) in str(caught.value)
    assert all(index.one(("S5", "acting3"), kind) is None for kind in KINDS if kind != "positions")


def test_links_in_circles_end(tmp_path: Path) -> None:
    put(tmp_path, f"a/S5/acting3/{POSITIONS}")
    (tmp_path / "b").mkdir()
    for folder, other in (("a", "b"), ("b", "a")):
        (tmp_path / folder / "above").symlink_to(tmp_path)
        for name in ("x", "y"):
            (tmp_path / folder / name).symlink_to(tmp_path / other)
    assert find_files(tmp_path).one(("S5", "acting3"), "positions") is not None


NAMES = SkeletonModel.default().names
T = 7


def values(landmarks: int = len(NAMES), seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """uv_px (T, L, 2) and confidence (T, L)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1000, (T, landmarks, 2)), rng.uniform(0.1, 1, (T, landmarks))


def write(path: Path, **changed: Any) -> Path:
    """An .npz of 21 joints, its arrays changed; those that are None are left out."""
    uv, confidence = values()
    arrays = {"uv_px": uv, "confidence": confidence} | changed
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:  # as savez would add to a name in capitals
        np.savez(stream, **{name: a for name, a in arrays.items() if a is not None})
    return path


@pytest.fixture
def read(tmp_path: Path, camera: Camera) -> Any:
    """What is found of S5 acting3 camera 1, or of another take."""

    def of(*about: Any, **options: Any) -> KeypointSequence:
        return read_detections(tmp_path, *(about or ("S5", "acting3", 1)), camera, **options)

    return of


@pytest.mark.parametrize(
    "name",
    [
        "TC_S5_acting3_cam1.npz",
        "S5_acting3_cam1.npz",
        "a/b/tc_s5_Acting3_CAM1.npz",
        "S5/acting3/cam1.npz",
        "deep/s5/ACTING3/Cam1.NPZ",
        "S5/acting3/TC_S5_acting3_cam1.npz",
    ],
)
def test_every_name_is_found_at_any_depth_in_any_case(name: str, tmp_path: Path, read: Any) -> None:
    write(tmp_path / name)
    for other in (
        "S5_acting3_cam11.npz",
        "S5_acting3_cam2.npz",
        "S4_acting3_cam1.npz",
        "S5/acting1/cam1.npz",
        "XS5_acting3_cam1.npz",
        "S5_acting3_cam1.npz.txt",
        "S5/acting3/._cam1.npz",
        "__MACOSX/S5/acting3/cam1.npz",
    ):
        write(tmp_path / other, uv_px=values(seed=1)[0])
    found = read()
    np.testing.assert_array_equal(found.uv_px, values()[0])
    np.testing.assert_array_equal(found.confidence, values()[1])


def test_a_csv_has_the_columns_of_a_recording(tmp_path: Path, read: Any) -> None:
    text = "Nose_u_px,Nose_v_px,Hips_u_px,Hips_v_px,Hips_confidence\n10,20,30,40,0.5\n11,21,,,\n"
    (tmp_path / "TC_S5_acting3_cam1.csv").write_text(text)
    found = read()
    assert found.names == ("Nose", "Hips")
    np.testing.assert_array_equal(found.uv_px[0], [[10, 20], [30, 40]])
    np.testing.assert_array_equal(found.confidence, [[1, 0.5], [1, 0]])
    np.testing.assert_allclose(found.times, [0, 1 / 60])
    timed = "".join(f"{c},{row}\n" for c, row in zip(("time", 2.0, 2.5), text.split(), strict=True))
    (tmp_path / "TC_S5_acting3_cam1.csv").write_text(timed)
    np.testing.assert_array_equal(read().times, [2.0, 2.5])


def test_landmarks_are_named_by_a_file_or_by_the_skeleton(tmp_path: Path, read: Any) -> None:
    write(tmp_path / "S5_walking2_cam1.npz")
    assert read("S5", "walking2", 1).names == NAMES
    uv, confidence = values(3)
    write(tmp_path / "all" / "S5_acting3_cam1.npz", uv_px=uv, confidence=confidence)
    (tmp_path / "landmarks.txt").write_text("Nose\nLeftHand\r\nRightFoot\n")
    found = read()
    assert found.names == ("Nose", "LeftHand", "RightFoot")
    np.testing.assert_array_equal(found.uv_px, uv)


def test_missing_and_contradicting_files_are_refused(tmp_path: Path, camera: Camera, read: Any) -> None:
    one = write(tmp_path / "S5_acting3_cam2.npz")
    with pytest.raises(FileFormatError, match=r"S5 acting3 camera 1: .*TC_S5_acting3_cam1\.npz"):
        read()
    with pytest.raises(FileFormatError, match="no detections of S. "):
        read("S.", "acting3", 2)
    with pytest.raises(FileFormatError, match="gone: there is no such folder"):
        read_detections(tmp_path / "gone", "S5", "acting3", 1, camera)
    two = tmp_path / "backup" / "TC_S5_acting3_cam2.npz"
    two.parent.mkdir()
    two.write_bytes(one.read_bytes())
    np.testing.assert_array_equal(read("S5", "acting3", 2).uv_px, values()[0])
    write(two, uv_px=values(seed=1)[0])
    with pytest.raises(FileFormatError, match=r"cam2\.npz: .*cam2\.npz .*remove"):
        read("S5", "acting3", 2)


def test_wrong_names_of_landmarks_are_refused(tmp_path: Path, read: Any) -> None:
    uv, confidence = values(2)
    write(tmp_path / "S5_acting3_cam1.npz", uv_px=uv, confidence=confidence)
    (tmp_path / "landmarks.txt").write_text("Nose\nLeftHnad\n")
    with pytest.raises(UnknownNameError, match=r"cam1.npz 'LeftHnad'.*Did you mean 'LeftHand'"):
        read()
    (tmp_path / "landmarks.txt").write_text("Nose\nNose\n")
    with pytest.raises(FileFormatError, match="cam1.npz: .*Nose .*more than once"):
        read()
    (tmp_path / "landmarks.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match=r"landmarks.txt: not a text file in UTF-8"):
        read()
    (tmp_path / "S5_acting3_cam1.npz").unlink()
    (tmp_path / "S5_acting3_cam1.csv").write_text("left_hip_u_px,left_hip_v_px\n1,2\n")
    with pytest.raises(UnknownNameError, match="name of their layout.*left_hip"):
        read()


def test_points_of_a_layout_are_converted_to_landmarks(tmp_path: Path) -> None:
    motion = walking()
    camera = watching(motion)
    for layout, extra in (("coco17", "Nose"), ("mediapipe33", "RightHandEnd")):
        np.savez(tmp_path / "S5_acting3_cam1.npz", keypoints=points_px(layout, motion, camera))
        for asked in (layout, "auto"):
            found = read_detections(tmp_path, "S5", "acting3", 1, camera, layout=asked)
            assert set(NAMES) < set(found.names)
            assert extra in found.names
            np.testing.assert_allclose(found.times, np.arange(len(motion.times)) / 60)
            seen = found.select(NAMES).uv_px
            off = np.linalg.norm(seen - camera.project(motion.poses.p_world_joint), axis=-1)
            assert np.nanmedian(off) < 12
    with pytest.raises(FileFormatError, match=r"cam1.npz: layout body25 has 25 points.*mediapipe33"):
        read_detections(tmp_path, "S5", "acting3", 1, camera, layout="body25")
    with pytest.raises(UnknownNameError, match="array.*'keypoints'"):
        read_detections(tmp_path, "S5", "acting3", 1, camera)


def test_a_folder_of_json_is_found_like_a_file(tmp_path: Path) -> None:
    motion = walking()
    camera, folder = watching(motion), tmp_path / "S5" / "acting3" / "Cam1"
    folder.mkdir(parents=True)
    for frame, points in enumerate(points_px("body25", motion, camera)):
        text = json.dumps({"people": [{"pose_keypoints_2d": flat(points)}]})
        (folder / f"{frame:012d}_keypoints.json").write_text(text)
    found = read_detections(tmp_path, "S5", "acting3", 1, camera, layout="auto")
    assert len(found) == len(motion.times)
    assert "RightHeel" in found.names
    np.savez(tmp_path / "S5_acting3_cam1.npz", keypoints=points_px("coco17", motion, camera))
    with pytest.raises(FileFormatError, match="claims to be the same detections; remove the wrong"):
        read_detections(tmp_path, "S5", "acting3", 1, camera, layout="auto")
