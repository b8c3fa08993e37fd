"""Anti-aliased drawing on an image, in place: lines, discs, ellipses, boxes and text.

The coverage of a pixel follows from its distance to the shape, so that shapes lie exactly where they are
asked for, also between pixels. The centre of the first pixel is (0, 0), as in OpenCV's cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.view.provenance_colours import Rgb

Image = NDArray[np.uint8]
Coverage = NDArray[np.float32]
_POINT: Final = 1e-9
"""Length below which a line is a disc, px."""


@dataclass(frozen=True)
class Stroke:
    """How a line or disc is drawn."""

    colour: Rgb
    radius: float
    """Half width, px."""
    edge: Rgb | None = None
    """Colour of the edge around it; None for no edge."""
    edge_width: float = 0.0
    """Width of that edge, px."""


@dataclass(frozen=True)
class Box:
    """A rectangle of whole pixels."""

    left: int
    top: int
    width: int
    height: int

    @property
    def right(self) -> int:
        """First column right of it."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """First row below it."""
        return self.top + self.height

    def overlaps(self, other: Box) -> bool:
        """Return whether two boxes share a pixel."""
        return (
            self.left < other.right and other.left < self.right and self.top < other.bottom and other.top < self.bottom
        )

    def inside(self, other: Box) -> bool:
        """Return whether no pixel lies outside another box."""
        return (
            self.left >= other.left
            and self.top >= other.top
            and self.right <= other.right
            and self.bottom <= other.bottom
        )


class Canvas:
    """An image that is drawn on; what lies outside of it is cut."""

    def __init__(self, image: Image):
        """Take the image (height, width, 3), BGR, that is changed."""
        self.image = image

    @property
    def box(self) -> Box:
        """The whole image."""
        return Box(0, 0, self.image.shape[1], self.image.shape[0])

    def line(self, start: Sequence[float] | Array, end: Sequence[float] | Array, stroke: Stroke) -> None:
        """Draw a line with round ends; nothing if an end is not finite.

        Args:
            start, end: (2,) px.
        """
        (ax, ay), (bx, by) = map(float, start), map(float, end)
        margin = stroke.radius + stroke.edge_width + 1
        grid = self._grid(min(ax, bx), min(ay, by), max(ax, bx), max(ay, by), margin)
        if grid is None:
            return
        x, y, patch = grid
        x, y, length = x - ax, y - ay, math.hypot(bx - ax, by - ay)
        if length < _POINT:
            _fill(patch, x * x + y * y, stroke)
            return
        ux, uy = (bx - ax) / length, (by - ay) / length
        along, across = x * ux + y * uy, y * ux - x * uy
        along -= np.minimum(np.maximum(along, 0), length)
        _fill(patch, along * along + across * across, stroke)

    def disc(self, centre: Sequence[float] | Array, stroke: Stroke) -> None:
        """Draw a disc; nothing if its centre is not finite.

        Args:
            centre: (2,) px. stroke: how; its radius is the disc's.
        """
        self.line(centre, centre, stroke)

    def cross(self, centre: Sequence[float] | Array, arm: float, stroke: Stroke) -> None:
        """Draw a diagonal cross.

        Args:
            centre: (2,) px. arm: half its width, px.
        """
        x, y = map(float, centre)
        for rise in (arm, -arm):
            self.line((x - arm, y - rise), (x + arm, y + rise), stroke)

    def ellipse(self, centre: Sequence[float] | Array, shape: Array, stroke: Stroke, fill: float) -> None:
        """Draw an ellipse with a translucent interior; nothing if it is not finite or larger than the image.

        Args:
            centre: (2,) px. shape: (2, 2) px^2, the matrix S of the border ``d^T S^-1 d = 1``.
            fill: opacity of the interior, 0 to 1.
        """
        cx, cy = map(float, centre)
        if not np.isfinite(shape).all():
            return
        values, vectors = np.linalg.eigh(shape + 0.25 * np.eye(2))  # not thinner than a pixel
        axes = np.sqrt(np.maximum(values, 0.25))
        if axes.max() > 2 * max(self.image.shape):
            return
        reach = np.sqrt((axes**2 * vectors**2).sum(axis=1))
        left, top, right, bottom = cx - reach[0], cy - reach[1], cx + reach[0], cy + reach[1]
        grid = self._grid(left, top, right, bottom, stroke.radius + 1)
        if grid is None:
            return
        x, y, patch = grid
        x, y = x - cx, y - cy
        u, v = (float(vectors[0, k] / axes[k]) * x + float(vectors[1, k] / axes[k]) * y for k in (0, 1))
        level = np.sqrt(u * u + v * v)
        slope = np.sqrt((u / axes[0]) ** 2 + (v / axes[1]) ** 2) / np.maximum(level, 1e-6)
        distance = (level - 1) / np.maximum(slope, 1e-6)
        inside = np.clip(0.5 - distance, 0, 1) * fill
        border = np.clip(stroke.radius + 0.5 - np.abs(distance), 0, 1)
        _blend(patch, np.maximum(inside, border).astype(np.float32), stroke.colour)

    def shade(self, box: Box, colour: Rgb, opacity: float) -> None:
        """Cover a box with a translucent colour.

        Args:
            opacity: 0 to 1.
        """
        patch = self.image[max(box.top, 0) : max(box.bottom, 0), max(box.left, 0) : max(box.right, 0)]
        levels = np.arange(256)[:, None] * (1 - opacity) + np.array(colour[::-1]) * opacity + 0.5
        for channel in range(3):
            patch[..., channel] = np.take(levels[:, channel].astype(np.uint8), patch[..., channel])

    def stamp(self, left: int, top: int, coverage: Coverage, colour: Rgb) -> None:
        """Blend a colour where a mask says so.

        Args:
            left, top: where the mask's first pixel lies, px. coverage: (h, w), 0 to 1.
        """
        height, width = coverage.shape
        x, y = max(left, 0), max(top, 0)
        patch = self.image[y : max(top + height, 0), x : max(left + width, 0)]
        cut = coverage[y - top : y - top + patch.shape[0], x - left : x - left + patch.shape[1]]
        _blend(patch, cut, colour)

    def _grid(
        self, left: float, top: float, right: float, bottom: float, margin: float
    ) -> tuple[Any, Any, Image] | None:
        """Return columns (w,), rows (h, 1) and the part of the image around a box; None if empty or NaN."""
        if not math.isfinite(left + top + right + bottom):
            return None
        height, width = self.image.shape[:2]
        x0, y0 = max(math.floor(left - margin), 0), max(math.floor(top - margin), 0)
        x1, y1 = min(math.ceil(right + margin) + 1, width), min(math.ceil(bottom + margin) + 1, height)
        if x1 <= x0 or y1 <= y0:
            return None
        x = np.arange(x0, x1, dtype=np.float32)
        y = np.arange(y0, y1, dtype=np.float32)[:, None]
        return x, y, self.image[y0:y1, x0:x1]


def _fill(patch: Image, squared: Any, stroke: Stroke) -> None:
    """Blend a stroke by each pixel's squared distance from its middle, px^2."""
    edge_width = stroke.edge_width if stroke.edge is not None else 0.0
    reach = stroke.radius + edge_width + 0.5
    where = np.nonzero(squared < reach * reach)
    near = np.sqrt(squared[where])[:, None]
    pixels = patch[where].astype(np.float32)
    if stroke.edge is not None:
        pixels += np.minimum(reach - near, 1) * (_bgr(stroke.edge) - pixels)
    inner = np.minimum(np.maximum(stroke.radius + 0.5 - near, 0), 1)
    pixels += inner * (_bgr(stroke.colour) - pixels)
    patch[where] = pixels + 0.5


@cache
def _bgr(colour: Rgb) -> NDArray[np.float32]:
    return np.array(colour[::-1], dtype=np.float32)


def _blend(patch: Image, coverage: Coverage, colour: Rgb) -> None:
    where = np.nonzero(coverage > 0)
    pixels = patch[where].astype(np.float32)
    pixels += coverage[where][:, None] * (_bgr(colour) - pixels)
    patch[where] = pixels + 0.5
