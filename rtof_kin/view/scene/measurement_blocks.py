"""`MeasurementBlocks`: what a motion was computed from, on the disk, by frames."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MeasurementsReader


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
