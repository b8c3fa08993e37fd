"""Labels stay in the picture and never lie on each other."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rtof_kin.view.canvas import Box, Label, LabelLayout

PICTURE = Box(0, 40, 640, 400)
place = st.tuples(st.floats(0, 639), st.floats(40, 439), st.integers(40, 160), st.booleans())


def labels_at(places: list[tuple[float, float, int, bool]]) -> list[Label]:
    return [Label(f"angle {i}", x, y, width, 18, left) for i, (x, y, width, left) in enumerate(places)]


@given(st.lists(st.lists(place, max_size=12), min_size=1, max_size=4), st.lists(place, max_size=3))
@settings(max_examples=150, deadline=None)
def test_no_label_overlaps_another_or_leaves_the_picture(
    frames: list[list[tuple[float, float, int, bool]]], kept: list[tuple[float, float, int, bool]]
) -> None:
    layout = LabelLayout()
    taken = [Box(int(x), int(y), width, 20) for x, y, width, _ in kept]
    rng = np.random.default_rng(0)
    for places in frames:
        labels = labels_at(places)
        boxes = layout.place(labels, PICTURE, rng.uniform(0, 600, (50, 2)), taken)
        for box in boxes.values():
            assert box.inside(PICTURE)
        for a, b in itertools.combinations([*boxes.values(), *taken[:0]], 2):
            assert not a.overlaps(b)
        assert not any(box.overlaps(other) for box in boxes.values() for other in taken)
        assert {(label.width, label.height) for label in labels if label.name in boxes} == {
            (box.width, box.height) for box in boxes.values()
        }


@given(st.floats(0, 639), st.floats(40, 439))
@settings(max_examples=60, deadline=None)
def test_a_single_label_always_finds_a_place_near_its_point(x: float, y: float) -> None:
    (box,) = LabelLayout().place([Label("knee", x, y, 120, 18)], PICTURE).values()
    nearest = np.clip([x, y], [box.left, box.top], [box.right, box.bottom])
    assert np.hypot(*(nearest - [x, y])) < 80


def test_a_label_keeps_its_place_while_its_point_moves_little() -> None:
    layout = LabelLayout()
    other = Label("hip", 300.0, 200.0, 100, 18)
    first = layout.place([other, Label("knee", 310.0, 205.0, 100, 18)], PICTURE)["knee"]
    alone = layout.place([Label("knee", 312.0, 205.0, 100, 18)], PICTURE)["knee"]
    assert (alone.left, alone.top) == (first.left + 2, first.top)


def test_points_are_covered_only_where_there_is_no_other_room() -> None:
    wall = np.array([[x, y] for x in range(320, 420, 4) for y in range(100, 300, 4)], dtype=float)
    box = LabelLayout().place([Label("knee", 310.0, 200.0, 90, 18)], PICTURE, wall)["knee"]
    assert box.right <= 320
    narrow = Box(300, 180, 140, 40)
    assert "knee" in LabelLayout().place([Label("knee", 310.0, 200.0, 90, 18)], narrow, wall)


def test_labels_without_room_are_left_out() -> None:
    crowd = labels_at([(100.0, 60.0, 90, False)] * 30)
    boxes = LabelLayout().place(crowd, Box(0, 40, 300, 60))
    assert 0 < len(boxes) < 30
    assert not LabelLayout().place(crowd, Box(0, 40, 50, 10))


def test_a_label_at_the_edge_does_not_stand_beside_the_point_of_another_one() -> None:
    knees = [Label("L knee", 140.0, 220.0, 90, 18), Label("R knee", 80.0, 200.0, 90, 18, True)]
    boxes = LabelLayout().place(knees, PICTURE)

    def distance(name: str, other: Label) -> float:
        box = boxes[name]
        nearest = np.clip([other.x, other.y], [box.left, box.top], [box.right, box.bottom])
        return float(np.hypot(*(nearest - [other.x, other.y])))

    for own, other in (knees, knees[::-1]):
        assert distance(own.name, own) < distance(own.name, other)
