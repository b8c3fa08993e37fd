"""`MarkerSequence`: points in space over time, as in TRC and C3D files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.text import measurable


@dataclass(frozen=True)
class MarkerSequence:
    """Positions of markers, or of other named points, in world."""

    times: Array
    """(T,) seconds, strictly increasing."""
    names: tuple[str, ...]
    """M names."""
    p_world: Array
    """(T, M, 3) m; NaN as a whole where missing."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("marker names", self.names))
        set_(self, "times", checked_times("marker times", self.times))
        shape = len(self.times), len(self.names), 3
        p = np.array(readonly("markers p_world", self.p_world, shape))
        if np.any(np.isinf(p)) or not measurable(p):
            raise InvalidInputError("markers p_world: infinite; write NaN where a marker was not seen")
        p[np.isnan(p).any(axis=-1)] = np.nan
        set_(self, "p_world", readonly("markers p_world", p, shape))

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return replace(self, times=self.times[frames], p_world=self.p_world[frames])

    @property
    def rate_hz(self) -> float:
        """Frames per second, by the mean step; 60 for a single frame."""
        return (len(self) - 1) / float(self.times[-1] - self.times[0]) if len(self) > 1 else 60.0


@dataclass(frozen=True)
class MarkerBlocks:
    """Markers that may be longer than memory allows, for writers."""

    times: Array
    """(T,) seconds, strictly increasing."""
    names: tuple[str, ...]
    """M names."""
    blocks: Callable[[], Iterator[Array]]
    """Returns p_world (n, M, 3), m, of consecutive frames, T in all; NaN as a whole where missing."""

    @classmethod
    def of(cls, markers: MarkerSequence | Self) -> MarkerBlocks:
        """Return markers in memory as one block; blocks are returned as they are."""
        if isinstance(markers, MarkerBlocks):
            return markers
        return MarkerBlocks(markers.times, markers.names, lambda: iter([markers.p_world]))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def rate_hz(self) -> float:
        """Frames per second, by the mean step; 60 for a single frame."""
        return (len(self) - 1) / float(self.times[-1] - self.times[0]) if len(self) > 1 else 60.0
