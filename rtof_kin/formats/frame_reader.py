"""`FrameReader`: what readers of files with one row per frame have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Generic, Self, TypeVar

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError

Block = TypeVar("Block")


class FrameReader(ABC, Generic[Block]):
    """Frames of a file, however long it is; a context that closes the file.

    Attributes:
        path: the file. times: (T,) s.
    """

    path: Path
    times: Array

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    @property
    @abstractmethod
    def available(self) -> int:
        """Number of frames, from the first, that `scan` has passed."""

    @abstractmethod
    def scan(self, stop: Event | None = None, until: int | None = None) -> None:
        """Pass over the file, on from where the last pass ended; see `NpzBlocks.scan`.

        Args:
            until: number of frames that are wanted; default: all.

        Raises:
            FileFormatError: the file is damaged.
        """

    @abstractmethod
    def block(self, start: int, stop: int) -> Block:
        """Return frames.

        Args:
            start, stop: frames; those before `available`, or a little after, are found fast.

        Raises:
            FileFormatError: the file is damaged, or something in these frames is missing or invalid.
            InvalidInputError: there are no such frames.
        """

    def blocks(self, frames: int = 3600, overlap: int = 0) -> Iterator[Block]:
        """Yield all frames in order.

        Args:
            frames: of a block, without the overlap; the last one may be shorter.
            overlap: number of frames before a block that are repeated at its beginning.

        Raises:
            FileFormatError: see `block`.
        """
        for start in range(0, len(self), frames):
            yield self.block(max(start - overlap, 0), min(start + frames, len(self)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.times)

    def _find(self, start: int, stop: int) -> None:
        """Pass over the file as far as these frames; raise `InvalidInputError` where there are none."""
        if not 0 <= start < stop <= len(self):
            raise InvalidInputError(f"{self.path}: no frames {start} to {stop}; it has {len(self)}")
        self.scan(until=stop)
