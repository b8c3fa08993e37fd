"""`ScannedFile`: an .npz file whose rows become readable from the first on while a thread passes over it."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Protocol, Self

from rtof_kin.core.errors import FileFormatError, RtofError


class Scannable(Protocol):
    """A file that is passed over once, as `NpzBlocks`."""

    @property
    def available(self) -> int:
        """Number of frames, from the first, that can be read."""

    def scan(self, stop: threading.Event | None = None) -> None:
        """Pass over the file until its end or until `stop` is set."""

    def close(self) -> None:
        """Close the file."""


class ScannedFile:
    """Rows of an open file and the thread that passes over it; a context that ends both.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path, rows: Scannable):
        """Start the thread; end it with `close`.

        Args:
            rows: of it, opened; closed by `close`.
        """
        self.path, self._rows = path, rows
        self._stop = threading.Event()
        self._problem: RtofError | None = None
        self._thread = threading.Thread(target=self._pass, name=f"reading {path.name}", daemon=True)
        self._thread.start()

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

    def wait(self, frames: int, seconds: float = 60.0) -> None:
        """Wait until frames can be read.

        Args:
            frames: number of them, from the first.

        Raises:
            FileFormatError: the file is damaged, or this takes longer.
        """
        deadline = time.monotonic() + seconds
        while True:
            alive = self._thread.is_alive()  # asked first: it may end just after `available`
            if self.available >= frames:
                return
            if not alive or time.monotonic() > deadline:
                raise FileFormatError(self.path, f"not read within {seconds:g} s; copy it to a faster disk")
            self._thread.join(0.01)

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
