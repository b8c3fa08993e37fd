"""Places of labels beside points of a picture: inside of it, and never on each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from rtof_kin.view.overlay.canvas import Box

Offset = tuple[int, int]
_DISTANCES: Final = (1.0, 1.7, 2.6, 4.0, 6.0)
"""Distances of a label from its point that are tried, in heights of a line."""
_HEIGHTS: Final = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)
"""Vertical displacements that are tried, in heights of a line."""


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

    def place(self, labels: Sequence[Label], picture: Box, taken: Sequence[Box] = ()) -> dict[str, Box]:
        """Return a box for each label; a label for which there is no room is left out.

        Args:
            labels: in the order of importance. picture: that they stay in. taken: boxes to keep free.
        """
        used = list(taken)
        out: dict[str, Box] = {}
        for label in labels:
            for offset in _offsets(label, self._last.get(label.name)):
                box = Box(
                    round(label.x) + offset[0], round(label.y) + offset[1], label.width, label.height
                )
                if box.inside(picture) and not any(map(box.overlaps, used)):
                    self._last[label.name] = offset
                    used.append(box)
                    out[label.name] = box
                    break
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
