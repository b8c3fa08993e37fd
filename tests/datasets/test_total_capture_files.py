"""Files of Total Capture are found by name at any depth, and none is assigned by guessing."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.datasets.total_capture_files import KINDS, find_files

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
        ("S5/rom3_BlenderZXY_YmZ.bvh", ("S5", "rom3"), "bvh"),
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


def test_the_folder_or_a_link_may_name_the_subject(tmp_path: Path) -> None:
    put(tmp_path, f"data/S4/acting3/{POSITIONS}", f"store/42/acting3/{POSITIONS}")
    assert list(find_files(tmp_path / "data" / "S4").files) == [("S4", "acting3")]
    os.symlink(tmp_path / "data" / "S4", tmp_path / "other", target_is_directory=True)
    assert list(find_files(tmp_path / "other").files) == [("S4", "acting3")]
    os.symlink(tmp_path / "store" / "42", tmp_path / "S2", target_is_directory=True)
    index = find_files(tmp_path)
    assert sorted(index.files) == [("S2", "acting3"), ("S4", "acting3")]
    assert not index.unassigned  # each is found by its other name


def test_loops_of_links_end(tmp_path: Path) -> None:
    put(tmp_path, f"S5/acting3/{POSITIONS}")
    folders = [tmp_path / f"f{i}" for i in range(12)]
    for folder in folders:
        folder.mkdir()
        for i, other in enumerate(folders):
            os.symlink(other, folder / f"to{i}", target_is_directory=True)
    os.symlink(tmp_path / "itself", tmp_path / "itself")
    assert list(find_files(tmp_path).files) == [("S5", "acting3")]


def test_a_broken_link_is_reported_and_not_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    put(tmp_path, f"S5/acting3/{POSITIONS}")
    broken = tmp_path / "S5" / "acting3" / f"s5_acting3_{POSITIONS}"
    os.symlink(tmp_path / "gone", broken)
    index = find_files(tmp_path)
    assert f"{broken}: cannot be read; not used" in caplog.text
    assert index.one(("S5", "acting3"), "positions") == tmp_path / "S5" / "acting3" / POSITIONS


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
    two.unlink()
    with pytest.raises(FileFormatError, match="cannot be compared"):
        index.one(("S5", "acting3"), "positions")
