"""`ScratchArrays`: arrays that wait on the disk, appended by blocks and read by rows."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from typing import IO

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import WritingError


class ScratchArrays:
    """Arrays of one length in temporary files, which the system removes with the process at the latest."""

    def __init__(self) -> None:
        self.length = 0
        """Rows of each array."""
        self._files: dict[str, IO[bytes]] = {}
        self._rows: dict[str, tuple[int, ...]] = {}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array."""
        return {name: (self.length, *row) for name, row in self._rows.items()}

    def append(self, arrays: Mapping[str, Array]) -> None:
        """Write further rows of all arrays.

        Args:
            arrays: (n, ...) float64 by name, the same names each time.

        Raises:
            WritingError: they cannot be written.
        """
        try:
            for name, array in arrays.items():
                if name not in self._files:
                    self._files[name], self._rows[name] = tempfile.TemporaryFile(), array.shape[1:]  # noqa: SIM115
                self._files[name].seek(0, 2)
                np.ascontiguousarray(array, dtype=np.float64).tofile(self._files[name])
            self.length += len(next(iter(arrays.values())))
        except OSError as error:
            raise WritingError(
                f"{tempfile.gettempdir()}: temporary arrays cannot be written ({error}); make room, or name "
                "another folder in the environment variable TMPDIR"
            ) from error

    def rows(self, name: str, start: int, stop: int) -> Array:
        """Return rows of an array."""
        row = self._rows[name]
        size = math.prod(row)
        stream = self._files[name]
        stream.seek(8 * start * size)
        return np.fromfile(stream, np.float64, (stop - start) * size).reshape(stop - start, *row)

    def close(self) -> None:
        """Remove the files."""
        for stream in self._files.values():
            stream.close()
