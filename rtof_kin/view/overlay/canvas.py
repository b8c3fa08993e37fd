"""Anti-aliased drawing on an image, in place: lines, discs, ellipses, boxes and text.

The coverage of a pixel follows from its distance to the shape, so that shapes lie exactly where they are
asked for, also between pixels. The centre of the first pixel is (0, 0), as in OpenCV's cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.view.provenance_colours import Rgb

Image = NDArray[np.uint8]
Coverage = NDArray[np.float32]


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
    dash: float | None = None
    """Length of dashes and half of their gaps, px; None for a solid line."""


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
        """Return whether two boxes share a pixel.

        Args:
            other: the other one.
        """
        return (
            self.left < other.right
            and other.left < self.right
            and self.top < other.bottom
            and other.top < self.bottom
        )

    def inside(self, other: Box) -> bool:
        """Return whether no pixel lies outside another box.

        Args:
            other: the other one.
        """
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

    def line(self, start: ArrayLike, end: ArrayLike, stroke: Stroke) -> None:
        """Draw a line with round ends; nothing if an end is not finite.

        Args:
            start, end: (2,) px. stroke: how.
        """
        a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        grid = self._grid(np.stack([a, b]), stroke.radius + stroke.edge_width + 1)
        if grid is None:
            return
        x, y, patch = grid
        length = float(np.hypot(*(b - a)))
        ux, uy = (b - a) / length if length > 1e-9 else (1.0, 0.0)
        along = np.float32(ux) * (x - a[0]) + np.float32(uy) * (y - a[1])
        across = np.float32(ux) * (y - a[1]) - np.float32(uy) * (x - a[0])
        nearest = np.clip(along, 0, length)
        if stroke.dash is not None:
            nearest = _nearest_dash(along, length, stroke.dash)
        _fill(patch, np.hypot(along - nearest, across), stroke)

    def disc(self, centre: ArrayLike, stroke: Stroke) -> None:
        """Draw a disc; nothing if its centre is not finite.

        Args:
            centre: (2,) px. stroke: how; its radius is the disc's.
        """
        self.line(centre, centre, stroke)

    def cross(self, centre: ArrayLike, arm: float, stroke: Stroke) -> None:
        """Draw a diagonal cross.

        Args:
            centre: (2,) px. arm: half its width, px. stroke: of its lines.
        """
        c = np.asarray(centre, dtype=float)
        for direction in ((arm, arm), (arm, -arm)):
            self.line(c - direction, c + direction, stroke)

    def ellipse(self, centre: ArrayLike, shape: Array, stroke: Stroke, fill: float) -> None:
        """Draw an ellipse with a translucent interior; nothing if it is not finite or larger than the image.

        Args:
            centre: (2,) px. shape: (2, 2) px^2, the matrix S of the border ``d^T S^-1 d = 1``.
            stroke: of the border. fill: opacity of the interior, 0 to 1.
        """
        c = np.asarray(centre, dtype=float)
        if not np.isfinite(shape).all():
            return
        values, vectors = np.linalg.eigh(shape + 0.25 * np.eye(2))  # not thinner than a pixel
        axes = np.sqrt(np.maximum(values, 0.25))
        if axes.max() > 2 * max(self.image.shape):
            return
        reach = np.sqrt((axes**2 * vectors**2).sum(axis=1))
        grid = self._grid(np.stack([c - reach, c + reach]), stroke.radius + 1)
        if grid is None:
            return
        x, y, patch = grid
        u, v = (
            (np.float32(vectors[0, k] / axes[k]) * (x - c[0]) + np.float32(vectors[1, k] / axes[k]) * (y - c[1]))
            for k in (0, 1)
        )
        level = np.sqrt(u * u + v * v)
        slope = np.sqrt((u / axes[0]) ** 2 + (v / axes[1]) ** 2) / np.maximum(level, 1e-6)
        distance = (level - 1) / np.maximum(slope, 1e-6)
        inside = np.clip(0.5 - distance, 0, 1) * fill
        border = np.clip(stroke.radius + 0.5 - np.abs(distance), 0, 1)
        _blend(patch, np.maximum(inside, border).astype(np.float32), stroke.colour)

    def shade(self, box: Box, colour: Rgb, opacity: float) -> None:
        """Cover a box with a translucent colour.

        Args:
            box: to be covered. colour: of the cover. opacity: 0 to 1.
        """
        patch = self.image[max(box.top, 0) : max(box.bottom, 0), max(box.left, 0) : max(box.right, 0)]
        levels = np.arange(256)[:, None] * (1 - opacity) + np.array(colour[::-1]) * opacity + 0.5
        for channel in range(3):
            patch[..., channel] = np.take(levels[:, channel].astype(np.uint8), patch[..., channel])

    def stamp(self, left: int, top: int, coverage: Coverage, colour: Rgb) -> None:
        """Blend a colour where a mask says so.

        Args:
            left, top: where the mask's first pixel lies, px. coverage: (h, w), 0 to 1. colour: RGB.
        """
        height, width = coverage.shape
        x, y = max(left, 0), max(top, 0)
        patch = self.image[y : max(top + height, 0), x : max(left + width, 0)]
        cut = coverage[y - top : y - top + patch.shape[0], x - left : x - left + patch.shape[1]]
        _blend(patch, cut, colour)

    def _grid(self, corners: Array, margin: float) -> tuple[Any, Any, Image] | None:
        """Return columns (w,), rows (h, 1) and the part of the image around some points; None if empty."""
        if not np.isfinite(corners).all():
            return None
        height, width = self.image.shape[:2]
        left, top = np.floor(np.clip(corners.min(axis=0) - margin, 0, (width, height))).astype(int)
        right, bottom = np.ceil(np.clip(corners.max(axis=0) + margin + 1, 0, (width, height))).astype(int)
        if right <= left or bottom <= top:
            return None
        x = np.arange(left, right, dtype=np.float32)
        y = np.arange(top, bottom, dtype=np.float32)[:, None]
        return x, y, self.image[top:bottom, left:right]


def _nearest_dash(along: Any, length: float, dash: float) -> Any:
    """Return the coordinate along a line of the nearest point of its dashes."""
    period = 1.5 * dash
    last = max(int((length - dash / 2) // period), 0)
    number = np.clip(np.round((along - dash / 2) / period), 0, last)
    start = number * np.float32(period)
    return np.clip(along, start, np.minimum(start + dash, length))


def _fill(patch: Image, distance: Any, stroke: Stroke) -> None:
    """Blend a stroke by each pixel's distance from its middle, px."""
    edge_width = stroke.edge_width if stroke.edge is not None else 0.0
    where = np.nonzero(distance < stroke.radius + edge_width + 0.5)
    near = distance[where][:, None]
    inner = np.clip(stroke.radius + 0.5 - near, 0, 1)
    outer = np.clip(stroke.radius + edge_width + 0.5 - near, 0, 1)
    pixels = patch[where].astype(np.float32)
    fill = np.array(stroke.colour[::-1], dtype=np.float32)
    edge = fill if stroke.edge is None else np.array(stroke.edge[::-1], dtype=np.float32)
    pixels += outer * (edge - pixels)
    patch[where] = pixels + inner * (fill - pixels) + 0.5


def _blend(patch: Image, coverage: Coverage, colour: Rgb) -> None:
    where = np.nonzero(coverage > 0)
    pixels = patch[where].astype(np.float32)
    pixels += coverage[where][:, None] * (np.array(colour[::-1], dtype=np.float32) - pixels)
    patch[where] = pixels + 0.5
