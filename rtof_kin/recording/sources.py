"""Where the arrays of a recording's files stay: `InMemory` reads them as a whole, `OnDisk` by rows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.core.files.arrays import csv_blocks, npz_shapes, read_csv, read_npz
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.core.files.scratch import ScratchArrays
from rtof_kin.data.imu import ImuSequence, UnitCheck
from rtof_kin.recording.streams import ALL, BLOCK, Part, Stream

Arrange = Callable[[Path, dict[str, Array]], tuple[tuple[str, ...], dict[str, Array]]]
"""From a .csv file and its columns to names and arrays."""
_SPACING: Final = 3 * 2**20
"""[bytes] Distance of the places from which rows of an .npz file are read."""


class Table(Protocol):
    """Arrays of a file, float64: most have one row for each sample, the others are constant."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shape of each array."""

    def column(self, name: str) -> Array | None:
        """Return a whole array (T,); None where there is none."""

    def rows(self, rows: slice) -> dict[str, Array]:
        """Return rows of all arrays that have them, and the others."""


class Source(Protocol):
    """How arrays are read from files, and where they stay."""

    def npz(self, path: Path, axes: Mapping[str, int], constants: Sequence[str] = ()) -> Table:
        """Open an .npz file.

        Args:
            axes: number of axes of the arrays with a row for each sample.
            constants: names of further arrays that it may have; others raise `UnknownNameError`.
        """

    def csv(self, path: Path, arrange: Arrange) -> tuple[tuple[str, ...], Table]:
        """Read a .csv file; return its names and arrays."""

    def keep(self, whole: Part) -> Stream[Part]:
        """Return the stream of samples that could only be read as a whole."""

    def checked(self, stream: Stream[Part]) -> Stream[Part]:
        """Return a stream all of whose samples are checked."""


def _check_names(path: Path, found: Collection[str], known: Sequence[str]) -> None:
    if unknown := sorted(set(found) - set(known)):
        raise UnknownNameError(f"array in {path}", unknown, known)


def _with_rows(shapes: Mapping[str, tuple[int, ...]], axes: Mapping[str, int]) -> list[str]:
    """Return the names of arrays with a row for each sample."""
    return [name for name, shape in shapes.items() if len(shape) == axes.get(name)]


# --- as a whole ----------------------------------------------------------------------------------


class InMemory:
    """Reads files as a whole."""

    def npz(self, path: Path, axes: Mapping[str, int], constants: Sequence[str] = ()) -> Table:
        """See `Source`."""
        arrays = read_npz(path)
        _check_names(path, arrays, (*axes, *constants))
        return _Loaded(arrays, axes)

    def csv(self, path: Path, arrange: Arrange) -> tuple[tuple[str, ...], Table]:
        """See `Source`."""
        names, arrays = arrange(path, read_csv(path))
        return names, _Loaded(arrays, {name: array.ndim for name, array in arrays.items()})

    def keep(self, whole: Part) -> Stream[Part]:
        """See `Source`."""
        return Stream(whole.times, lambda rows: whole if rows == ALL else whole[rows])

    def checked(self, stream: Stream[Part]) -> Stream[Part]:
        """See `Source`."""
        return self.keep(stream.part(ALL))


@dataclass(frozen=True)
class _Loaded:
    arrays: dict[str, Array]
    axes: Mapping[str, int]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: array.shape for name, array in self.arrays.items()}

    def column(self, name: str) -> Array | None:
        return self.arrays.get(name)

    def rows(self, rows: slice) -> dict[str, Array]:
        return self.arrays | {name: self.arrays[name][rows] for name in _with_rows(self.shapes, self.axes)}


# --- by rows -------------------------------------------------------------------------------------


class OnDisk:
    """Reads rows of .npz files when they are asked for, and all else once into temporary files."""

    def __init__(self, closing: ExitStack):
        """Take what closes the files."""
        self._closing = closing

    def npz(self, path: Path, axes: Mapping[str, int], constants: Sequence[str] = ()) -> Table:
        """See `Source`."""
        shapes = npz_shapes(path)
        _check_names(path, shapes, (*axes, *constants))
        with_rows = _with_rows(shapes, axes)
        whole = read_npz(path, names=[name for name in shapes if name not in with_rows or axes[name] == 1])
        blocks = NpzBlocks(path, [name for name in with_rows if axes[name] > 1], _SPACING)
        self._closing.callback(blocks.close)
        return _Packed(shapes, axes, whole, blocks)

    def csv(self, path: Path, arrange: Arrange) -> tuple[tuple[str, ...], Table]:
        """See `Source`."""
        arrays = self._scratch()
        for columns in csv_blocks(path, BLOCK):
            names, block = arrange(path, columns)
            arrays.append(block)
        return names, _Kept(arrays)

    def keep(self, whole: Part) -> Stream[Part]:
        """See `Source`."""
        arrays = self._scratch()
        own = {field.name: getattr(whole, field.name) for field in fields(whole)}
        arrays.append({name: own[name] for name in own if isinstance(own[name], np.ndarray)})
        first, kept = whole[:1], _Kept(arrays)  # nothing here holds the whole

        def part(rows: slice) -> Part:
            some: dict[str, Any] = dict(kept.rows(rows))
            return replace(first, **some)

        return Stream(whole.times, part)

    def checked(self, stream: Stream[Part]) -> Stream[Part]:
        """See `Source`."""
        checked_times("times", stream.times)
        unit, names = UnitCheck(), tuple[str, ...]()
        for part in stream.blocks():
            if isinstance(part, ImuSequence):
                unit.add(part.R_inertial_sensor, part.f_sensor)
                names = part.names
        if names:
            unit.check(names)
        return stream

    def _scratch(self) -> ScratchArrays:
        arrays = ScratchArrays()
        self._closing.callback(arrays.close)
        return arrays


@dataclass(frozen=True)
class _Packed:
    """Arrays of an .npz file, of which rows are decompressed when they are asked for."""

    shapes: dict[str, tuple[int, ...]]
    axes: Mapping[str, int]
    whole: dict[str, Array]
    blocks: NpzBlocks

    def column(self, name: str) -> Array | None:
        return self.whole.get(name)

    def rows(self, rows: slice) -> dict[str, Array]:
        start, stop, _ = rows.indices(self.blocks.length)
        given = {name: self.whole[name] for name in self.whole}
        given |= {name: given[name][rows] for name in _with_rows(self.shapes, self.axes) if name in given}
        self.blocks.scan(until=stop)
        read = {name: self.blocks.rows(name, start, stop) for name in self.shapes if name in self.blocks}
        return given | {name: array.astype(np.float64) for name, array in read.items()}


@dataclass(frozen=True)
class _Kept:
    arrays: ScratchArrays

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return self.arrays.shapes

    def column(self, name: str) -> Array | None:
        return self.arrays.rows(name, 0, self.arrays.length) if name in self.shapes else None

    def rows(self, rows: slice) -> dict[str, Array]:
        start, stop, _ = rows.indices(self.arrays.length)
        return {name: self.arrays.rows(name, start, stop) for name in self.shapes}
