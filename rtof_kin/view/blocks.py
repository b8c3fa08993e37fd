"""`BlockCache`: what is drawn of the frames around the current one, computed once and ahead of time."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import RtofError
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MeasurementsReader


class MotionBlocks(MotionReader):
    """A motion on the disk, of which any frames can be shown."""

    @property
    def available(self) -> int:
        """Number of frames, from the first, that can be read."""
        return len(self)

    def frame_at(self, time: float) -> int:
        """Return the frame nearest to a time.

        Args:
            time: s.
        """
        after = int(np.searchsorted(self.times, time))
        if after == 0 or after == len(self):
            return min(after, len(self) - 1)
        return after - int(time - self.times[after - 1] < self.times[after] - time)

    def frames(self, start: int, stop: int) -> Motion:
        """Return frames as a motion; see `MotionReader.read`."""
        return self.read(start, stop)

    def thinned_root(self, start: int, stop: int, step: int) -> tuple[Array, NDArray[np.uint8]]:
        """Return every so manieth position and provenance of `root`."""
        p, provenance = self.root(start, stop)
        return p[::step], provenance[::step]


class MeasurementBlocks(MeasurementsReader):
    """Measurements on the disk, of which any frames can be shown.

    Attributes:
        first: the first frame, for cameras and names.
    """

    def __init__(self, path: Path):
        """Read what does not change over time.

        Raises:
            FileFormatError: missing, damaged, or of a newer schema.
        """
        super().__init__(path)
        self.first = self.read(0, 1)

    @property
    def available(self) -> int:
        """Number of frames, from the first, that can be read."""
        return len(self)

    def frames(self, start: int, stop: int) -> Measurements:
        """Return frames; see `MeasurementsReader.read`."""
        return self.read(start, stop)


BLOCK: Final = 256
"""Frames of a block."""
_KEPT: Final = 8
"""Blocks that are kept."""
_AHEAD: Final = 0.4
"""Part of a block after which the next one is computed."""
_POLL: Final = 0.01
"""[s] between two looks at how far a file was read."""
T = TypeVar("T")


class BlockCache(Generic[T]):
    """Blocks of a motion by frame. All methods but the computation are of one thread."""

    def __init__(self, frames: int, available: Callable[[], int], compute: Callable[[int, int], T], block: int = BLOCK):
        """Compute nothing yet.

        Args:
            available: returns how many can be read now, from the first.
            compute: makes a block from its first frame and the one after its last.
        """
        self.frames, self._available, self._compute = frames, available, compute
        self._size = block
        self._blocks: OrderedDict[int, Future[T]] = OrderedDict()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="blocks")

    def at(self, frame: int, seconds: float = 0.0) -> tuple[T, int] | None:
        """Return the block of a frame and the frame's place in it; None while that is read or computed.

        Raises:
            RtofError: the block cannot be read.
        """
        number, place = divmod(frame, self._size)
        deadline = time.monotonic() + seconds
        while (found := self._block(number)) is None and time.monotonic() < deadline:
            time.sleep(_POLL)
        if place > _AHEAD * self._size:
            self._block(number + 1)
        if found is None:
            return None
        try:
            return found.result(timeout=max(deadline - time.monotonic(), 0.0)), place
        except TimeoutError:
            return None

    def close(self) -> None:
        """Stop computing."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _block(self, number: int) -> Future[T] | None:
        """Return a block that is or will be computed; None if it cannot be read yet."""
        start, stop = number * self._size, min((number + 1) * self._size, self.frames)
        if number in self._blocks:
            self._blocks.move_to_end(number)
            return self._blocks[number]
        if start >= stop or self._available() < stop:
            return None
        try:
            self._blocks[number] = self._worker.submit(self._compute, start, stop)
        except RuntimeError as error:  # closed
            raise RtofError("the viewer was closed") from error
        while len(self._blocks) > _KEPT:
            self._blocks.popitem(last=False)[1].cancel()
        return self._blocks[number]
