"""The table of detectors' layouts: what is known of each, and what a broken table says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import canonical, detector_table, mirrored, own, read_detector_table

TEXT = model_path("detectors.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "layout, count, index, name",
    [
        ("body25", 25, 8, "HipCentre"), ("body25", 25, 1, "ShoulderCentre"),
        ("body25", 25, 4, "RightWrist"), ("body25", 25, 24, "RightHeel"),
        ("body25b", 25, 17, "UpperNeck"), ("body25b", 25, 18, "HeadTop"),
        ("body25b", 25, 5, "LeftShoulder"), ("coco17", 17, 16, "RightAnkle"), ("coco17", 17, 0, "Nose"),
        ("halpe26", 26, 19, "HipCentre"), ("halpe26", 26, 21, "RightBigToe"),
        ("halpe26", 26, 17, "HeadTop"),
        ("mediapipe33", 33, 23, "LeftHip"), ("mediapipe33", 33, 32, "RightFootIndex"),
        ("human36m17", 17, 6, "LeftH36mFoot"), ("human36m17", 17, 16, "RightH36mWrist"),
        ("joints", 21, 0, own("Hips")), ("landmarks", 33, 32, own("LeftToe")),
    ],
)  # fmt: skip
def test_points_stand_in_the_order_that_detectors_document(
    layout: str, count: int, index: int, name: str
) -> None:
    points = detector_table().layout(layout).points
    assert len(points) == count
    assert points[index] == name


def test_each_side_is_the_mirror_image_of_the_other() -> None:
    table = detector_table()
    points = {point.name: point for point in table.points}
    for point in table.points:
        other = points[mirrored(point.name)]
        assert other.joint == mirrored(point.joint)
        np.testing.assert_allclose(other.offset, point.offset * [1, -1, 1])
    for layout in LAYOUTS:
        both = table.layout(layout).points
        assert {mirrored(name) for name in both} == set(both)


def test_points_scale_with_the_segment_that_carries_them() -> None:
    table, skeleton = detector_table(), SkeletonModel.default()
    longer = table.points_on(skeleton.with_bone_lengths({"RightLeg": 0.495}))
    for before, after in zip(table.points, longer, strict=True):
        if before.joint in ("RightUpLeg", "LeftUpLeg", "Hips", "RightLeg"):
            ratio = 1.25 if before.joint == "RightUpLeg" else 1.0
            np.testing.assert_allclose(after.offset, ratio * before.offset, atol=1e-12)


@pytest.mark.parametrize(
    "name, one",
    [
        ("LBigToe", "LeftBigToe"), ("left_big_toe", "LeftBigToe"), ("LEFT_BIG_TOE", "LeftBigToe"),
        ("mouth_left", "LeftMouth"), ("left eye (inner)", "LeftEyeInner"), ("RHip", "RightHip"),
        ("nose", "Nose"), ("MidHip", "MidHip"), ("L Ear", "LeftEar"), ("", ""),
    ],
)  # fmt: skip
def test_a_name_is_the_same_in_every_spelling(name: str, one: str) -> None:
    assert canonical(name) == one


@pytest.mark.parametrize("layout", LAYOUTS)
def test_named_points_are_found_in_any_order(layout: str) -> None:
    form = detector_table().layout(layout)
    shuffled = np.random.default_rng(0).permutation(len(form))
    names = [form.names[i].upper() if layout == "coco17" else form.names[i] for i in shuffled]
    order = form.order([*names, "something_else"])
    assert order is not None
    assert [names[i].lower() for i in order] == [name.lower() for name in form.names]
    assert form.order(names[1:]) is None


def test_an_unknown_layout_is_named_with_those_known() -> None:
    with pytest.raises(UnknownNameError, match="'halpe25'.*Did you mean 'halpe26'.*mediapipe33"):
        detector_table().layout("halpe25")


@pytest.mark.parametrize(
    "before, after, message",
    [
        ('name = "Nose"\njoint', 'joint', "the field 'name' is missing"),
        ('joint = "Head"', 'joint = "Haed"', "joint in .*Haed"),
        ("offset_mm = [103, 0, 5]", "offset_mm = [103, 0]", "no point x, y, z"),
        ("offset_mm = [103, 0, 5]", 'offset_mm = "far"', "not of the right kind"),
        ('names = [\n    "Nose", "Neck"', 'names = [\n    "Nose", "Nose"', "body25: Nose stands"),
        ('Neck = "ShoulderCentre"', 'Neck = "Collar"', "point in .*Collar"),
        ('name = "HeadTop"\njoint', 'name = "Nose"\njoint', "Nose stands there twice"),
        ("[seen_by]", "[seen_by]\nTail = []", "landmark in .*Tail"),
        ('from = "Hips"', 'from = "Hip"', "joint in .*'Hip'"),
        ("[naive]", "naive", "not readable as TOML"),
    ],
)  # fmt: skip
def test_a_broken_table_is_refused_by_name(before: str, after: str, message: str, tmp_path: Path) -> None:
    assert before in TEXT
    path = tmp_path / "detectors.toml"
    path.write_text(TEXT.replace(before, after, 1), encoding="utf-8")
    with pytest.raises((FileFormatError, UnknownNameError), match=message) as caught:
        read_detector_table(path)
    assert str(path) in str(caught.value)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no such file"):
        read_detector_table(tmp_path / "none.toml")
