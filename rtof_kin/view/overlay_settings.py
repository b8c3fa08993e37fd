"""What an overlay shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

from rtof_kin.core.errors import InvalidInputError

Background = Literal["white", "dark"]
BACKGROUNDS: Final[tuple[Background, ...]] = get_args(Background)
_NARROWEST: Final = 160


@dataclass(frozen=True)
class OverlaySettings:
    """Contents of the pictures and the part of the motion."""

    angles: tuple[str, ...] | None = None
    """Names of the angles to label; None for flexion of knees, hips and elbows where it was observed."""
    bands: bool = False
    """Draw the 95 % ellipse of every joint's position in the image."""
    points: bool = False
    """Draw the detected points."""
    blur_face: bool = False
    """Make the tracked person's face unrecognisable; all of the picture where its place is uncertain."""
    title: str | None = None
    """Text beside the time; None for what the motion was computed from, without any name."""
    background: Background = "white"
    """Colour without a video."""
    shift: float = 0.0
    """s, added to the times of the given video for those of the video that people were detected in."""
    start: float | None = None
    """s, where to begin, in the given video, or without one in the motion; None for its beginning."""
    stop: float | None = None
    """s, where to end; None for its end."""
    width_px: int | None = None
    """Width of the output, px; None for that of the video."""

    def __post_init__(self) -> None:
        for name in ("shift", "start", "stop"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise InvalidInputError(f"overlay {name}: {value} s is not finite")
        if self.start is not None and self.stop is not None and self.start >= self.stop:
            raise InvalidInputError(f"overlay: from {self.start:g} to {self.stop:g} s is no interval")
        if self.width_px is not None and not _NARROWEST <= self.width_px <= 8192:
            raise InvalidInputError(f"overlay width: {self.width_px} px is not from {_NARROWEST} to 8192")
        if self.background not in BACKGROUNDS:
            raise InvalidInputError(f"overlay background: {self.background!r}, not one of {BACKGROUNDS}")
