"""`MeasurementBlocks`: what a motion was computed from, on the disk, by frames."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from rtof_kin.core.files.scanned_file import ScannedFile
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_npz import MeasurementsReader


class MeasurementBlocks(ScannedFile):
    """Frames of a ``measurements.npz``, readable from the first on while a thread passes over it.

    Attributes:
        path: the file. length: number of frames. first: measurements without frames but one, for cameras
            and names.
    """

    def __init__(self, path: Path):
        """Read what does not change over time, and start the thread; end it with `close`.

        Args:
            path: ``measurements.npz``.

        Raises:
            FileFormatError: missing, damaged, or of a newer schema.
        """
        self._measurements = MeasurementsReader(path)
        self.length = len(self._measurements)
        super().__init__(path, self._measurements)
        with ExitStack() as failed:
            failed.callback(self.close)
            self.wait(1)
            self.first = self.frames(0, 1)
            failed.pop_all()

    def frames(self, start: int, stop: int) -> Measurements:
        """Return frames.

        Args:
            start, stop: within `available`.

        Raises:
            FileFormatError: a value in them is invalid.
        """
        return self._measurements.block(start, stop)
