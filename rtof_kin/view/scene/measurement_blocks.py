"""`MeasurementBlocks`: what a motion was computed from, on the disk, by frames."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import npz_names, read_npz_as_saved
from rtof_kin.data.measurements import Measurements
from rtof_kin.formats.measurements_npz import SCHEMA_VERSION, measurements_of
from rtof_kin.view.scene.npz_blocks import NpzBlocks

_CONSTANT: Final = (
    "quat_wxyz_bone_sensor", "p_bone_sensor", "K_still", "video_K", "video_distortion"
)  # fmt: skip
"""Arrays, or ends of their names, that do not have one row per frame."""
_HEADER_BYTES: Final = 16 * 2**20


class MeasurementBlocks:
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
        self.path = path
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
        self._rows = NpzBlocks(path, [name for name in names if name not in constant])
        self._names = [name for name in names if name in self._rows]
        self.length = self._rows.length
        self._stop = threading.Event()
        self._problem: RtofError | None = None
        self._thread = threading.Thread(target=self._pass, name="reading the measurements", daemon=True)
        self._thread.start()
        with ExitStack() as failed:
            failed.callback(self.close)
            while self.available == 0 and self._thread.is_alive():
                self._thread.join(0.002)
            self.first = self.frames(0, min(self.available, 1))
            failed.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def available(self) -> int:
        """Number of frames, from the first, that can be read.

        Raises:
            FileFormatError: the file turned out to be damaged.
        """
        if self._problem is not None:
            raise self._problem
        return self._rows.available

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

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self._thread.join(10.0)
        self._rows.close()

    def _pass(self) -> None:
        try:
            self._rows.scan(self._stop)
        except RtofError as error:
            self._problem = error
