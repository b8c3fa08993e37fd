"""Named arrays in .npz files and tables of numbers in .csv files of untrusted origin.

An .npz is parsed here, not by `numpy.load`: nothing is unpickled, and no memory is allocated before the size
in a header has been compared with the bytes in the file.
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, WritingError, reading
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import LARGEST_NUMBER, check_file, measurable

_UNSUSPICIOUS_BYTES, _LARGEST_RATIO = 256 * 2**20, 100
"""Archives above this size with a higher compression ratio are refused."""
_MOST_MEMBERS: Final = 10_000
_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, MemoryError, ValueError)
"""What reading a damaged archive raises."""


def check_sizes(path: Path, members: Sequence[zipfile.ZipInfo], limit: float) -> None:
    """Raise `FileFormatError` for an archive above `limit` bytes, or large and compressed beyond any recording."""
    full = sum(member.file_size for member in members)
    if full > limit:
        raise FileFormatError(path, f"would fill more than {limit / 2**20:.0f} MiB of memory")
    check_ratio(path, full, sum(member.compress_size for member in members))


def check_ratio(path: Path, full: int, packed: int) -> None:
    """Raise `FileFormatError` for what is large and compressed beyond any recording; sizes in bytes."""
    if full > _UNSUSPICIOUS_BYTES and full > _LARGEST_RATIO * packed:
        raise FileFormatError(path, f"unpacks to {full} bytes from {packed}, which no recording does; not opened")


def array_members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an archive of arrays by the name of the array; `FileFormatError` for an array twice, of
    which readers differ in the one they take, or too many.
    """
    members = archive.infolist()
    number = len(members)
    if number > _MOST_MEMBERS:
        raise FileFormatError(path, f"{number} members; no archive of this package has so many")
    found = {member.filename.removesuffix(".npy"): member for member in members}
    if len(found) < len(members):
        names = Counter(member.filename.removesuffix(".npy") for member in members)
        raise FileFormatError(path, f"array {names.most_common(1)[0][0][:80]!r} stands in it twice; not opened")
    return found


LARGEST_BYTES = 4 * 2**30  #: Default limit of the total size of the arrays, bytes
_LARGEST_CSV = 2**30
_MOST_AXES = 32
_CHUNK = 2**20  #: [bytes] read at once
_WAITING_IN_MEMORY = 2**20  #: [bytes] of a `WaitingArray` without a file
_CSV = "a CSV file; its first line names the columns"


def read_npz(path: Path, limit: int = LARGEST_BYTES, names: Collection[str] | None = None) -> dict[str, Array]:
    """Return arrays of an .npz file, all or the named ones, as float64, by name; `FileFormatError` where there is no
    such file, or it is damaged, larger than `limit` bytes, or has numbers of another type or magnitude.
    """
    saved = read_npz_as_saved(path, limit, names=names)
    return {name: _as_floats(path, name, saved.pop(name)) for name in [*saved]}  # one at a time: they may be large


def read_npz_as_saved(
    path: Path, limit: int = LARGEST_BYTES, kinds: str = "fiub", names: Collection[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Return arrays of an .npz file, all or the named ones, in their own types, by name; errors as
    `read_npz`, also for other kinds than those allowed, by NumPy's letters; U is text.
    """
    arrays: dict[str, NDArray[Any]] = {}
    with _open_npz(path) as archive:
        entries = array_members(path, archive)
        members = {name: info for name, info in entries.items() if names is None or name in names}
        check_sizes(path, list(entries.values()), math.inf)
        check_sizes(path, list(members.values()), limit)
        for name, member in members.items():
            with archive.open(member) as stream:
                arrays[name] = _read_npy(path, name, stream, member.file_size, kinds)
    return arrays


def npz_names(path: Path) -> tuple[str, ...]:
    """Return the names of the arrays in an .npz file without reading them, or raise `FileFormatError`."""
    with _open_npz(path) as archive:
        return tuple(array_members(path, archive))


def npz_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in an .npz file without reading them, or raise `FileFormatError`."""
    shapes: dict[str, tuple[int, ...]] = {}
    with _open_npz(path) as archive:
        for name, member in array_members(path, archive).items():
            with archive.open(member) as stream:
                shapes[name], *_ = _checked_header(path, name, stream, member.file_size, "fiub")
    return shapes


def npz_rows(path: Path, name: str, rows: int) -> Iterator[Array]:
    """Yield an array of an .npz file as float64 by so many rows at a time, one in Fortran order as a whole; errors as
    `read_npz`.
    """
    with _open_npz(path) as archive:
        members = array_members(path, archive)
        check_sizes(path, list(members.values()), math.inf)
        with archive.open(members[name]) as stream:
            shape, fortran, dtype = _checked_header(path, name, stream, members[name].file_size, "fiub")
            whole = fortran or not shape
            for start in [0] if whole else range(0, max(shape[0], 1), rows):
                block = shape if whole else (min(rows, shape[0] - start), *shape[1:])
                yield _as_floats(path, name, _read_data(path, name, stream, block, fortran, dtype))
            _check_end(path, name, stream, shape)


@contextmanager
def _open_npz(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; all errors of reading it become `FileFormatError`."""
    problem = "damaged, or no NPZ archive ({}); write it again with numpy.savez"
    with reading(path, problem, *_DAMAGED):
        check_file(path, "an NPZ archive")
        with zipfile.ZipFile(path) as archive:
            yield archive


def read_npy(path: Path, limit: int = LARGEST_BYTES) -> Array:
    """Return the array of an .npy file of at most `limit` bytes as float64; errors as `read_npz`."""
    with reading(path, "cannot be read: {}", OSError, MemoryError):
        check_file(path, "an array", limit)
        with path.open("rb") as stream:
            saved = _read_npy(path, "array", stream, path.stat().st_size, "fiub")
    return _as_floats(path, "array", saved)


def read_npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an .npy array: shape, whether in Fortran order, and type; ValueError without an array."""
    try:
        version = np.lib.format.read_magic(stream)
        reader: Any = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
            version
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # headers written by Python 2
            shape, fortran, dtype = reader(stream)
    except (ValueError, LookupError, TypeError, SyntaxError, RecursionError, OverflowError, TokenError) as error:
        raise ValueError(f"{type(error).__name__}: {str(error)[:200]}") from error
    return shape, fortran, dtype


def _read_npy(path: Path, name: str, stream: IO[bytes], size: int, kinds: str) -> NDArray[Any]:
    shape, fortran, dtype = _checked_header(path, name, stream, size, kinds)
    array = _read_data(path, name, stream, shape, fortran, dtype)
    _check_end(path, name, stream, shape)
    return array


def _check_end(path: Path, name: str, stream: IO[bytes], shape: tuple[int, ...]) -> None:
    """Check that there are no more bytes; of an archive's member, the checksum is compared here."""
    if stream.read(1):
        raise FileFormatError(path, f"{name}: damaged, it has more bytes than its shape {shape} needs")


def _checked_header(
    path: Path, name: str, stream: IO[bytes], size: int, kinds: str
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array whose data fit into so many bytes."""
    with reading(path, f"{name}: not a NumPy array ({{}})", ValueError):
        shape, fortran, dtype = read_npy_header(stream)
    if dtype.hasobject or dtype.kind not in kinds:
        raise FileFormatError(
            path,
            f"{name}: has type {dtype}, not numbers; pickled objects are never read, so save a plain array of numbers",
        )
    claimed = math.prod(shape) * dtype.itemsize
    if claimed > size or min(shape, default=0) < 0 or dtype.itemsize == 0 or len(shape) > _MOST_AXES:
        raise FileFormatError(path, f"{name}: shape {shape} needs {claimed} bytes, {size} are there")
    return shape, fortran, dtype


def _read_data(
    path: Path, name: str, stream: IO[bytes], shape: tuple[int, ...], fortran: bool, dtype: np.dtype[Any]
) -> NDArray[Any]:
    array, done = np.empty(shape, dtype, order="F" if fortran else "C"), 0
    room = array.ravel(order="K").view(np.uint8) if array.nbytes else np.empty(0, np.uint8)
    while done < len(room) and (data := stream.read(min(_CHUNK, len(room) - done))):
        room[done : done + len(data)] = np.frombuffer(data, np.uint8)
        done += len(data)
    if done < len(room):
        raise FileFormatError(path, f"{name}: damaged, {done} of {len(room)} bytes are there")
    return array


def _as_floats(path: Path, name: str, saved: NDArray[Any]) -> Array:
    """Return numbers as float64 after checking their magnitude."""
    with np.errstate(invalid="ignore"):  # casting a signalling NaN
        array: Array = saved.astype(np.float64, copy=False)
    if not measurable(array):
        raise FileFormatError(path, f"{name}: contains a number beyond {LARGEST_NUMBER:g}")
    return array


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]], overwrite: bool = False, compressed: bool = True) -> None:
    """Write arrays to an .npz file; errors as `core.files.folder.new_file`."""
    contents: dict[str, Any] = dict(arrays)
    with new_file(path, overwrite) as whole, whole.open("wb") as stream:
        (np.savez_compressed if compressed else np.savez)(stream, **contents)


def write_npz_blocks(path: Path, arrays: Mapping[str, tuple[tuple[int, ...], Iterable[NDArray[Any]]]]) -> None:
    """Write the bytes of `write_npz` from arrays by blocks of rows: by name, the shape of the whole and its blocks."""
    with new_file(path) as whole, zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (shape, blocks) in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                for number, block in enumerate(map(np.ascontiguousarray, blocks)):
                    if not number:
                        kind = np.lib.format.dtype_to_descr(block.dtype)
                        head = {"descr": kind, "fortran_order": False, "shape": shape}
                        np.lib.format.write_array_header_1_0(stream, head)
                    stream.write(block.tobytes())


def write_csv(path: Path, columns: Mapping[str, Array], overwrite: bool = False) -> None:
    """Write columns (T,) as a table with nine digits; errors as `core.files.folder.new_file`."""
    with new_file(path, overwrite) as file:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(file, rows, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")


def read_csv(path: Path) -> dict[str, Array]:
    """Return the columns of `csv_blocks` as a whole."""
    (columns,) = csv_blocks(path, sys.maxsize)
    return columns


def csv_blocks(path: Path, rows: int = 4096) -> Iterator[dict[str, Array]]:
    """Yield the columns of a comma-separated file with a header line by blocks of rows, at least one block; an empty
    cell or ``nan`` is NaN. `FileFormatError`: no such file, no header, a line of another length, a cell that is not a
    number.
    """
    with (
        reading(path, "cannot be read: {}", OSError),
        reading(path, "not a readable CSV file: {}", csv.Error),
        reading(path, f"not a text file in UTF-8, so not {_CSV}", UnicodeDecodeError),
    ):
        check_file(path, _CSV, _LARGEST_CSV)
        with path.open(encoding="utf-8-sig", newline="") as stream:
            lines = csv.reader(stream)
            header = _header(path, lines)
            numbers = (_numbers(path, lines.line_num, header, cells) for cells in lines if cells)
            first = True
            while (block := list(islice(numbers, rows))) or first:
                first = False
                table = np.array(block, dtype=np.float64).reshape(len(block), len(header))
                columns = dict(zip(header, np.ascontiguousarray(table.T), strict=True))
                for name, column in columns.items():
                    if not measurable(column):
                        raise FileFormatError(path, f"column {name}: contains a number beyond {LARGEST_NUMBER:g}")
                yield columns


def _header(path: Path, lines: Iterator[list[str]]) -> list[str]:
    header = [name.strip() for name in next(lines, [])]
    if not any(header):
        raise FileFormatError(path, f"empty; expected {_CSV}", 1)
    if len(header) == 1 and ";" in header[0]:
        raise FileFormatError(path, "separated by ';'; write commas and decimal points", 1)
    double = sorted(name for name, count in Counter(header).items() if count > 1)
    if double:
        raise FileFormatError(path, f"column {double[0]!r} occurs more than once", 1)
    return header


def _numbers(path: Path, line: int, header: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(header):
        raise FileFormatError(path, f"{len(cells)} cells where the header names {len(header)} columns", line)
    row = []
    for name, cell in zip(header, cells, strict=True):
        try:
            row.append(float(cell) if cell.strip() else math.nan)
        except ValueError as error:
            raise FileFormatError(
                path, f"column {name}: {cell!r} is not a number; leave a missing cell empty", line
            ) from error
    return row


class WaitingArray:
    """Rows (T, ...) float64, appended by blocks and read when needed; in a temporary file if they are many."""

    def __init__(self, row: tuple[int, ...]) -> None:
        self.shape: tuple[int, ...] = (0, *row)  #: Shape of the array
        self._file = tempfile.SpooledTemporaryFile(_WAITING_IN_MEMORY)  # noqa: SIM115

    def append(self, rows: Array) -> None:
        """Write further rows (n, ...); `WritingError` where they cannot be written."""
        try:
            self._file.seek(0, 2)
            self._file.write(np.ascontiguousarray(rows, dtype=np.float64).tobytes())
        except OSError as error:
            raise WritingError(
                f"{tempfile.gettempdir()}: temporary arrays cannot be written ({error}); make room, or name "
                "another folder in the environment variable TMPDIR"
            ) from error
        self.shape = (self.shape[0] + len(rows), *rows.shape[1:])

    def __getitem__(self, rows: slice) -> Array:
        length, *row = self.shape
        start, stop, _ = rows.indices(length)
        size = 8 * math.prod(row)
        self._file.seek(start * size)
        return np.frombuffer(self._file.read((stop - start) * size)).reshape(stop - start, *row)

    def close(self) -> None:
        """Forget the rows."""
        self._file.close()
