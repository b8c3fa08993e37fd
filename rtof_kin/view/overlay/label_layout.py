"""Places of labels beside points of a picture: inside of it, and never on each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.view.overlay.canvas import Box

Offset = tuple[int, int]
_DISTANCES: Final = (1.0, 1.7, 2.6, 4.0, 6.0)
"""Distances of a label from its point that are tried, in heights of a line."""
_HEIGHTS: Final = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)
"""Vertical displacements that are tried, in heights of a line."""
_TOLERATED: Final = 2
"""Points that a label may cover before it leaves its place."""
_MISTAKEN: Final = 3
"""Points that a label rather covers than to stand nearer to the point of another label than to its own."""
_NOTHING: Final = np.zeros((0, 2))


@dataclass(frozen=True)
class Label:
    """A label that is to be placed."""

    name: str
    """Of the label, the same in every frame."""
    x: float
    """Column of its point, px."""
    y: float
    """Row of its point, px."""
    width: int
    """px."""
    height: int
    """px."""
    leftwards: bool = False
    """Whether the left of the point is preferred."""


@dataclass
class LabelLayout:
    """Places labels frame by frame; a label keeps its place beside its point while it can."""

    _last: dict[str, Offset] = field(default_factory=dict)

    def place(
        self, labels: Sequence[Label], picture: Box, avoided: Array = _NOTHING, taken: Sequence[Box] = ()
    ) -> dict[str, Box]:
        """Return a box for each label; a label for which there is no room is left out.

        Args:
            avoided: (n, 2) px, points that are covered only where there is no other room. taken: boxes to keep free.
        """
        used = list(taken)
        out: dict[str, Box] = {}
        for label in labels:
            others = np.array([(one.x, one.y) for one in labels if one is not label]).reshape(-1, 2)
            found = self._best(label, picture, avoided, used, others)
            if found is not None:
                self._last[label.name], out[label.name] = found
                used.append(found[1])
        return out

    def _best(
        self, label: Label, picture: Box, avoided: Array, used: Sequence[Box], others: Array
    ) -> tuple[Offset, Box] | None:
        """Return the place of a label that covers the fewest points and is nearest to its own; the last one
        while it covers few.
        """
        last = self._last.get(label.name)
        best: tuple[Offset, Box] | None = None
        fewest = len(avoided) + _MISTAKEN + 1
        for offset in _offsets(label, last):
            left = min(max(round(label.x) + offset[0], picture.left), picture.right - label.width)
            box = Box(left, round(label.y) + offset[1], label.width, label.height)
            if not box.inside(picture) or any(map(box.overlaps, used)):
                continue
            covered = _covered(box, avoided) + _MISTAKEN * _mistaken(label, box, others, offset == last)
            if covered == 0 or (offset == last and covered <= _TOLERATED):
                return offset, box
            if covered < fewest:
                best, fewest = (offset, box), covered
        return best


def _covered(box: Box, points: Array) -> int:
    """Return the number of points (n, 2) in a box; NaN is in none."""
    u, v = points.T
    inside = (u >= box.left) & (u < box.right) & (v >= box.top) & (v < box.bottom)
    return int(np.count_nonzero(inside))


def _mistaken(label: Label, box: Box, others: Array, kept: bool) -> bool:
    """Return whether a label seems to be that of another point (n, 2); if kept, only where this is clear."""
    own = _distance(box, np.array([[label.x, label.y]]))[0]
    return bool((_distance(box, others) < (0.5 if kept else 1.0) * own).any())


def _distance(box: Box, points: Array) -> Array:
    """Return the distances (n,) px of points (n, 2) from a box; 0 inside."""
    u, v = points.T
    across = np.maximum(np.maximum(box.left - u, u - box.right), 0.0)
    down = np.maximum(np.maximum(box.top - v, v - box.bottom), 0.0)
    out: Array = np.hypot(across, down)
    return out


def _offsets(label: Label, last: Offset | None) -> Iterator[Offset]:
    """Generate offsets of a label's corner from its point, the best first."""
    if last is not None:
        yield last
    sides = (-1, 1) if label.leftwards else (1, -1)
    for distance in _DISTANCES:
        for side in sides:
            dx = round(distance * label.height)
            x = dx if side > 0 else -dx - label.width
            for rise in _HEIGHTS:
                yield x, round((rise * 1.1 - 0.5) * label.height)
    for rise in (1.5, -2.5, 3.0, -4.0):
        yield -label.width // 2, round(rise * label.height)
