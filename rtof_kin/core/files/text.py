"""Safe reading of text, TOML and JSON files of untrusted origin, and atomic writing of text."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.folder import new_file

LARGEST_TEXT = 2**30  #: Largest text file, bytes
LARGEST_TOML = 32 * 2**20  #: Largest TOML file, bytes
_HEAD_BYTES = 2**14
_BETWEEN_KEYS, _MOST_DOTS = re.compile(r"[^\w.\"' \t-]"), 1000
"""Separator of keys, and most dots in a key: tomllib needs memory quadratic in the parts of a key."""
LARGEST_NUMBER = 1e20  #: Largest magnitude of a number in a file; its square is finite


def check_file(path: str | Path, what: str, limit: float = math.inf) -> None:
    """Check that a path is a regular file of at most `limit` bytes, not a folder, device or pipe, else
    `FileFormatError`; OSError where it is not accessible. `what`: see `read_text`.
    """
    path = Path(path)
    if not path.is_file():
        problem = f"a folder, not {what}" if path.is_dir() else "there is no such file"
        raise FileFormatError(path, problem)
    if path.stat().st_size > limit:
        raise FileFormatError(path, f"larger than {limit / 2**20:.0f} MiB, so not {what}")


@contextmanager
def opening(path: str | Path, what: str = "file") -> Iterator[None]:
    """Turn errors of the system about a file, or about `what` else it may be, into a `FileFormatError`."""
    with reading(path, "cannot be read: {}", OSError), reading(path, f"there is no such {what}", FileNotFoundError):
        yield


def beginning(path: Path, what: str = "file") -> bytes:
    """Return the first 16 KiB of a file, by which its format is recognised; errors as `opening`."""
    with opening(path, what), path.open("rb") as stream:
        return stream.read(_HEAD_BYTES)


def read_text(path: str | Path, what: str, limit: int = LARGEST_TEXT) -> str:
    """Return the text of a UTF-8 file of at most `limit` bytes without byte order mark. `FileFormatError`, with what
    was expected, e.g. "a BVH file, which begins with HIERARCHY": it does not exist, is unreadable, too large, not UTF-8
    or empty.
    """
    path = Path(path)
    with (
        reading(path, "cannot be read: {}", OSError),
        reading(path, f"not a text file in UTF-8, so not {what}", UnicodeDecodeError),
    ):
        check_file(path, what, limit)
        text = path.read_bytes().decode("utf-8-sig")
    if not text.strip():
        raise FileFormatError(path, f"empty; expected {what}", 1)
    return text


def csv_rows(
    path: Path, what: str, columns: Sequence[str], limit: int = LARGEST_TEXT
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line and stripped cells by column of each row of a CSV table that is not empty, whose first line names at
    least `columns`, in any case. `FileFormatError`: as for `read_text`, another header, or rows of another length.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, what, limit), newline=""), strict=True)
    try:
        names = reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or ()]
        if not {*columns} <= {*names} or len(set(names)) < len(names):
            found = f"each once; found {', '.join(names)[:200]}"
            raise FileFormatError(path, f"the first line names the columns {', '.join(columns)}, {found}", 1)
        for row in reader:
            if None in row or None in row.values():
                raise FileFormatError(path, f"more or fewer cells than the {len(names)} columns", reader.line_num)
            if any(map(str.strip, row.values())):
                yield reader.line_num, {name: cell.strip() for name, cell in row.items()}
    except csv.Error as error:
        raise FileFormatError(path, f"not a readable CSV file: {error}", reader.line_num) from error


def load_toml(path: str | Path) -> dict[str, Any]:
    """Return the contents of a TOML file; `FileFormatError` as for `read_text`, or where it is not TOML."""
    text = read_text(path, "TOML", LARGEST_TOML)
    if max(part.count(".") for part in _BETWEEN_KEYS.split(text)) > _MOST_DOTS:
        raise FileFormatError(path, f"a key of more than {_MOST_DOTS} parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"not readable as TOML: {str(error)[:200]}") from error


def load_json(path: str | Path, limit: int = LARGEST_TEXT, what: str = "JSON") -> Any:
    """Return the contents of a JSON file; `FileFormatError` as for `read_text`, or where it is not JSON."""
    text = read_text(path, what, limit)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(path, f"not readable as JSON: {error.msg}", error.lineno) from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"not readable as JSON: {str(error)[:200]}") from error


def numbers_of(
    path: str | Path, line: int, cells: Sequence[str], count: int, what: str = "numbers", gaps: bool = False
) -> list[float]:
    """Return the numbers of a line; with `gaps` an empty cell is NaN. `FileFormatError`, which names the line: another
    number of cells than `count`, or one that is not finite.
    """

    def number(cell: str) -> float:
        try:
            return float(cell) if cell.strip() or not gaps else math.nan
        except ValueError:
            return math.inf

    values = list(map(number, cells))
    if len(values) == count and all(abs(value) <= LARGEST_NUMBER or (gaps and value != value) for value in values):
        return values
    wrong = (c for c, v in zip(cells, values, strict=True) if not (abs(v) <= LARGEST_NUMBER or (gaps and v != v)))
    odd = next((f", among them {cell[:40]!r}" for cell in wrong), "")
    raise FileFormatError(path, f"expected {count} {what}, found {len(cells)}{odd}", line)


def measurable(array: Array) -> bool:
    """Return whether all finite numbers are within `LARGEST_NUMBER`."""
    with np.errstate(invalid="ignore"):
        return not np.any(((array > LARGEST_NUMBER) | (array < -LARGEST_NUMBER)) & np.isfinite(array))


def write_text(path: Path, text: str, overwrite: bool = False) -> None:
    """Write a UTF-8 file atomically; `OutputExistsError` where it exists, `WritingError` where it cannot be written."""
    with new_file(path, overwrite) as file:
        file.write_text(text, encoding="utf-8", newline="\n")
