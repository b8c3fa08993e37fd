"""Named arrays in .npz files and tables of numbers in .csv files, read without trusting them.

An .npz is parsed here and not by `numpy.load`: nothing is ever unpickled, and no memory is set aside
before the size that a header claims has been compared with the bytes that are there.
"""

from __future__ import annotations

import csv
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.errors import FileFormatError

Array = NDArray[np.float64]
LARGEST_BYTES = 4 * 2**30
"""Arrays that would fill more memory than this many bytes are refused."""
_LARGEST_CSV = 2**30


def read_npz(path: Path, limit: int = LARGEST_BYTES) -> dict[str, Array]:
    """All arrays of an .npz file as float64, by name.

    Args:
        limit: largest sum of the arrays' sizes, bytes.

    Raises:
        FileFormatError: no such file, damaged, too large, or an array that is not of numbers.
    """
    arrays: dict[str, Array] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > limit:
                raise FileFormatError(
                    path, f"would fill more than {limit / 2**20:.0f} MiB of memory"
                )
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as stream:
                    arrays[name] = _read_npy(path, name, stream, member.file_size)
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
        raise FileFormatError(
            path, f"damaged, or no NPZ archive ({error}); write it again with numpy.savez"
        ) from error
    return arrays


def _read_npy(path: Path, name: str, stream: IO[bytes], size: int) -> Array:
    try:
        version = np.lib.format.read_magic(stream)
        reader: Any = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = reader(stream)
    except (ValueError, KeyError, SyntaxError, RecursionError) as error:
        raise FileFormatError(path, f"{name}: not a NumPy array ({error})") from error
    if dtype.hasobject or dtype.kind not in "fiub":
        raise FileFormatError(
            path, f"{name}: holds {dtype}, not numbers; pickled objects are never read, so save a "
            "plain array of numbers"
        )  # fmt: skip
    claimed = math.prod(shape) * dtype.itemsize
    if claimed > size:
        raise FileFormatError(
            path, f"{name}: shape {shape} needs {claimed} bytes, {size} are there"
        )
    data = stream.read()
    if len(data) != claimed:
        raise FileFormatError(path, f"{name}: damaged, {len(data)} of {claimed} bytes are there")
    flat = np.frombuffer(data, dtype=dtype)
    return flat.reshape(shape, order="F" if fortran else "C").astype(np.float64)


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name, compressed; `read_npz` gives the same numbers back."""
    contents: dict[str, Any] = dict(arrays)
    np.savez_compressed(path, **contents)


def read_csv(path: Path) -> dict[str, Array]:
    """The columns of a comma-separated file with a header line; an empty cell or ``nan`` is NaN.

    Raises:
        FileFormatError: no such file, no header, a line of another length, a cell that is no number.
    """
    try:
        if path.stat().st_size > _LARGEST_CSV:
            raise FileFormatError(path, "larger than 1 GiB; save such data as .npz")
        with path.open(encoding="utf-8-sig", newline="") as stream:
            return _read_table(path, stream)
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(path, f"not a readable CSV file: {error}") from error


def _read_table(path: Path, stream: IO[str]) -> dict[str, Array]:
    lines = csv.reader(stream)
    header = [name.strip() for name in next(lines, [])]
    if not any(header):
        raise FileFormatError(path, "empty; its first line names the columns", 1)
    if len(header) == 1 and ";" in header[0]:
        raise FileFormatError(path, "separated by ';'; write commas and decimal points", 1)
    double = sorted({name for name in header if header.count(name) > 1})
    if double:
        raise FileFormatError(path, f"column {double[0]!r} stands there more than once", 1)
    rows = [_numbers(path, lines.line_num, header, cells) for cells in lines if cells]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(header))
    return dict(zip(header, np.ascontiguousarray(table.T), strict=True))


def _numbers(path: Path, line: int, header: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(header):
        raise FileFormatError(
            path, f"{len(cells)} cells where the header names {len(header)} columns", line
        )
    row = []
    for name, cell in zip(header, cells, strict=True):
        try:
            row.append(float(cell) if cell.strip() else math.nan)
        except ValueError as error:
            raise FileFormatError(
                path, f"column {name}: {cell!r} is not a number; leave a missing cell empty", line
            ) from error
    return row
