"""`MotionBlocks`: a motion on the disk, by frames, however long it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array


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
