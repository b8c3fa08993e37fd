"""The table of detectors' layouts."""

from __future__ import annotations

import numpy as np
import pytest
from detector_support import LAYOUTS

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.vision.layouts import Layout, detector_table, mirrored, own


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


def test_every_name_of_the_table_is_known_and_none_stands_twice() -> None:
    table, skeleton = detector_table(), SkeletonModel.default()
    points = [point.name for point in table.points]
    for names in (points, *(layout.points for layout in table.layouts.values())):
        assert len(set(names)) == len(names)
    assert {point.joint for point in table.points} <= set(skeleton.names)
    assert set(table.seen_by) <= set(skeleton.landmarks)
    used = {name for layout in table.layouts.values() for name in layout.points}
    used |= {name for names in table.seen_by.values() for name in names}
    assert used <= {*points, *map(own, skeleton.landmarks)}
    assert {np.shape(point.offset) for point in table.points} == {(3,)}
