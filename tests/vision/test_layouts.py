"""The table of detectors' layouts, and errors of a damaged one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS

from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import Layout, detector_table, mirrored, own, read_detector_table

TEXT = model_path("detectors.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "layout, count, index, name",
    [
        ("body25", 25, 8, "HipCentre"),
        ("body25", 25, 24, "RightHeel"),
        ("body25b", 25, 17, "UpperNeck"),
        ("coco17", 17, 16, "RightAnkle"),
        ("halpe26", 26, 19, "HipCentre"),
        ("mediapipe33", 33, 32, "RightFootIndex"),
        ("human36m17", 17, 6, "LeftH36mFoot"),
        ("landmarks", 33, 32, own("LeftToe")),
    ],
)
def test_points_stand_in_the_order_that_detectors_document(layout: str, count: int, index: int, name: str) -> None:
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


@pytest.mark.parametrize(
    "name, one",
    [
        ("LBigToe", "LeftBigToe"),
        ("left_big_toe", "LeftBigToe"),
        ("LEFT_BIG_TOE", "LeftBigToe"),
        ("mouth_left", "LeftMouth"),
        ("left eye (inner)", "LeftEyeInner"),
        ("RHip", "RightHip"),
        ("nose", "Nose"),
        ("MidHip", "MidHip"),
        ("L Ear", "LeftEar"),
    ],
)
def test_names_are_independent_of_spelling(name: str, one: str) -> None:
    layout = Layout("own", "own", (one, "Neck"), ("a", "b"))
    assert layout.order(["neck", name]) == [1, 0]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_named_points_are_found_in_any_order(layout: str) -> None:
    form = detector_table().layout(layout)
    shuffled = np.random.default_rng(0).permutation(len(form))
    names = [form.names[i].upper() if layout == "coco17" else form.names[i] for i in shuffled]
    order = form.order([*names, "something_else"])
    assert order is not None
    assert [names[i].lower() for i in order] == [name.lower() for name in form.names]
    assert form.order(names[1:]) is None


@pytest.mark.parametrize(
    "before, after, message",
    [
        ('name = "Nose"\njoint', "joint", "the field 'name' is missing"),
        ('joint = "Head"', 'joint = "Haed"', "joint in .*Haed"),
        ("offset_mm = [103, 0, 5]", "offset_mm = [103, 0]", "no point x, y, z"),
        ("offset_mm = [103, 0, 5]", 'offset_mm = "far"', "not of the right kind"),
        ('names = [\n    "Nose", "Neck"', 'names = [\n    "Nose", "Nose"', "body25: Nose stands"),
        ('Neck = "ShoulderCentre"', 'Neck = "Collar"', "point in .*Collar"),
        ('name = "HeadTop"\njoint', 'name = "Nose"\njoint', "Nose stands there twice"),
        ("[seen_by]", "[seen_by]\nTail = []", "landmark in .*Tail"),
        ("[naive]", "naive", "not readable as TOML"),
    ],
)
def test_a_broken_table_is_refused_by_name(before: str, after: str, message: str, tmp_path: Path) -> None:
    assert before in TEXT
    path = tmp_path / "detectors.toml"
    path.write_text(TEXT.replace(before, after, 1), encoding="utf-8")
    with pytest.raises((FileFormatError, UnknownNameError), match=message) as caught:
        read_detector_table(path)
    assert str(path) in str(caught.value)
