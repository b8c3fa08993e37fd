"""Validation of arrays and names, and the messages of errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtof_kin.core.array_types import blocks_of
from rtof_kin.core.checks import checked_times, indices_of, readonly, shared
from rtof_kin.core.errors import InvalidInputError, ShapeError, UnknownNameError


def test_readonly_copies_and_locks() -> None:
    mine = np.zeros((2, 3))
    locked = readonly("x", mine, ("T", 3))
    mine[0, 0] = 5
    assert locked[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        locked[0, 0] = 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 4)), r"x: expected shape \(T, 3\), got \(2, 4\)"),
        (np.zeros(3), r"x: expected shape \(T, 3\), got \(3,\)"),
        ([[1, 2, 3], [1, 2]], "x: not an array of numbers"),
        ([[None, {}, 1]], "x: not an array of numbers"),
    ],
)
def test_array_of_another_shape_or_kind_is_refused_by_name(value: Any, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        readonly("x", value, ("T", 3))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([], "t: empty"),
        ([0.0, np.nan, 1.0], "t: not finite at index 1"),
        ([0.0, 0.5, 0.5], r"t: time does not increase from index 1 \(0.5 s\) to 2 \(0.5 s\); sort"),
        ([0.0, 2.0, 1.0, 3.0], r"from index 1 \(2 s\) to 2 \(1 s\)"),
        ([[0.0, 1.0]], r"t: expected shape \(T\), got \(1, 2\)"),
    ],
)
def test_times_must_increase(times: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        checked_times("t", times)


def test_unknown_name_is_reported_with_valid_names_and_the_nearest_one() -> None:
    assert indices_of("joint", ["Head", "Hips"], ("Hips", "Head")) == [1, 0]
    with pytest.raises(UnknownNameError) as caught:
        indices_of("joint", ["Hips", "Hedd", "tail"], ("Hips", "Head"))
    assert str(caught.value) == "unknown joint 'Hedd', 'tail'. Did you mean 'Head'? Known: Hips, Head"


def test_shared_arrays_are_kept_without_a_copy() -> None:
    (mine,) = shared(np.zeros((4, 3)))
    assert readonly("x", mine, ("T", 3)) is mine
    assert np.shares_memory(readonly("x", mine[:, None], (4, 1, 3)), mine)
    part = readonly("x", mine[:2], (2, 3))
    assert not np.shares_memory(part, mine)  # it would keep the whole
    assert not np.shares_memory(readonly("x", part.view(), (2, 3)), mine)
    view = np.zeros((4, 3))[:, :]
    view.setflags(write=False)
    assert not np.shares_memory(readonly("x", view, ("T", 3)), view)  # its whole can be written to
    with pytest.raises(ValueError, match="read-only"):
        mine[0] = 1.0


@pytest.mark.parametrize("count", [0, 1, 3, 4, 9])
def test_blocks_follow_one_another_and_cover_all(count: int) -> None:
    blocks = list(blocks_of(count, 3))
    assert [i for block in blocks for i in range(*block.indices(count))] == list(range(count))
    assert all(0 < block.stop - block.start <= 3 for block in blocks)
