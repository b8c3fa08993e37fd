"""Named arrays in .npz files and tables of numbers in .csv files, read without trusting them.

An .npz is parsed here and not by `numpy.load`: nothing is ever unpickled, and no memory is set aside
before the size that a header claims has been compared with the bytes that are there.
"""

from __future__ import annotations

import csv
import io
import math
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import LARGEST_NUMBER, check_file, measurable, read_text

Array = NDArray[np.float64]
LARGEST_BYTES = 4 * 2**30
"""Arrays that would fill more memory than this many bytes are refused."""
_LARGEST_CSV = 2**30
_UNSUSPICIOUS_BYTES, _LARGEST_RATIO = 256 * 2**20, 100
"""Arrays of more bytes that were packed to less than a hundredth are a trap."""


def read_npz(path: Path, limit: int = LARGEST_BYTES) -> dict[str, Array]:
    """All arrays of an .npz file as float64, by name.

    Args:
        limit: largest sum of the arrays' sizes, bytes.

    Raises:
        FileFormatError: no such file, damaged, too large, or an array that is not of numbers, or of
            numbers beyond all measure.
    """
    saved = read_npz_as_saved(path, limit)
    return {name: _measured(path, name, array) for name, array in saved.items()}


def read_npz_as_saved(path: Path, limit: int = LARGEST_BYTES, kinds: str = "fiub") -> dict[str, NDArray[Any]]:
    """All arrays of an .npz file, read-only, of the types they were saved with, by name.

    Args:
        limit: largest sum of the arrays' sizes, bytes.
        kinds: which types may be there, by NumPy's letters; U is text.

    Raises:
        FileFormatError: no such file, damaged, too large, or an array of another kind.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        check_file(path, "an NPZ archive")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            check_sizes(path, members, limit)
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as stream:
                    arrays[name] = _read_npy(path, name, stream, member.file_size, kinds)
    except (
        zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, MemoryError, ValueError
    ) as error:  # fmt: skip
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            path, f"damaged, or no NPZ archive ({error}); write it again with numpy.savez"
        ) from error
    return arrays


def npz_names(path: Path) -> tuple[str, ...]:
    """Names of the arrays in an .npz file; they are not read.

    Raises:
        FileFormatError: no such file, or no archive.
    """
    try:
        check_file(path, "an NPZ archive")
        with zipfile.ZipFile(path) as archive:
            return tuple(name.removesuffix(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, RuntimeError, ValueError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, f"damaged, or no NPZ archive ({error})") from error


def read_npy(path: Path, limit: int = LARGEST_BYTES) -> Array:
    """The array of an .npy file as float64.

    Raises:
        FileFormatError: as `read_npz`.
    """
    try:
        check_file(path, "an array", limit)
        with path.open("rb") as stream:
            saved = _read_npy(path, "array", stream, path.stat().st_size, "fiub")
    except (OSError, MemoryError) as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    return _measured(path, "array", saved)


def read_npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and type of the array that a stream goes on with.

    Raises:
        ValueError: it goes on with no array.
    """
    try:
        version = np.lib.format.read_magic(stream)
        reader: Any = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of headers that Python 2 wrote
            shape, fortran, dtype = reader(stream)
    except (
        ValueError, LookupError, TypeError, SyntaxError, RecursionError, OverflowError, TokenError,
    ) as error:  # fmt: skip
        raise ValueError(f"{type(error).__name__}: {str(error)[:200]}") from error
    return shape, fortran, dtype


def check_sizes(path: Path, members: Sequence[zipfile.ZipInfo], limit: int) -> None:
    """Refuse an archive that would fill the memory, and a small one that would fill much of it.

    Args:
        members: those that will be unpacked. limit: of the sum of their sizes, bytes.

    Raises:
        FileFormatError: it is one.
    """
    full = sum(member.file_size for member in members)
    packed = sum(member.compress_size for member in members)
    if full > limit:
        raise FileFormatError(path, f"would fill more than {limit / 2**20:.0f} MiB of memory")
    if full > _UNSUSPICIOUS_BYTES and full > _LARGEST_RATIO * packed:
        raise FileFormatError(
            path, f"unpacks to {full} bytes from {packed}, as no recording of anything does; not opened"
        )


def _read_npy(path: Path, name: str, stream: IO[bytes], size: int, kinds: str) -> NDArray[Any]:
    try:
        shape, fortran, dtype = read_npy_header(stream)
    except ValueError as error:
        raise FileFormatError(path, f"{name}: not a NumPy array ({error})") from error
    if dtype.hasobject or dtype.kind not in kinds:
        raise FileFormatError(
            path, f"{name}: holds {dtype}, not numbers; pickled objects are never read, so save a "
            "plain array of numbers"
        )  # fmt: skip
    claimed = math.prod(shape) * dtype.itemsize
    if claimed > size or min(shape, default=0) < 0 or dtype.itemsize == 0:
        raise FileFormatError(path, f"{name}: shape {shape} needs {claimed} bytes, {size} are there")
    data = stream.read()
    if len(data) != claimed:
        raise FileFormatError(path, f"{name}: damaged, {len(data)} of {claimed} bytes are there")
    flat = np.frombuffer(data, dtype=dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def _measured(path: Path, name: str, saved: NDArray[Any]) -> Array:
    """Numbers as float64, none of them beyond all measure."""
    with np.errstate(invalid="ignore"):  # some NaNs are said to be invalid when they are cast
        array: Array = saved.astype(np.float64)
    if not measurable(array):
        raise FileFormatError(path, f"{name}: holds a number beyond {LARGEST_NUMBER:g}")
    return array


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]], overwrite: bool = False) -> None:
    """Write arrays by name, compressed; `read_npz` gives the same numbers back.

    Raises:
        OutputExistsError: it exists and overwriting was not asked for. RtofError: it cannot be written.
    """
    contents: dict[str, Any] = dict(arrays)
    with new_file(path, overwrite) as whole, whole.open("wb") as stream:
        np.savez_compressed(stream, **contents)


def read_csv(path: Path) -> dict[str, Array]:
    """The columns of a comma-separated file with a header line; an empty cell or ``nan`` is NaN.

    Raises:
        FileFormatError: no such file, no header, a line of another length, a cell that is no number.
    """
    text = read_text(path, "a CSV file; its first line names the columns", _LARGEST_CSV)
    try:
        columns = _read_table(path, io.StringIO(text, newline=""))
    except csv.Error as error:
        raise FileFormatError(path, f"not a readable CSV file: {error}") from error
    for name, column in columns.items():
        if not measurable(column):
            raise FileFormatError(path, f"column {name}: holds a number beyond {LARGEST_NUMBER:g}")
    return columns


def _read_table(path: Path, stream: IO[str]) -> dict[str, Array]:
    lines = csv.reader(stream)
    header = [name.strip() for name in next(lines, [])]
    if not any(header):
        raise FileFormatError(path, "empty; its first line names the columns", 1)
    if len(header) == 1 and ";" in header[0]:
        raise FileFormatError(path, "separated by ';'; write commas and decimal points", 1)
    double = sorted(name for name, count in Counter(header).items() if count > 1)
    if double:
        raise FileFormatError(path, f"column {double[0]!r} stands there more than once", 1)
    rows = [_numbers(path, lines.line_num, header, cells) for cells in lines if cells]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(header))
    return dict(zip(header, np.ascontiguousarray(table.T), strict=True))


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
