"""What is drawn of the frames around the current one: `BlockCache` computes it ahead of time, `Nearby` when needed."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Final, Generic, TypeVar

import numpy as np

from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import RtofError

BLOCK: Final = 256  #: Frames of a block
_KEPT: Final = 8  # Blocks that are kept
_AHEAD: Final = 0.4  # Part of a block after which the next one is computed
T = TypeVar("T")
Part = TypeVar("Part", covariant=True)


class BlockCache(Generic[T]):
    """Blocks of a motion by frame. All methods but the computation are of one thread.

    `compute`: makes a block from its first frame and the one after its last.
    """

    def __init__(self, frames: int, compute: Callable[[int, int], T], block: int = BLOCK):
        self.frames, self._compute, self._size = frames, compute, block
        self._blocks: OrderedDict[int, Future[T]] = OrderedDict()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="blocks")

    def at(self, frame: int, seconds: float = 0.0) -> tuple[T, int] | None:
        """Return the block of a frame and the frame's place in it; None while that is read or computed.

        `seconds`: to wait for it, s. `RtofError`: the block cannot be read.
        """
        deadline = time.monotonic() + seconds
        number, place = divmod(frame, self._size)
        found = self._block(number)
        if place > _AHEAD * self._size and (number + 1) * self._size < self.frames:
            self._block(number + 1)
        try:
            return found.result(timeout=max(deadline - time.monotonic(), 0.0)), place
        except TimeoutError:
            return None

    def close(self) -> None:
        """Stop computing."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _block(self, number: int) -> Future[T]:
        """Return a block that is or will be computed."""
        if number not in self._blocks:
            start, stop = number * self._size, min((number + 1) * self._size, self.frames)
            try:
                self._blocks[number] = self._worker.submit(self._compute, start, stop)
            except RuntimeError as error:  # closed
                raise RtofError("the viewer was closed") from error
        self._blocks.move_to_end(number)
        while len(self._blocks) > _KEPT:
            self._blocks.popitem(last=False)[1].cancel()
        return self._blocks[number]


class Nearby(Generic[Part]):
    """Parts of what may be longer than memory allows, each read when a frame in it is needed."""

    def __init__(self, frames: int, read: Callable[[int, int], Part]):
        """Read nothing yet. `frames`: of the whole. `read`: returns frames [start, stop)."""
        self._part = lru_cache(2)(lambda number: read(number * BLOCK, min((number + 1) * BLOCK + 1, frames)))

    def at(self, frames: Index) -> tuple[Part, Index]:
        """Return the part with a frame and the next one, and their places in it; `frames`: (n,), none of others."""
        number = int(frames.min()) // BLOCK
        return self._part(number), frames - number * BLOCK


def frame_at(times: Array, time: float) -> int:
    """Return the frame nearest to a time, s, by the times (T,) of all frames, s."""
    after = int(np.searchsorted(times, time))
    if after == 0 or after == len(times):
        return min(after, len(times) - 1)
    return after - int(time - times[after - 1] < times[after] - time)
