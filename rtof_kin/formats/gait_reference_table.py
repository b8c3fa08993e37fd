"""A table of normal curves (CSV) as a reference of the gait scores: means and standard deviations alone.

Columns ``variable`` (a name of `VARIABLES`), ``percent`` of the gait cycle, ``mean`` and ``sd``, in degrees;
``sd`` may be absent or empty. Instants from 0 to 100 % that are at most 5 % apart; others than the 51 of the
scores are interpolated linearly.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.text import read_text
from rtof_kin.data.gait_reference import NAMES, PERCENT, SHAPE, GaitReference

_COLUMNS: Final = ("variable", "percent", "mean", "sd")
_WIDEST: Final = 5.0  # largest distance of two instants, per cent
_LARGEST: Final = 16 * 2**20


def read_gait_reference_table(path: str | Path, *, negated: Collection[str] = (), **about: Any) -> GaitReference:
    """Read a table.

    Args:
        negated: variables whose sign in the table is the opposite of `VARIABLES`.
        about: fields of `GaitReference`: people, licence, source, system, zero, speed_range, notes.

    Raises:
        FileFormatError: a cell, an instant or a variable is missing or wrong, which is named.
        UnknownNameError: a name in `negated` is no variable.
    """
    if unknown := [name for name in negated if name not in NAMES]:
        raise UnknownNameError("gait variable", unknown, NAMES)
    found: dict[str, dict[float, tuple[float, float]]] = {}
    for line, name, percent, middle, spread in _rows(Path(path)):
        own = found.setdefault(name, {})
        if percent in own:
            raise FileFormatError(path, f"{name} at {percent:g} % occurs twice", line)
        own[percent] = middle, spread
    if not found:
        raise FileFormatError(path, "no rows below the header")
    mean, sd = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    for name, samples in found.items():
        sign, v = -1 if name in negated else 1, NAMES.index(name)
        curve, deviation = _curves(path, name, samples)
        mean[v], sd[v] = sign * curve, deviation
    try:
        return GaitReference(np.radians(mean), np.radians(sd), **about)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _rows(path: Path) -> Iterator[tuple[int, str, float, float, float]]:
    """Line, variable, per cent, mean and standard deviation of each row."""
    text = read_text(path, "a table with the columns variable, percent, mean, sd", _LARGEST)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip().lower() for name in next(reader)]
        absent = [name for name in _COLUMNS[:3] if name not in header]
        if absent or len(set(header)) < len(header):
            raise FileFormatError(
                path,
                f"the first line names the columns {', '.join(_COLUMNS)}, each once; found {', '.join(header)[:200]}",
                1,
            )
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise FileFormatError(path, f"{len(row)} cells, not {len(header)}", reader.line_num)
            cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
            if (name := cells["variable"]) not in NAMES:
                raise FileFormatError(path, str(UnknownNameError("variable", [name[:60]], NAMES)), reader.line_num)
            numbers = [_number(path, reader.line_num, column, cells) for column in _COLUMNS[1:]]
            yield reader.line_num, name, numbers[0], numbers[1], numbers[2]
    except csv.Error as error:
        raise FileFormatError(path, f"not readable as CSV: {error}", reader.line_num) from error


def _number(path: Path, line: int, column: str, cells: dict[str, str]) -> float:
    """Number of a cell; NaN for an empty or absent standard deviation."""
    text = cells.get(column, "")
    if column == "sd" and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if not math.isfinite(value):
        raise FileFormatError(path, f"{column}: {text[:40]!r} is not a finite number", line)
    return value


def _curves(path: str | Path, name: str, samples: dict[float, tuple[float, float]]) -> tuple[Array, Array]:
    """Mean and standard deviation (51,) of one variable, in degrees."""
    at = np.array(sorted(samples))
    if at[0] != 0 or at[-1] != 100 or np.diff(at).max() > _WIDEST:
        raise FileFormatError(
            path,
            f"{name}: {len(at)} instants from {at[0]:g} to {at[-1]:g} %; needed are those from 0 to "
            f"100 %, at most {_WIDEST:g} % apart",
        )
    values = np.array([samples[percent] for percent in at.tolist()])
    mean, sd = (np.interp(PERCENT, at, column) for column in values.T)
    return mean, sd
