"""Reader of OpenSim's coordinates over time: ``.mot``, and states in ``.sto``, of any model.

Lines of ``key=value`` up to ``endheader``, then a line of column names, the first one ``time`` in s, and a
row of numbers for each frame, separated by tabs or blanks. ``inDegrees`` in the header is the unit of all
rotations; translations are in m. States ``/jointset/JOINT/NAME/value`` are read as ``NAME``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, freeze
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import measurable, read_text

SUFFIXES: Final = (".mot", ".sto")
_END: Final = "endheader"
_STATE: Final = re.compile(r"(?:.*/)?([^/]+)/value")
_OWN: Final = re.compile(r"Coordinates of the \.osim of the skeleton (\w+), zero in the T-pose")
"""Line in the header of the files of `opensim_mot`."""


@dataclass(frozen=True)
class OpenSimTable:
    """Coordinates of a model over time."""

    times: Array
    """(T,) seconds, strictly increasing."""
    names: tuple[str, ...]
    """C coordinates, e.g. 'knee_angle_r'."""
    values: Array
    """(T, C) as in the file: rotations in degrees or rad, translations in m; NaN where missing."""
    in_degrees: bool
    """Whether rotations are in degrees."""
    skeleton: str = ""
    """Skeleton of this package whose .osim the coordinates belong to; '' for another model."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times("coordinate times", self.times))
        object.__setattr__(self, "names", checked_names("OpenSim coordinates", self.names))
        freeze(self, "coordinate", values=(len(self.times), len(self.names)))

    def rotation(self, name: str) -> Array | None:
        """Return one rotation (T,) in rad; None if there is no such column."""
        if name not in self.names:
            return None
        column = np.array(self.values[:, self.names.index(name)])
        return np.radians(column) if self.in_degrees else column


def read_opensim_table(path: str | Path) -> OpenSimTable:
    """Read coordinates of a ``.mot`` or ``.sto``.

    Raises:
        FileFormatError: no such file, not such a table, or without the unit of its rotations.
    """
    path = Path(path)
    lines = read_text(path, f"an OpenSim table, whose header ends with {_END}").splitlines()
    end = next((n for n, line in enumerate(lines) if line.strip().lower() == _END), None)
    if end is None or end + 1 >= len(lines):
        raise FileFormatError(path, f"no {_END} with column names after it, so not an OpenSim table")
    labels = _cells(lines[end + 1])
    if not labels or labels[0].lower() != "time" or len(labels) < 2:
        raise FileFormatError(path, "the first column must be time, and others must follow", end + 2)
    first = end + 2
    rows = [(n, line) for n, line in enumerate(lines[first:], first + 1) if line.strip()]
    if not rows:
        raise FileFormatError(path, "has column names and no row", first)
    table = np.array([_row(path, n, line, len(labels)) for n, line in rows])
    if not measurable(table):
        raise FileFormatError(path, "holds a number that cannot be an angle or a length")
    names, columns = _coordinates(labels)
    try:
        return OpenSimTable(
            table[:, 0], names, table[:, columns], _in_degrees(path, lines[:end]), _skeleton(lines[:end])
        )
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in (line.rstrip("\r\n").split("\t") if "\t" in line else line.split())]


def _row(path: Path, number: int, line: str, columns: int) -> list[float]:
    cells = _cells(line)
    if len(cells) != columns:
        raise FileFormatError(path, f"{len(cells)} cells under {columns} column names", number)
    try:
        return [float(cell) if cell else float("nan") for cell in cells]
    except ValueError as error:
        raise FileFormatError(path, f"holds something else than numbers ({error})", number) from error


def _coordinates(labels: list[str]) -> tuple[tuple[str, ...], list[int]]:
    """Names of coordinates and their columns; of states, the values alone."""
    states = {i: found[1] for i, label in enumerate(labels) if (found := _STATE.fullmatch(label))}
    chosen = states or {i: label for i, label in enumerate(labels) if i > 0}
    return tuple(chosen.values()), list(chosen)


def _in_degrees(path: Path, header: list[str]) -> bool:
    for line in header:
        key, _, value = line.partition("=")
        if key.strip().lower() == "indegrees" and value.strip().lower() in ("yes", "no"):
            return value.strip().lower() == "yes"
    raise FileFormatError(
        path, "the header does not state the unit of rotations: add a line inDegrees=yes or inDegrees=no"
    )


def _skeleton(header: list[str]) -> str:
    return next((found[1] for line in header if (found := _OWN.match(line))), "")
