"""`RecordingReader`: a recording's folder read by spans of time, for recordings larger than the memory."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from rtof_kin.core.errors import RtofError
from rtof_kin.recording.index import index_of, read_index
from rtof_kin.recording.recording import Recording, recording_digest
from rtof_kin.recording.streams import OnDisk, RecordingSource, Streams, naming


class RecordingReader(RecordingSource):
    """A recording's folder of which spans of time are read when they are asked for.

    It is checked as a whole when it is opened, by blocks, and kept in temporary files.
    """

    def __init__(self, first: Recording, streams: Streams, closing: ExitStack):
        """Take a recording with everything but its samples, these, and what closes the files; see `open`."""
        self._first, self._streams, self._closing = first, streams, closing
        self.name = first.name

    @classmethod
    def open(cls, folder: str | Path) -> Self:
        """Open a recording's folder; to be closed after use.

        Args:
            folder: that has a file ``recording.toml``.

        Raises:
            FileFormatError, UnknownNameError, UnitError: those of `Recording.load`.
        """
        try:
            return cls._opened(Path(folder))
        except RtofError:
            Recording.load(folder)  # its error counts samples from the start of the whole
            raise

    @classmethod
    def _opened(cls, folder: Path) -> Self:
        index = index_of(folder)
        with ExitStack() as closing, naming(index.path):
            fields, streams = read_index(index, OnDisk(closing))
            parts = streams.parts(lambda stream: stream.part(slice(0, 1)))
            recording = Recording(**fields, **parts, is_part=True)
            streams.check_clocks()
            return cls(recording, streams, closing.pop_all())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files and remove the temporary ones."""
        self._closing.close()

    @property
    def streams(self) -> Streams:
        """All that changes over time."""
        return self._streams

    def between(self, start_s: float, stop_s: float) -> Recording:
        """Return what was recorded in a closed interval, as `Recording.between` of the whole does.

        Args:
            start_s, stop_s: first and last instant, s.

        Raises:
            InvalidInputError: neither a camera nor a sensor has a sample in it.
            FileFormatError: the files have changed or cannot be read any more.
        """
        return self._first.cut(self._streams, start_s, stop_s)

    def digest(self) -> str:
        """Return the SHA-256 of all that is computed from, as `Recording.digest` of the whole does."""
        return recording_digest(self._first.index(), self._streams)

    def whole(self) -> Recording:
        """Return all of it, as `Recording.load` does."""
        return replace(self.between(-np.inf, np.inf), is_part=False)
