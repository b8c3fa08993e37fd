"""`RecordingWriter`: a recording's folder written part by part, for recordings larger than the memory."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.npz_writer import NpzWriter
from rtof_kin.formats.video_arrays import VIDEO_CONSTANTS
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording


class RecordingWriter:
    """A recording's folder that appears complete at the end of the context, or not at all."""

    def __init__(self, folder: str | Path, overwrite: bool = False, inputs: Mapping[str, str] | None = None):
        """Write nothing yet.

        Args:
            folder, overwrite, inputs: as for `Recording.save`.
        """
        self._folder, self._overwrite, self._inputs = Path(folder).resolve(), overwrite, inputs
        self._open = ExitStack()
        self._files: dict[str, NpzWriter] = {}
        self._last: dict[str, float] = {}
        self._index: str | None = None

    def __enter__(self) -> Self:
        """Make a temporary folder.

        Raises:
            OutputExistsError: the folder exists and may not be replaced. RtofError: it cannot be written.
        """
        self._fresh = self._open.enter_context(new_folder(self._folder, INDEX, self._overwrite, self._inputs))
        self._arrays = self._open.enter_context(ExitStack())
        return self

    def append(self, part: Recording) -> None:
        """Write the next part; the first one gives everything but the samples.

        Args:
            part: with the streams of the first one, at later times.

        Raises:
            InvalidInputError: it has other streams, or does not follow the part before.
        """
        files = part.arrays()
        if self._index is None:
            self._index = part.index()
            for name in files:
                self._files[name] = self._arrays.enter_context(NpzWriter(self._fresh / name))
        if list(files) != list(self._files):
            raise InvalidInputError(
                f"recording {part.name}: a part has {', '.join(files)}, not {', '.join(self._files)}"
            )
        for name, arrays in files.items():
            first = float(arrays["times"][0])
            if first <= self._last.get(name, -float("inf")):
                raise InvalidInputError(
                    f"recording {part.name}, {name}: a part begins at {first:g} s, the one before ends at "
                    f"{self._last[name]:g} s"
                )
            self._last[name] = float(arrays["times"][-1])
            constant = [key for key in VIDEO_CONSTANTS if key in arrays]
            self._files[name].append({key: arrays[key] for key in arrays if key not in constant})
            for key in constant:
                if key not in self._files[name]:
                    self._files[name].add(key, arrays[key])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            return self._open.__exit__(kind, error, trace)
        with self._open:
            if self._index is None:
                raise InvalidInputError(f"{self._folder}: a recording without any part")
            self._arrays.close()
            (self._fresh / INDEX).write_text(self._index, encoding="utf-8")
        return None
