"""`MotionBlocks`: a motion on the disk, by frames, however long it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.scanned_file import ScannedFile
from rtof_kin.formats.motion_npz import MotionReader


class MotionBlocks(ScannedFile):
    """Frames of a ``motion.npz``, which become readable from the first on while a thread passes over it.

    Attributes:
        path: the file. times: (T,) s. skeleton: of the person. mode: of the reconstruction. rate_hz: of the
            frames.
    """

    def __init__(self, path: Path):
        """Read the header and the times, and start the thread; end it with `close`.

        Args:
            path: ``motion.npz``.

        Raises:
            FileFormatError: missing, damaged, of a newer schema, or not a motion.
        """
        self._motion = found = MotionReader(path)
        self.times, self.skeleton, self.mode, self.rate_hz = (found.times, found.skeleton, found.mode, found.rate_hz)
        super().__init__(path, found)

    def __len__(self) -> int:
        return len(self.times)

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
        """Return frames as a motion.

        Args:
            start, stop: within `available`.

        Raises:
            FileFormatError: a value in them is invalid.
        """
        return self._motion.block(start, stop).motion()

    def root(self, start: int, stop: int, step: int = 1) -> tuple[Array, NDArray[np.uint8]]:
        """Return positions (n, 3) of the root, m, NaN where missing, and their provenance (n,).

        Args:
            start, stop: frames within `available`. step: only every so many.

        Raises:
            FileFormatError: the file is damaged.
        """
        p, provenance = self._motion.root(start, stop)
        return p[::step], provenance[::step]
