"""Captions above and below a picture: time, title, faults while they last, legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import Provenance
from rtof_kin.view.overlay.canvas import Box, Canvas, Stroke
from rtof_kin.view.overlay.lettering import Lettering
from rtof_kin.view.overlay.skeleton_drawing import BLACK, DETECTED, WHITE, SkeletonStyle
from rtof_kin.view.provenance_colours import WORDS, Rgb

_SMALLEST_PX: Final = 11
_SIZE: Final = 0.0165
"""Size of the font over the square root of the picture's area."""
_OPACITY: Final = 0.75
_FAULT_LINES: Final = 2
"""Most lines of a fault."""
_FAULTS: Final = 2
"""Most faults that are named at a time."""
_FAULT: Final[Rgb] = (255, 205, 90)
_NOWHERE: Final = "no motion here"
_UNSEEN: Final = "not observed"


@dataclass(frozen=True)
class CaptionTexts:
    """What captions say in all pictures of a film."""

    title: str
    """One line beside the time."""
    faults: tuple[StreamFault, ...] = ()
    """Shown while they last."""
    provenances: tuple[Provenance, ...] = ()
    """For the legend."""
    detected: bool = False
    """Whether detected points are drawn."""
    bands: bool = False
    """Whether 95 % ellipses are drawn."""


@dataclass(frozen=True)
class _Item:
    """An entry of the legend; without a stroke a detected point."""

    text: str
    stroke: Stroke | None


@dataclass(frozen=True)
class _Line:
    """A line of text at a place."""

    text: str
    left: int
    top: int
    colour: Rgb


class Captions:
    """Captions of the pictures of a film."""

    def __init__(self, texts: CaptionTexts, width_px: int, height_px: int):
        """Take the texts and the size of the pictures."""
        self._texts = texts
        self._width, self._height = width_px, height_px
        self._style = SkeletonStyle(width_px, height_px)
        self.lettering = Lettering(font_size(width_px, height_px))
        self._pad = max(self.lettering.size_px // 3, 3)
        inner = width_px - 2 * self._pad
        self._legend = self._legend_rows(_items(texts, self._style), inner)

    def boxes(self, time: float | None) -> tuple[Box, Box]:
        """Return the boxes above and below that captions cover.

        Args:
            time: s, of the motion; None where there is none.
        """
        line = self.lettering.line_height
        above = line + 2 * self._pad
        below = (len(self._fault_lines(time)) + len(self._legend)) * line + 2 * self._pad
        return Box(0, 0, self._width, above), Box(0, self._height - below, self._width, below)

    def draw(self, canvas: Canvas, time: float | None, video_time: float, seen: bool = True) -> None:
        """Draw captions.

        Args:
            time: s, of the motion; None where there is none. video_time: s, of the video.
        """
        above, below = self.boxes(time)
        for box in (above, below):
            canvas.shade(box, BLACK, _OPACITY)
        line, pad = self.lettering.line_height, self._pad
        now, colour = f"{_NOWHERE} (video: {video_time:.2f} s)", _FAULT
        if time is not None:
            now, colour = f"{time:.2f} s{'' if seen else f', {_UNSEEN}'}", WHITE
        canvas.stamp(pad, above.top + pad, self.lettering.mask(now), colour)
        left = 2 * pad + self.lettering.line_height + self.lettering.width(now)
        title = self.lettering.shortened(self._texts.title, self._width - left - pad)
        canvas.stamp(left, above.top + pad, self.lettering.mask(title), WHITE)
        faults = self._fault_lines(time)
        for i, text in enumerate(faults):
            canvas.stamp(pad, below.top + pad + i * line, self.lettering.mask(text), _FAULT)
        for i, row in enumerate(self._legend):
            self._draw_legend(canvas, row, below.top + pad + (len(faults) + i) * line)

    def _fault_lines(self, time: float | None) -> list[str]:
        """Return the sentences of the faults at an instant."""
        if time is None:
            return []
        now = [fault for fault in self._texts.faults if fault.start <= time <= fault.stop]
        lines = []
        for fault in now[:_FAULTS]:
            text = f"{fault.what}: {fault.kind.value}"
            lines += self.lettering.wrap(text, self._width - 2 * self._pad, _FAULT_LINES)
        return lines + ([f"and {len(now) - _FAULTS} more faults"] if len(now) > _FAULTS else [])

    # --- legend ----------------------------------------------------------------------------------

    def _legend_rows(self, items: Sequence[_Item], width: int) -> list[list[tuple[int, _Item]]]:
        """Return rows of entries with their left ends, px."""
        rows: list[list[tuple[int, _Item]]] = [[]]
        left = self._pad
        for item in items:
            size = self._swatch + self._pad + self.lettering.width(item.text)
            if rows[-1] and left + size > width:
                rows.append([])
                left = self._pad
            rows[-1].append((left, item))
            left += size + 2 * self._pad + self.lettering.size_px // 2
        return rows

    @property
    def _swatch(self) -> int:
        return 2 * self.lettering.size_px

    def _draw_legend(self, canvas: Canvas, row: Sequence[tuple[int, _Item]], top: int) -> None:
        middle = top + self.lettering.line_height / 2
        radius = self._style.bone
        for left, item in row:
            if item.stroke is None:
                stroke = Stroke(DETECTED, self._style.thin, BLACK, self._style.edge / 2)
                canvas.cross((left + self._swatch / 2, middle), self._style.cross, stroke)
            else:
                ends = (left + radius, middle), (left + self._swatch - radius, middle)
                canvas.line(ends[0], ends[1], item.stroke)
            canvas.stamp(left + self._swatch + self._pad, top, self.lettering.mask(item.text), WHITE)


def font_size(width_px: int, height_px: int) -> int:
    """Return the size of the font for a picture, px."""
    return max(round(_SIZE * float(np.sqrt(width_px * height_px))), _SMALLEST_PX)


def _items(texts: CaptionTexts, style: SkeletonStyle) -> list[_Item]:
    """Return the entries of a legend."""
    shown = sorted(texts.provenances, reverse=True)
    items = [_Item(WORDS[how], style.bone_stroke(how, right=False)) for how in shown]
    for text, edge in (("right", WHITE), ("left, middle", BLACK)):
        items.append(_Item(text, Stroke((120, 120, 120), style.bone, edge, style.edge)))
    if texts.detected:
        items.append(_Item("detected point", None))
    if texts.bands:
        items.append(_Item("95 % of the joint's position", Stroke(WHITE, style.thin)))
    return items
