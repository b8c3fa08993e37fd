"""Anti-aliased drawing on an image, in place: lines, discs, ellipses, boxes and text, and room for labels.

Shapes are polygons with corners between pixels, filled by OpenCV; text is Pillow's. The centre of the first pixel is
(0, 0), as in OpenCV's cameras.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.packages import optional
from rtof_kin.data.poses import Rgb

Image = NDArray[np.uint8]
Coverage = NDArray[np.float32]
Offset = tuple[int, int]
_SHIFT: Final = 5  # Binary digits of a corner's place between pixels
_FARTHEST_PX: Final = 1e6  # Corners farther away are drawn there, within OpenCV's integers
_GROWN_PX: Final = 0.64  # By which OpenCV's anti-aliased polygons are larger than their corners say
_AROUND: Final = np.linspace(0, 2 * np.pi, 49)[:-1]
_MORE: Final = " …"
_DISTANCES: Final = (1.0, 1.7, 2.6, 4.0, 6.0)
"""Distances of a label from its point that are tried, in heights of a line."""
_HEIGHTS: Final = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)  # Vertical displacements that are tried, in heights of a line
_TOLERATED: Final = 2  # Points that a label may cover before it leaves its place
_MISTAKEN: Final = 3
"""Points that a label rather covers than to stand nearer to the point of another label than to its own."""
_NOTHING: Final = np.zeros((0, 2))


@dataclass(frozen=True)
class Stroke:
    """How a line or disc is drawn."""

    colour: Rgb
    radius: float  #: Half width, px
    edge: Rgb | None = None  #: Colour of the edge around it; None for no edge
    edge_width: float = 0.0  #: Width of that edge, px


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


class Canvas:
    """An image that is drawn on; what lies outside of it is cut."""

    def __init__(self, image: Image):
        self.image, self._cv2 = image, optional("cv2", "view", "drawing on a video")

    @property
    def box(self) -> Box:
        """The whole image."""
        return Box(0, 0, self.image.shape[1], self.image.shape[0])

    def line(self, start: Sequence[float] | Array, end: Sequence[float] | Array, stroke: Stroke) -> None:
        """Draw a line with round ends; nothing if an end is not finite. `start`, `end`: (2,) px."""
        ends = np.array([start, end], dtype=float)
        if not np.isfinite(ends).all():
            return
        along = np.subtract(*ends[::-1])
        turned = _AROUND + math.atan2(along[1], along[0]) - np.pi / 2
        circle = np.column_stack([np.cos(turned), np.sin(turned)])
        half = np.repeat(ends[::-1], len(circle) // 2, axis=0)  # first the half circle about the end
        if stroke.edge is not None and stroke.edge_width > 0:
            self._fill(half + max(stroke.radius + stroke.edge_width - _GROWN_PX, 0.0) * circle, stroke.edge)
        self._fill(half + max(stroke.radius - _GROWN_PX, 0.0) * circle, stroke.colour)

    def disc(self, centre: Sequence[float] | Array, stroke: Stroke) -> None:
        """Draw a disc; nothing where `centre`, (2,) px, is not finite. stroke: how; its radius is the disc's."""
        self.line(centre, centre, stroke)

    def cross(self, centre: Sequence[float] | Array, arm: float, stroke: Stroke) -> None:
        """Draw a diagonal cross. `centre`: (2,) px. `arm`: half its width, px."""
        x, y = map(float, centre)
        for rise in (arm, -arm):
            self.line((x - arm, y - rise), (x + arm, y + rise), stroke)

    def ellipse(self, centre: Sequence[float] | Array, shape: Array, stroke: Stroke, fill: float) -> None:
        """Draw an ellipse with a translucent interior; nothing if it is not finite or larger than the image.

        `centre`: (2,) px. `shape`: (2, 2) px^2, the matrix S of the border ``d^T S^-1 d = 1``. `fill`: opacity of the
        interior, 0 to 1.
        """
        if not (np.isfinite(shape).all() and np.isfinite(centre).all()):
            return
        values, vectors = np.linalg.eigh(shape + 0.25 * np.eye(2))  # not thinner than a pixel
        axes = np.sqrt(np.maximum(values, 0.25))
        if axes.max() > 2 * max(self.image.shape):
            return
        border = centre + np.column_stack([np.cos(_AROUND), np.sin(_AROUND)]) * axes @ vectors.T
        low, high = np.floor(border.min(axis=0)).astype(int) - 2, np.ceil(border.max(axis=0)).astype(int) + 3
        patch = self.image[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)]
        if patch.size:
            inner = patch.copy()
            Canvas(inner)._fill(border - np.maximum(low, 0), stroke.colour)
            self._cv2.addWeighted(inner, fill, patch, 1 - fill, 0, dst=patch)
        width = max(round(2 * stroke.radius), 1)
        corners = [np.round(border * 2**_SHIFT).astype(np.int32)]
        self._cv2.polylines(self.image, corners, True, stroke.colour[::-1], width, self._cv2.LINE_AA, _SHIFT)

    def shade(self, box: Box, colour: Rgb, opacity: float) -> None:
        """Cover a box with a translucent colour. `opacity`: 0 to 1."""
        patch = self.image[max(box.top, 0) : max(box.bottom, 0), max(box.left, 0) : max(box.right, 0)]
        if patch.size:
            full = np.full_like(patch, colour[::-1])
            self._cv2.addWeighted(full, opacity, patch, 1 - opacity, 0, dst=patch)

    def stamp(self, left: int, top: int, coverage: Coverage, colour: Rgb) -> None:
        """Blend a colour where a mask says so.

        `left`, `top`: where the mask's first pixel lies, px. coverage: (h, w), 0 to 1.
        """
        height, width = coverage.shape
        x, y = max(left, 0), max(top, 0)
        patch = self.image[y : max(top + height, 0), x : max(left + width, 0)]
        cut = coverage[y - top : y - top + patch.shape[0], x - left : x - left + patch.shape[1], None]
        patch[:] = patch + cut * (np.array(colour[::-1], dtype=np.float32) - patch) + 0.5

    def _fill(self, corners: Array, colour: Rgb) -> None:
        """Fill a convex polygon of corners (n, 2) px."""
        place = np.round(np.clip(corners, -_FARTHEST_PX, _FARTHEST_PX) * 2**_SHIFT).astype(np.int32)
        self._cv2.fillConvexPoly(self.image, place, colour[::-1], self._cv2.LINE_AA, _SHIFT)


def resized(image: Image, size: tuple[int, int]) -> Image:
    """Return an image in another size. `image`: (height, width, 3). `size`: width and height, px."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    cv2 = optional("cv2", "view", "another size of images")
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


class Lettering:
    """Text as masks, in DejaVu Sans, which comes with matplotlib: the same on every machine."""

    def __init__(self, size_px: int):
        self.size_px = size_px
        self.mask = lru_cache(500)(self._mask)
        """Returns the coverage (line height, width), 0 to 1, of a text."""

    @cached_property
    def _font(self) -> Any:
        matplotlib = optional("matplotlib", "view", "text on a picture")
        from PIL import ImageFont

        path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
        return ImageFont.truetype(str(path), self.size_px, layout_engine=ImageFont.Layout.BASIC)

    @cached_property
    def line_height(self) -> int:
        """Height of a line, px."""
        return int(sum(self._font.getmetrics()))

    def width(self, text: str) -> int:
        """Return the width of a text, px."""
        return int(np.ceil(self._font.getlength(text)))

    def _mask(self, text: str) -> Coverage:
        from PIL import Image, ImageDraw

        image = Image.new("L", (max(self.width(text), 1), self.line_height))
        ImageDraw.Draw(image).text((0, 0), text, fill=255, font=self._font)
        return np.asarray(np.asarray(image) / np.float32(255), dtype=np.float32)

    def wrap(self, text: str, width: int, lines: int) -> list[str]:
        """Break a text into lines; what does not fit ends with an ellipsis. `width`: of a line, px."""
        out = [""]
        words = text.split()
        for i, word in enumerate(words):
            longer = f"{out[-1]} {word}".strip()
            if self.width(longer) <= width or not out[-1]:
                out[-1] = longer
            elif len(out) < lines:
                out.append(word)
            else:
                out[-1] = " ".join([out[-1], *words[i:]])
                break
        return [self.shortened(line, width) for line in out]

    def shortened(self, text: str, width: int) -> str:
        """Return a text that fits, cut with an ellipsis where needed. `width`: px."""
        if self.width(text) <= width:
            return text
        while text and self.width(text + _MORE) > width:
            text = text[: max(len(text) - max(1, len(text) // 20), 0)]
        return (text.rstrip() + _MORE).strip()


@dataclass(frozen=True)
class Label:
    """A label that is to be placed."""

    name: str  #: Of the label, the same in every frame
    x: float  #: Column of its point, px
    y: float  #: Row of its point, px
    width: int  #: px
    height: int  #: px
    leftwards: bool = False  #: Whether the left of the point is preferred


@dataclass
class LabelLayout:
    """Places labels frame by frame; a label keeps its place beside its point while it can."""

    _last: dict[str, Offset] = field(default_factory=dict)

    def place(self, labels: Sequence[Label], picture: Box, avoided: Array = _NOTHING) -> dict[str, Box]:
        """Return a box for each label; a label for which there is no room is left out.

        It covers the fewest points and is nearest to its own; the last one stays while it covers few.

        `avoided`: (n, 2) px, points that are covered only where there is no other room.
        """
        out: dict[str, Box] = {}
        for label in labels:
            last = self._last.get(label.name)
            offsets = list(_offsets(label, last))
            dx, dy = np.array(offsets).T
            left = np.clip(round(label.x) + dx, picture.left, picture.right - label.width)
            top = round(label.y) + dy
            sides = _Sides(left, top, left + label.width, top + label.height)
            free = (sides.left >= picture.left) & (top >= picture.top) & (sides.bottom <= picture.bottom)
            for box in out.values():
                apart = (sides.left >= box.right) | (sides.right <= box.left)
                free &= apart | (sides.top >= box.bottom) | (sides.bottom <= box.top)
            if not free.any():
                continue
            # Nearer to the point of another it seems to be that one's label; the last one only where that is clear
            others = np.array([(one.x, one.y) for one in labels if one is not label]).reshape(-1, 2)
            own = sides.distance(np.array([[label.x, label.y]]))
            kept = np.array([offset == last for offset in offsets])
            mistaken = (sides.distance(others) < np.where(kept, 0.5, 1.0)[:, None] * own).any(axis=1)
            covered = (sides.distance(avoided) == 0).sum(axis=1) + _MISTAKEN * mistaken
            covered[kept & (covered <= _TOLERATED)] = 0
            best = int(np.argmin(np.where(free, covered, len(avoided) + _MISTAKEN + 1)))
            self._last[label.name] = offsets[best]
            out[label.name] = Box(int(left[best]), int(top[best]), label.width, label.height)
        return out


class _Sides(NamedTuple):
    """Sides (n,) px of n boxes."""

    left: NDArray[np.int_]
    top: NDArray[np.int_]
    right: NDArray[np.int_]
    bottom: NDArray[np.int_]

    def distance(self, points: Array) -> Array:
        """Return the distances (n, m) px of points (m, 2) from the boxes; 0 inside, NaN of unknown points."""
        (u, v), sides = points.T, [side[:, None] for side in self]
        across = np.maximum(np.maximum(sides[0] - u, u - sides[2]), 0.0)
        return np.asarray(np.hypot(across, np.maximum(np.maximum(sides[1] - v, v - sides[3]), 0.0)))


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
