"""The table of detectors' layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from detector_support import LAYOUTS

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.keypoints import detector_point
from rtof_kin.vision import layouts
from rtof_kin.vision.detections import Detections, of_body
from rtof_kin.vision.image_points import image_points
from rtof_kin.vision.layouts import Layout, Place, add_layout, detector_table, layout_named, mirrored, own, read_layout

FILE = """
[[point]]
name = "RightCoin"
joint = "RightUpLeg"
offset_mm = [70, -80, -200]
spread_mm = [10, 20, 30]
size_mm = 12

[[point]]
name = "Buckle"
joint = "Spine1"
share = [1.5, 0, 0.5]

[[point]]
name = "RightTape"
marker = "asis"

[[layout]]
name = "pockets"
names = ["nose", "coin_R", "coin_L", "buckle", "tape", "left_knee"]
points = { tape = "RightTape" }
"""


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
        ("coco_hands31", 31, 23, "LeftForefinger1"),
        ("halpe_hands34", 34, 33, "RightPinkyFinger1"),
        ("vitpose25", 25, 14, "HipCentre"),
        ("anatomical52", 52, 28, "RightAsis"),
        ("anatomical52", 52, 32, "RightKneeLateral"),
        ("anatomical52", 52, 49, "L2"),
        ("spine37", 37, 30, "SpineT3"),
        ("sapiens38", 38, 30, "LeftWrist"),
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


def test_two_points_of_one_spelling_are_told_apart_by_their_names() -> None:
    form = detector_table().layout("anatomical52")  # right_knee of COCO and r_knee, the lateral epicondyle
    names = form.names[::-1]
    assert form.order(names) == list(range(52))[::-1]
    assert form.order([name for name in names if name != "r_knee"]) is None


@pytest.fixture
def only_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts.ADDED, "_added", {})


@pytest.mark.usefixtures("only_shipped")
def test_a_file_gives_points_their_places(tmp_path: Path) -> None:
    (tmp_path / "pockets.toml").write_text(FILE, encoding="utf-8")
    assert layout_named(tmp_path / "pockets.toml") == "pockets" == layout_named("pockets")
    table = detector_table()
    form, places = table.layout("pockets"), table.places
    assert form.points == ("Nose", "RightCoin", "LeftCoin", "Buckle", "RightTape", "LeftKnee")
    assert places["LeftCoin"] == Place("LeftCoin", "LeftUpLeg", (0.07, 0.08, -0.2), (0.01, 0.02, 0.03), 0.012)
    length = np.linalg.norm([8, 0, 88]) / 1000  # of Spine1
    np.testing.assert_allclose(places["Buckle"].offset, [1.5 * length, 0, 0.5 * length])
    assert places["Buckle"].spread == (0.02, 0.02, 0.02)
    asis = load_toml(model_path("marker_sets.toml"))["point"]["asis"]
    np.testing.assert_allclose(places["RightTape"].offset, np.multiply(asis["place_mm"], [1, -1, 1]) / 1e3)
    np.testing.assert_allclose(places["RightTape"].spread, np.array(asis["sd_mm"]) / 1e3)
    body = SkeletonModel.default()
    seen = image_points(body, [detector_point("pockets", name) for name in form.points])
    for name, (j, _), at in zip(form.points[1:5], seen.on[1:5], seen.places[1:5], strict=True):
        assert body.names[j] == places[name].joint
        np.testing.assert_allclose(at, places[name].offset, atol=1e-12)
    coin, buckle = np.hypot(12, np.sqrt((1 + 4 + 9) / 3) * 10), np.hypot(20, 20)
    assert seen.sizes[1] / seen.sizes[3] == pytest.approx(coin / buckle)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('joint = "RightUpLeg"', 'joint = "RightThigh"', r"\[point.1\] joint: 'RightThigh' is not one of .*Hips"),
        ("offset_mm = [70, -80, -200]", "offset_mm = [70, -80]", r"\[point.1\] offset_mm: expected 3 numbers"),
        ("offset_mm = [70, -80, -200]", "", r"\[point.1\] joint: of 'RightCoin': give joint and one of offset_mm"),
        ("[10, 20, 30]", "[10, 20, -30]", r"\[point.1\] spread_mm: a standard deviation is not positive; give"),
        ('marker = "asis"', 'marker = "asi"', r"\[point.3\] marker.*'asi'.*Did you mean 'asis'"),
        ('tape = "RightTape"', 'tap = "RightTape"', r"\[layout.1\] points.*'tap'.*Did you mean 'tape'"),
        ('"RightCoin"', '"RightKnee"', "the point 'RightKnee' has another place already; choose another name"),
        ('tape = "RightTape"', 'tape = "Tape"', "point in layout 'pockets'.*'Tape'"),
        ('name = "pockets"', 'name = "coco17"', "'coco17' is a shipped one; choose another name"),
        ('"nose", "coin_R"', '"coin_R", "coin_R"', "the name 'coin_R' stands there twice"),
        ("[[layout]]", '[[layout]]\nname = "x"\nnames = ["a"]\n[[layout]]', "layout: 2 layouts; a file has one"),
        ("names =", "nams =", r"\[layout.1\].*Did you mean 'names'"),
        ("[[layout]]", "[[layout]]\nwhole = { 9 = [1] }", r"\[layout.1\] whole: '9': give 6 indices"),
    ],
)
@pytest.mark.usefixtures("only_shipped")
def test_a_wrong_file_is_one_sentence_with_file_key_and_remedy(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "pockets.toml"
    path.write_text(FILE.replace(old, new), encoding="utf-8")
    with pytest.raises(RtofError, match=said) as caught:
        layout_named(path)
    assert "pockets.toml" in str(caught.value)
    assert "pockets" not in detector_table().layouts


@pytest.mark.usefixtures("only_shipped")
def test_one_point_has_one_place() -> None:
    at = Place("Buckle", "Spine1", (0.1, 0.0, 0.0), (0.02, 0.02, 0.02))
    add_layout(Layout.of("one", "One", ["buckle"], places=[at]))
    add_layout(Layout.of("two", "Two", ["buckle"], places=[at]))
    other = Place("Buckle", "Spine2", (0.1, 0.0, 0.0), (0.02, 0.02, 0.02))
    with pytest.raises(InvalidInputError, match="'Buckle' has another place already"):
        add_layout(Layout.of("three", "Three", ["buckle"], places=[other]))
    with pytest.raises(RtofError, match="joint of point 'Fin'.*'Tail'"):
        add_layout(Layout.of("four", "Four", ["fin"], places=[Place("Fin", "Tail", (0.0, 0.0, 0.0), at.spread)]))
    assert set(detector_table().layouts) >= {"one", "two"}


@pytest.mark.parametrize(
    ("count", "layout", "first_hand"),
    [(133, "coco_hands31", 96), (136, "halpe_hands34", 99), (68, "halpe_hands34", 31), (308, "sapiens38", 28)],
)
def test_knuckles_are_taken_from_whole_bodies_where_they_are_wanted(count: int, layout: str, first_hand: int) -> None:
    uv = np.zeros((1, 1, count, 2))
    uv[..., 0] = np.arange(count)
    names = tuple(map(str, range(count)))
    found = of_body(Detections(uv, np.ones((1, 1, count)), names=names), layout)
    form = detector_table().layout(layout)
    assert found.uv_px.shape[2] == len(form)
    finger = next(i for i, point in enumerate(form.points) if "Forefinger1" in point)
    assert found.names is not None
    assert (found.uv_px[0, 0, finger, 0], found.names[finger]) == (first_hand, str(first_hand))
    assert of_body(found, layout) is found


def test_shipped_points_of_hands_are_those_of_their_makers() -> None:
    """Knuckles are the fifth, ninth, 13th and 17th points of a hand of 21."""
    for layout, first in (("coco_hands31", {133: (91, 112)}), ("halpe_hands34", {136: (94, 115), 68: (26, 47)})):
        form = detector_table().layout(layout)
        for count, at in form.whole:
            assert at[-8:] == tuple(hand + k for hand in first[count] for k in (5, 9, 13, 17))


def test_a_file_that_is_no_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("x = 1", encoding="utf-8")
    with pytest.raises(RtofError, match="a.toml"):
        read_layout(tmp_path / "a.toml")
    with pytest.raises(FileFormatError, match="there is no such file"):
        read_layout(tmp_path / "none.toml")
