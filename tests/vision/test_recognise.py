"""Layouts are recognised by names or geometry, never by their number of points alone."""

from __future__ import annotations

import numpy as np
import pytest
from detector_support import LAYOUTS, points_px, walking, watching
from numpy.typing import NDArray

from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.vision.landmark_regression import recognise
from rtof_kin.vision.layouts import detector_table

Array = NDArray[np.float64]
EVERY = (*LAYOUTS, "joints", "landmarks")


@pytest.fixture(scope="module")
def seen() -> dict[str, tuple[Array, Array]]:
    """Noisy points, an eighth of them undetected, in every layout."""
    motion, rng = walking(), np.random.default_rng(0)
    out = {}
    for layout in EVERY:
        uv = points_px(layout, motion, watching(motion))
        confidence = np.where(rng.random(uv.shape[:2]) < 0.125, 0.0, 0.7)
        out[layout] = uv + 5 * rng.normal(size=uv.shape), confidence
    return out


@pytest.mark.parametrize("layout", EVERY)
@pytest.mark.parametrize("frames", [slice(0, 1), slice(None)])
def test_a_layout_is_recognised_by_geometry(layout: str, frames: slice, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = (array[frames] for array in seen[layout])
    found = recognise(uv, confidence)
    assert found.layout.name == layout
    assert "confirmed by geometry (misfit" in found.reason
    assert found.order == tuple(range(uv.shape[1]))
    assert recognise(uv, confidence, layout=layout).layout.name == layout


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_turned_videos_are_recognised(quarter: int, seen: dict[str, tuple[Array, Array]]) -> None:
    c, s = [(0, 1), (-1, 0), (0, -1)][quarter - 1]
    for layout in ("coco17", "human36m17", "body25b"):
        uv, confidence = seen[layout]
        assert recognise(uv @ np.array([[c, -s], [s, c]]), confidence).layout.name == layout


@pytest.mark.parametrize(
    "named, is_",
    [
        ("body25", "body25b"),
        ("coco17", "human36m17"),
        ("mediapipe33", "landmarks"),
        ("body25b", "body25"),
        ("human36m17", "coco17"),
    ],
)
def test_another_layout_with_as_many_points_is_refused(
    named: str, is_: str, seen: dict[str, tuple[Array, Array]]
) -> None:
    with pytest.raises(InvalidInputError, match=f"layout {named}: .* as those of {is_}"):
        recognise(*seen[is_], layout=named)


def test_a_wrong_number_of_points_is_refused(seen: dict[str, tuple[Array, Array]]) -> None:
    with pytest.raises(InvalidInputError, match=r"halpe26 has 26 points.* 25 .*body25, body25b"):
        recognise(*seen["body25"], layout="halpe26")
    uv, confidence = seen["halpe26"]
    with pytest.raises(InvalidInputError, match=r"no layout has 24 points; known: body25 \(25\)"):
        recognise(uv[:, :24], confidence[:, :24])
    with pytest.raises(UnknownNameError, match="'openpose'"):
        recognise(uv, confidence, layout="openpose")


@pytest.mark.parametrize("layout", ["body25", "coco17", "halpe26", "joints"])
@pytest.mark.parametrize("named", [False, True])
def test_a_wrong_order_of_points_is_refused(layout: str, named: bool, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = seen[layout]
    order = np.random.default_rng(1).permutation(uv.shape[1])
    with pytest.raises(InvalidInputError, match="check their order"):
        recognise(uv[:, order], confidence[:, order], layout=layout if named else None)
    with pytest.raises(InvalidInputError, match="check their order"):
        recognise(np.random.default_rng(0).uniform(0, 1000, uv.shape), np.ones(uv.shape[:2]))


def test_names_determine_layout_and_order(seen: dict[str, tuple[Array, Array]]) -> None:
    uv, confidence = seen["halpe26"]
    names = detector_table().layout("halpe26").names  # the first 17 are COCO's
    order = np.random.default_rng(1).permutation(26)
    found = recognise(uv[:, order], confidence[:, order], [names[i] for i in order])
    assert found.layout.name == "halpe26"
    assert "26 points are named" in found.reason
    np.testing.assert_array_equal(order[list(found.order)], np.arange(26))
    found = recognise(uv, confidence, names, layout="coco17")
    assert found.layout.name == "coco17"
    assert found.order == tuple(range(17))


def test_names_of_another_layout_are_refused(seen: dict[str, tuple[Array, Array]]) -> None:
    names = detector_table().layout("body25").names
    with pytest.raises(InvalidInputError, match=r"body25b: .* named Nose, Neck.*no UpperNeck"):
        recognise(*seen["body25b"], names, layout="body25b")
    with pytest.raises(InvalidInputError, match=r"named a, b, c,.* known: body25,"):
        recognise(np.zeros((1, 3, 2)), np.ones((1, 3)), ["a", "b", "c"])


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_detected_points_are_refused(count: int, seen: dict[str, tuple[Array, Array]]) -> None:
    uv, _ = seen["coco17"]
    confidence = np.where(np.arange(17) < count, 0.9, 0.0) * np.ones(uv.shape[:2])
    with pytest.raises(InvalidInputError, match=f"more than {count} of 17 points"):
        recognise(uv, confidence)
