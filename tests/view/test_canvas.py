"""Shapes cover the pixels that geometry says, also between pixels and at the border of the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtof_kin.view.canvas import Box, Canvas, Label, LabelLayout, Lettering, Stroke

WHITE, RED, BLUE = (255, 255, 255), (255, 0, 0), (0, 0, 255)


def black(width: int = 120, height: int = 100) -> Canvas:
    return Canvas(np.zeros((height, width, 3), dtype=np.uint8))


def coverage(canvas: Canvas) -> np.ndarray:
    return canvas.image[..., 0] / 255


coordinate = st.floats(20, 80)


@given(coordinate, coordinate, coordinate, coordinate, st.floats(0.8, 6))
@settings(max_examples=60, deadline=None)
def test_line_has_the_area_and_middle_of_a_capsule(ax: float, ay: float, bx: float, by: float, radius: float) -> None:
    canvas = black()
    canvas.line((ax, ay), (bx, by), Stroke(WHITE, radius))
    cover = coverage(canvas)
    length = np.hypot(bx - ax, by - ay)
    outline = 2 * length + 2 * np.pi * radius  # by a third of a pixel around it, which upright lines come near
    assert cover.sum() == pytest.approx(2 * radius * length + np.pi * radius**2, abs=0.35 * outline + 1)
    y, x = np.indices(cover.shape)
    middle = np.array([(cover * x).sum(), (cover * y).sum()]) / cover.sum()
    np.testing.assert_allclose(middle, [(ax + bx) / 2, (ay + by) / 2], atol=0.3)


def test_edge_surrounds_a_line_and_both_have_their_colours() -> None:
    canvas = black()
    canvas.line((20, 50), (100, 50), Stroke(RED, 3, BLUE, 2))
    assert tuple(canvas.image[50, 60, ::-1]) == RED
    assert tuple(canvas.image[54, 60, ::-1]) == tuple(canvas.image[46, 60, ::-1]) == BLUE
    assert not canvas.image[57, 60].any()
    assert not canvas.image[50, 110].any()


def test_ellipse_has_its_border_at_the_axes_of_its_matrix() -> None:
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    canvas = black()
    canvas.ellipse((60, 50), turn @ np.diag([30.0**2, 10.0**2]) @ turn.T, Stroke(WHITE, 1.0), 0.2)
    cover = coverage(canvas)
    for axis, length in ((turn[:, 0], 30), (turn[:, 1], 10)):
        for sign in (1, -1):
            at = np.round(np.array([60, 50]) + sign * length * axis).astype(int)
            assert cover[at[1], at[0]] > 0.6
            beyond = np.round(np.array([60, 50]) + sign * (length + 4) * axis).astype(int)
            assert cover[beyond[1], beyond[0]] == 0
    assert cover[50, 60] == pytest.approx(0.2, abs=0.01)


@given(st.floats(-300, 300), st.floats(-300, 300), st.floats(-300, 300), st.floats(-300, 300))
@settings(max_examples=30, deadline=None)
def test_what_lies_outside_is_cut_and_the_rest_is_as_in_a_larger_image(
    ax: float, ay: float, bx: float, by: float
) -> None:
    small, large = black(60, 40), black(760, 740)
    stroke = Stroke(WHITE, 2.5, RED, 1.0)
    small.line((ax, ay), (bx, by), stroke)
    large.line((ax + 350, ay + 350), (bx + 350, by + 350), stroke)
    apart = np.abs(small.image - large.image[350:390, 350:410].astype(int))
    assert (apart > 130).mean() < 0.01  # where a shape is cut, its anti-aliasing differs by a shade


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite_are_not_drawn(bad: float) -> None:
    canvas = black()
    stroke = Stroke(WHITE, 3)
    canvas.line((bad, 10), (20, 20), stroke)
    canvas.disc((10, bad), stroke)
    canvas.cross((bad, bad), 5, stroke)
    canvas.ellipse((50, 50), np.full((2, 2), bad), stroke, 0.5)
    canvas.ellipse((50, 50), 1e9 * np.eye(2), stroke, 0.5)  # larger than the image: no information
    assert not canvas.image.any()


def test_shade_and_stamp_blend_by_their_opacity() -> None:
    canvas = black()
    canvas.shade(Box(-10, -10, 30, 30), WHITE, 0.5)
    assert set(np.unique(canvas.image[:20, :20])) == {128}
    assert not canvas.image[20:, :].any()
    canvas.stamp(115, 95, np.full((20, 20), 0.25, dtype=np.float32), RED)
    assert tuple(canvas.image[99, 119, ::-1]) == (64, 0, 0)


def test_text_is_wrapped_within_its_width_and_nothing_is_lost_without_an_ellipsis() -> None:
    lettering = Lettering(14)
    text = "the sensor repeated one sample; it was left out, and so on to the end of the sentence"
    lines = lettering.wrap(text, 200, 20)
    assert " ".join(lines) == text
    assert all(lettering.width(line) <= 200 for line in lines)
    short = lettering.wrap(text, 200, 2)
    assert len(short) == 2
    assert short[-1].endswith("…")
    assert all(lettering.width(line) <= 200 for line in short)
    assert lettering.wrap("unbreakably" * 9, 100, 3)[0].endswith("…")
    assert lettering.mask("knee").max() == 1.0
    assert lettering.mask("knee").shape == (lettering.line_height, lettering.width("knee"))


PICTURE = Box(0, 40, 640, 400)
place = st.tuples(st.floats(0, 639), st.floats(40, 439), st.integers(40, 160), st.booleans())


def labels_at(places: list[tuple[float, float, int, bool]]) -> list[Label]:
    return [Label(f"angle {i}", x, y, width, 18, left) for i, (x, y, width, left) in enumerate(places)]


@given(st.lists(st.lists(place, max_size=12), min_size=1, max_size=4))
@settings(max_examples=150, deadline=None)
def test_no_label_overlaps_another_or_leaves_the_picture(frames: list[list[tuple[float, float, int, bool]]]) -> None:
    layout = LabelLayout()
    rng = np.random.default_rng(0)
    for places in frames:
        labels = labels_at(places)
        boxes = layout.place(labels, PICTURE, rng.uniform(0, 600, (50, 2)))
        covered = np.zeros((PICTURE.bottom, PICTURE.right), dtype=int)
        for box in boxes.values():
            assert min(box.left - PICTURE.left, box.top - PICTURE.top) >= 0
            covered[box.top : box.bottom, box.left : box.right] += 1
        assert covered.sum() == sum(box.width * box.height for box in boxes.values())  # inside at right and below
        assert covered.max(initial=0) <= 1
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
