"""Tables of numbers in text as loggers of sensors write them: some lines about the device, a line of
column names, then a line of numbers for each packet, separated by tabs, commas or semicolons.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import LARGEST_NUMBER

Array = NDArray[np.float64]
LARGEST_BYTES = 2**30
"""Files of more than this are refused: a day of one sensor at 100 Hz."""
LONGEST_LINE = 2**16
MOST_HEADER_LINES = 100


@dataclass(frozen=True)
class SensorTable:
    """Named columns of numbers, and the lines above them."""

    path: Path
    header: tuple[str, ...]
    """Lines above the column names."""
    names: tuple[str, ...]
    """C column names, as they stand in the file."""
    values: Array
    """(T, C); NaN where a cell is empty."""
    lines: Sequence[int]
    """(T,) where each row stands in the file, from 1."""
    notes: tuple[str, ...]
    """What was met, in sentences."""

    def columns(self, *names: str) -> Array | None:
        """(T, len(names)) of the columns named, whatever their case; None where one is not there."""
        at = {name.lower(): i for i, name in enumerate(self.names)}
        if not all(name.lower() in at for name in names):
            return None
        return self.values[:, [at[name.lower()] for name in names]]

    def column(self, name: str) -> Array | None:
        """(T,) of one column, whatever its case; None where it is not there."""
        found = self.columns(name)
        return None if found is None else found[:, 0]


def text_lines(path: Path, limit: int = LARGEST_BYTES) -> Iterator[tuple[int, str]]:
    """Lines of a text file with their numbers from 1, without holding more than one of them.

    Raises:
        FileFormatError: no such file, larger than `limit` bytes, binary, not UTF-8, or a line too long.
    """
    try:
        if path.stat().st_size > limit:
            raise FileFormatError(path, f"larger than {limit / 2**20:.0f} MiB; split the recording")
        with path.open("rb") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(LONGEST_LINE + 1), b""), 1):
                if len(line) > LONGEST_LINE:
                    raise FileFormatError(path, f"longer than {LONGEST_LINE} bytes", number)
                if b"\0" in line:
                    problem = "holds NUL bytes: binary, damaged, or UTF-16; save it as UTF-8 text"
                    raise FileFormatError(path, problem, number)
                yield number, _decoded(path, number, line)
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error


def _decoded(path: Path, number: int, line: bytes) -> str:
    try:
        return line.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
    except UnicodeDecodeError as error:
        problem = f"byte {line[error.start]:#x} is not UTF-8 text; save the file as UTF-8"
        raise FileFormatError(path, problem, number) from error


def separator(line: str) -> str:
    """What separates the cells of a line: the most frequent of tab, semicolon, comma."""
    return max("\t;,", key=line.count)


def cells(line: str, delimiter: str | None = None) -> list[str]:
    """Cells of a line without the blanks around them."""
    return [cell.strip() for cell in line.split(delimiter or separator(line))]


def read_table(
    path: Path, is_header: Callable[[list[str]], bool], wanted: Callable[[str], bool]
) -> SensorTable:
    """The table of a text file.

    Args:
        is_header: whether the cells of a line are the column names.
        wanted: whether the numbers of the column so named are read; others may hold anything.

    Raises:
        FileFormatError: unreadable, no line of column names, a name twice, no packet, a row of another
            length, a cell that is no number. A last line that was cut off is left out, with a note.
    """
    rows = text_lines(path)
    header: list[str] = []
    for number, line in rows:
        names = cells(line)
        if is_header(names):
            break
        header.append(line)
        if number >= MOST_HEADER_LINES:
            raise FileFormatError(path, f"no line of column names in the first {number}", number)
    else:
        raise FileFormatError(path, "ends before a line of column names", max(len(header), 1))
    double = sorted({name for name in names if name and names.count(name) > 1})
    if double:
        raise FileFormatError(path, f"column {double[0]!r} stands there more than once", number)
    taken = [i for i, name in enumerate(names) if name and wanted(name)]
    return _read_rows(path, tuple(header), names, taken, separator(line), rows)


def _read_rows(
    path: Path,
    header: tuple[str, ...],
    names: list[str],
    taken: list[int],
    delimiter: str,
    rows: Iterator[tuple[int, str]],
) -> SensorTable:
    values, lines = array("d"), array("q")
    cut: int | None = None
    for number, line in rows:
        if not line.strip():
            continue
        if cut is not None:
            raise FileFormatError(path, f"fewer cells than the {len(names)} columns", cut)
        row = line.split(delimiter)
        if len(row) < len(names):
            cut = number  # an error, unless this is the last line
            continue
        if any(cell.strip() for cell in row[len(names) :]):
            raise FileFormatError(path, f"{len(row)} cells under {len(names)} column names", number)
        try:
            values.extend([float(row[i]) if row[i].strip() else math.nan for i in taken])
        except ValueError as error:
            raise _no_number(path, names, taken, row, number) from error
        lines.append(number)
    if not lines:
        raise FileFormatError(path, "holds column names and no packet")
    table = np.frombuffer(values).reshape(len(lines), len(taken))
    huge = np.argwhere(np.abs(table) > LARGEST_NUMBER)
    if len(huge):
        row_of, column = huge[0]
        problem = f"column {names[taken[column]]}: {table[row_of, column]:g} is no measurement"
        raise FileFormatError(path, problem, lines[row_of])
    notes = (f"line {cut} was cut off and is left out",) if cut is not None else ()
    return SensorTable(path, header, tuple(names[i] for i in taken), table, lines, notes)


def _no_number(path: Path, names: list[str], taken: list[int], row: list[str], line: int) -> FileFormatError:
    for i in taken:
        try:
            float(row[i] or "nan")
        except ValueError:
            hint = "write decimal points" if "," in row[i] else "leave a missing cell empty"
            return FileFormatError(
                path, f"column {names[i]}: {row[i].strip()[:40]!r} is not a number; {hint}", line
            )
    return FileFormatError(path, "holds something else than numbers", line)
