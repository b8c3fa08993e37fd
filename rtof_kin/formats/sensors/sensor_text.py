"""Text tables of sensor loggers: lines about the device, a line of column names, a line per packet.

Cells are separated by tabs, commas or semicolons, and may stand in double quotes.

Of dates and times at which files say that they began, only what states its zone becomes a time in UTC. A time of an
unknown zone is a note for the reader.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import LARGEST_NUMBER, opening

LARGEST_BYTES: Final = 2**30  #: Largest file that is read, bytes; a day of one sensor at 100 Hz
LONGEST_LINE: Final = 2**16
MOST_HEADER_LINES: Final = 100


@dataclass(frozen=True)
class SensorTable:
    """Named columns of numbers, and the lines above them."""

    path: Path
    header: tuple[str, ...]  #: Lines above the column names
    names: tuple[str, ...]  #: C column names
    values: Array  #: (T, C); NaN where a cell is empty
    lines: Sequence[int]  #: (T,) line of each row in the file, from 1
    notes: tuple[str, ...]  #: Omissions, in sentences

    def columns(self, *names: str) -> Array | None:
        """Return the named columns (T, len(names)), in any case of letters; None where one is absent."""
        at = {name.lower(): i for i, name in enumerate(self.names)}
        if not all(name.lower() in at for name in names):
            return None
        return self.values[:, [at[name.lower()] for name in names]]

    def column(self, name: str) -> Array | None:
        """Return one column (T,), in any case of letters; None where absent."""
        found = self.columns(name)
        return None if found is None else found[:, 0]


def text_lines(path: Path, limit: int = LARGEST_BYTES) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file of at most `limit` bytes with their numbers from 1, one at a time.
    `FileFormatError`: no such file, too large, binary, not UTF-8, or a line too long.
    """
    with opening(path):
        if path.stat().st_size > limit:
            raise FileFormatError(path, f"larger than {limit / 2**20:.0f} MiB; split the recording")
        with path.open("rb") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(LONGEST_LINE + 1), b""), 1):
                if len(line) > LONGEST_LINE:
                    raise FileFormatError(path, f"longer than {LONGEST_LINE} bytes", number)
                if b"\0" in line:
                    problem = "holds NUL bytes: binary, damaged, or UTF-16; save it as UTF-8 text"
                    raise FileFormatError(path, problem, number)
                try:
                    yield number, line.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
                except UnicodeDecodeError as error:
                    problem = f"byte {line[error.start]:#x} is not UTF-8 text; save the file as UTF-8"
                    raise FileFormatError(path, problem, number) from error


def cells(line: str, delimiter: str | None = None) -> list[str]:
    """Split a line into cells without surrounding blanks, by default at the most frequent of tab, semicolon, comma."""
    return [cell.strip() for cell in _split(line, delimiter or _delimiter(line))]


def _delimiter(line: str) -> str:
    outside = "".join(line.split('"')[::2])
    return max("\t;,", key=outside.count)


def _split(line: str, delimiter: str) -> list[str]:
    """Split a line outside of double quotes, which are left out."""
    if '"' not in line:
        return line.split(delimiter)
    pieces = line.split('"')
    pieces[1::2] = [quoted.replace(delimiter, "\0") for quoted in pieces[1::2]]  # no line holds NUL
    return [cell.replace("\0", delimiter) for cell in "".join(pieces).split(delimiter)]


def read_table(
    path: Path,
    is_header: Callable[[list[str]], bool],
    wanted: Callable[[str], bool],
    decimal_commas: bool = False,
    names_above: str = "",
) -> SensorTable:
    """Read the table of a text file. A last line that was cut off is left out, with a note.
    `FileFormatError`: unreadable, no column names, a name twice, no packet, a row of another length, or a cell that is
    no number; names the line.

    Args:
        is_header: whether the cells of a line are the column names.
        wanted: whether the column of a name is read; other columns may hold any text.
        decimal_commas: whether 1,5 is one and a half where cells are not separated by commas.
        names_above: line of column names of a file that has none.
    """
    rows: Iterator[tuple[int, str]] = chain([(0, names_above)] if names_above else (), text_lines(path))
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
    delimiter = _delimiter(line)
    if decimal_commas and delimiter != ",":
        rows = ((number, row.replace(",", ".")) for number, row in rows)
    table, lines, cut = _read_rows(path, names, taken, delimiter, rows)
    huge = np.argwhere(np.abs(table) > LARGEST_NUMBER)
    if len(huge):
        row, column = huge[0]
        problem = f"column {names[taken[column]]}: {table[row, column]:g} is no measurement"
        raise FileFormatError(path, problem, lines[row])
    notes = (f"line {cut} was cut off and is left out",) if cut is not None else ()
    return SensorTable(path, tuple(header), tuple(names[i] for i in taken), table, lines, notes)


def _read_rows(
    path: Path, names: list[str], taken: list[int], delimiter: str, rows: Iterator[tuple[int, str]]
) -> tuple[Array, array[int], int | None]:
    """Return the taken columns (T, C), the lines of the rows, and the line of a cut last row."""
    values, lines = array("d"), array("q")
    cut: int | None = None
    for number, line in rows:
        if not line.strip():
            continue
        if cut is not None:
            raise FileFormatError(path, f"fewer cells than the {len(names)} columns", cut)
        row = _split(line, delimiter)
        if len(row) < len(names):
            cut = number  # an error, unless this is the last line
            continue
        if any(cell.strip() for cell in row[len(names) :]):
            raise FileFormatError(path, f"{len(row)} cells under {len(names)} column names", number)
        for i in taken:
            try:
                values.append(math.nan if row[i].strip() in ("", "n/a") else float(row[i]))
            except ValueError as error:
                hint = "write decimal points" if "," in row[i] else "leave a missing cell empty"
                raise FileFormatError(
                    path, f"column {names[i]}: {row[i].strip()[:40]!r} is not a number; {hint}", number
                ) from error
        lines.append(number)
    if not lines:
        raise FileFormatError(path, "holds column names and no packet")
    return np.frombuffer(values).reshape(len(lines), len(taken)), lines, cut


_DOT_START: Final = re.compile(
    r"StartTime:\W*(\d{4}-\d\d-\d\d)_(\d\d:\d\d:\d\d)_(\d{1,3}) (?:GMT|UTC)([+-]\d{1,2})?(?::?(\d\d))?"
)
MT_START: Final = re.compile(r"//\s*Start Time:\s*(?!Unknown)(\S.*)", re.IGNORECASE)
_UTC_COLUMNS: Final = tuple(
    f"UTC_{part}" for part in ("Year", "Month", "Day", "Hour", "Minute", "Second", "Nano", "Valid")
)
UTC_COLUMNS: Final = frozenset(name.lower() for name in _UTC_COLUMNS)
"""Columns of MT Manager with the time of each packet, in small letters."""
_VALID: Final = 4  #: Bit of UTC_Valid that says that date and time are known


def utc_of_milliseconds(since_epoch: str) -> datetime | None:
    """Return a time given in milliseconds since 1970; None where it is none."""
    if not re.fullmatch(r"\d{1,14}", since_epoch) or int(since_epoch) == 0:
        return None
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=int(since_epoch))


def start_of_dot(header: Sequence[str]) -> datetime | None:
    """Return the time of a DOT file's header, which states the zone; None where absent or impossible."""
    found = next((match for line in header if (match := _DOT_START.match(line.strip()))), None)
    if found is None:
        return None
    date, time, thousandths, hours, minutes = found.groups()
    sign = -1 if (hours or "").startswith("-") else 1
    zone = sign * timedelta(hours=abs(int(hours or 0)), minutes=int(minutes or 0))
    try:
        local = datetime.fromisoformat(f"{date}T{time}").replace(tzinfo=timezone(zone))
    except ValueError:
        return None
    return local.astimezone(UTC) + timedelta(milliseconds=int(thousandths))


def start_of_mt(table: SensorTable, row: int) -> datetime | None:
    """Return the time of a packet of MT Manager by its UTC columns; None where they do not state it."""
    columns = table.columns(*_UTC_COLUMNS)
    if columns is None or not np.isfinite(columns[row]).all() or not int(columns[row, -1]) & _VALID:
        return None
    *whole, nano, _ = columns[row].tolist()
    try:
        return datetime(*map(int, whole), tzinfo=UTC) + timedelta(microseconds=nano / 1000)  # type: ignore[misc, arg-type]
    except (ValueError, OverflowError):
        return None


def unzoned_note(start: object) -> tuple[str, ...]:
    """Return a sentence about a time of start without its zone; none where it is no text."""
    if not isinstance(start, str) or not start.strip():
        return ()
    return (f"began at {start.strip()[:40]}, in a time zone that is not stated",)
