"""Text as masks, in DejaVu Sans, which comes with matplotlib: the same on every machine."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.packages import optional
from rtof_kin.view.overlay.canvas import Coverage

_CACHED: Final = 500
"""Texts whose masks are kept."""
_MORE: Final = " …"


class Lettering:
    """A font of one size."""

    def __init__(self, size_px: int):
        """Take the size of the font, px."""
        self.size_px = size_px
        self._masks: dict[str, Coverage] = {}

    @cached_property
    def _font(self) -> Any:
        matplotlib = optional("matplotlib", "view", "text on a picture")
        from PIL import ImageFont

        path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
        return ImageFont.truetype(str(path), self.size_px, layout_engine=ImageFont.Layout.BASIC)

    @cached_property
    def line_height(self) -> int:
        """Height of a line, px."""
        ascent, descent = self._font.getmetrics()
        return int(ascent + descent)

    def width(self, text: str) -> int:
        """Return the width of a text, px."""
        return int(np.ceil(self._font.getlength(text)))

    def mask(self, text: str) -> Coverage:
        """Return the coverage (line height, width), 0 to 1, of a text."""
        if text not in self._masks:
            if len(self._masks) >= _CACHED:
                self._masks.clear()
            self._masks[text] = self._drawn(text)
        return self._masks[text]

    def _drawn(self, text: str) -> Coverage:
        from PIL import Image, ImageDraw

        image = Image.new("L", (max(self.width(text), 1), self.line_height))
        ImageDraw.Draw(image).text((0, 0), text, fill=255, font=self._font)
        return np.asarray(np.asarray(image) / np.float32(255), dtype=np.float32)

    def wrap(self, text: str, width: int, lines: int) -> list[str]:
        """Break a text into lines; what does not fit ends with an ellipsis.

        Args:
            width: of a line, px.
        """
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
        """Return a text that fits, cut with an ellipsis where needed.

        Args:
            width: px.
        """
        if self.width(text) <= width:
            return text
        while text and self.width(text + _MORE) > width:
            text = text[: max(len(text) - max(1, len(text) // 20), 0)]
        return (text.rstrip() + _MORE).strip()
