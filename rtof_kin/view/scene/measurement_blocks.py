"""`MeasurementBlocks`: what a motion was computed from, on the disk, by frames."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import npz_names, read_npz_as_saved
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.core.files.scanned_file import ScannedFile
from rtof_kin.data.measurements import Measurements
from rtof_kin.formats.measurements_npz import SCHEMA_VERSION, measurements_of

_CONSTANT: Final = (
    "quat_wxyz_bone_sensor", "p_bone_sensor", "K_still", "video_K", "video_distortion"
)  # fmt: skip
"""Arrays, or ends of their names, that do not have one row per frame."""
_HEADER_BYTES: Final = 16 * 2**20


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
        names = [name for name in npz_names(path) if name != "header"]
        constant = [name for name in names if name.endswith(_CONSTANT)]
        saved = read_npz_as_saved(path, _HEADER_BYTES, kinds="fiubU", names=("header", *constant))
        try:
            self._header: dict[str, Any] = json.loads(str(saved["header"]))
            if self._header["schema_version"] > SCHEMA_VERSION:
                raise FileFormatError(path, "its schema version is newer; update rtof_kin")
        except FileFormatError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(path, f"its header is not readable ({error}); reconstruct again") from error
        self._constant: dict[str, Array] = {name: saved[name].astype(float) for name in constant}
        rows = NpzBlocks(path, [name for name in names if name not in constant])
        self._names = [name for name in names if name in rows]
        self.length = rows.length
        super().__init__(path, rows)
        with ExitStack() as failed:
            failed.callback(self.close)
            self.wait(min(self.length, 1))
            self.first = self.frames(0, min(self.length, 1))
            failed.pop_all()

    def frames(self, start: int, stop: int) -> Measurements:
        """Return frames.

        Args:
            start, stop: within `available`.

        Raises:
            FileFormatError: a value in them is invalid.
        """
        arrays = dict(self._constant)
        try:
            for name in self._names:
                arrays[name] = np.asarray(self._rows.rows(name, start, stop), dtype=float)
            return measurements_of(self._header, arrays)
        except KeyError as error:
            raise FileFormatError(self.path, f"{error} is missing; reconstruct again") from error
        except (RtofError, ValueError, TypeError, AttributeError, IndexError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(self.path, f"frames {start} to {stop}: {error}") from error
