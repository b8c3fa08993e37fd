"""Shapes cover the pixels that geometry says, also between pixels and at the border of the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtof_kin.view.canvas import Box, Canvas, Lettering, Stroke

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
    area = 2 * radius * np.hypot(bx - ax, by - ay) + np.pi * radius**2
    assert cover.sum() == pytest.approx(area, rel=0.12, abs=1.0)
    y, x = np.indices(cover.shape)
    middle = np.array([(cover * x).sum(), (cover * y).sum()]) / cover.sum()
    np.testing.assert_allclose(middle, [(ax + bx) / 2, (ay + by) / 2], atol=0.3)


def test_edge_surrounds_a_line_and_both_have_their_colours() -> None:
    canvas = black()
    canvas.line((20, 50), (100, 50), Stroke(RED, 3, BLUE, 2))
    assert tuple(canvas.image[50, 60, ::-1]) == RED
    assert tuple(canvas.image[54, 60, ::-1]) == BLUE
    assert tuple(canvas.image[46, 60, ::-1]) == BLUE
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
@settings(max_examples=60, deadline=None)
def test_what_lies_outside_is_cut_and_the_rest_is_as_in_a_larger_image(
    ax: float, ay: float, bx: float, by: float
) -> None:
    small, large = black(60, 40), black(760, 740)
    stroke = Stroke(WHITE, 2.5, RED, 1.0)
    small.line((ax, ay), (bx, by), stroke)
    large.line((ax + 350, ay + 350), (bx + 350, by + 350), stroke)
    part = large.image[350:390, 350:410].astype(int)
    np.testing.assert_allclose(small.image, part, atol=2)


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
