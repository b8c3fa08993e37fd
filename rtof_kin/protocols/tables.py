"""Tables of results: one type, written as Markdown and JSON, printed by the command line."""

from __future__ import annotations

import filecmp
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.files.folder import check_new_file
from rtof_kin.core.files.text import write_text

JSON = "tables.json"
Cell = str | float | None
"""Text, a figure, or None."""


@dataclass(frozen=True)
class Table:
    """A table of results with notes."""

    name: str
    """Short name, as in file names."""
    title: str
    """Title."""
    columns: tuple[str, ...]
    """Heading of each column, with its unit."""
    digits: tuple[int, ...]
    """Digits after the point in each column; text ignores them."""
    rows: tuple[tuple[Cell, ...], ...]
    """Cells, a label first."""
    notes: tuple[str, ...] = ()
    """Sentences under the table."""

    def text(self) -> list[list[str]]:
        """Return the cells as text; '-' for None."""
        return [[self._cell(cell, digits) for cell, digits in zip(row, self.digits, strict=True)] for row in self.rows]

    @staticmethod
    def _cell(cell: Cell, digits: int) -> str:
        if isinstance(cell, str):
            return cell
        return "-" if cell is None or not np.isfinite(cell) else f"{cell:.{digits}f}"

    def markdown(self) -> str:
        """Return the table with its title and notes as Markdown."""
        lines = [f"### {self.title}", "", "| " + " | ".join(self.columns) + " |"]
        lines.append("|---" * len(self.columns) + "|")
        for row in self.text():  # a message may have lines and bars of its own
            cells = (" ".join(cell.split()).replace("|", "\\|") for cell in row)
            lines.append("| " + " | ".join(cells) + " |")
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes)]) + "\n"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; figures unrounded."""
        rows = [[None if isinstance(c, float) and not np.isfinite(c) else c for c in row] for row in self.rows]
        return {"title": self.title, "columns": self.columns, "rows": rows, "notes": self.notes}


def write_tables(
    folder: Path, tables: Sequence[Table], facts: dict[str, Any], json_file: Path | None = None, overwrite: bool = False
) -> list[Path]:
    """Write ``tables.md`` and ``tables.json`` into a folder, and the JSON also elsewhere if asked.

    Args:
        folder: its own files are replaced. overwrite: whether it may be replaced, see `check_json_file`.

    Returns:
        The paths written.

    Raises:
        OutputExistsError: `json_file` exists already. RtofError: one of them cannot be written.
    """
    if json_file is not None:
        check_json_file(folder, json_file, overwrite)
    text = "\n".join(table.markdown() for table in tables)
    content = facts | {"tables": {table.name: table.as_dict() for table in tables}}
    document = json.dumps(content, indent=1) + "\n"
    paths = [folder / "tables.md", folder / JSON, *([json_file] if json_file else [])]
    for path, content_text in zip(paths, [text, document, document], strict=False):
        write_text(path, content_text, overwrite=True)
    return paths


def check_json_file(folder: Path, json_file: Path, overwrite: bool) -> None:
    """Check that a file may be written: it is new, a copy of the folder's own JSON, or may be replaced.

    Args:
        folder: with ``tables.json``. overwrite: whether it may be replaced.

    Raises:
        OutputExistsError: another file exists.
    """
    before = folder / JSON
    if not (json_file.is_file() and before.is_file() and filecmp.cmp(json_file, before, shallow=False)):
        check_new_file(json_file, overwrite)


def pooled(rows: Sequence[dict[str, Any]], figure: str, weight: str = "frames") -> float | None:
    """Return the mean of a figure over all frames of rows that have it; None without any.

    Args:
        rows: see `rtof_kin.protocols.measures.rows_of`.
    """
    known = [
        (row[figure], row[weight])
        for row in rows
        if row.get(figure) is not None and np.isfinite(row[figure]) and row[weight] > 0
    ]
    if not known:
        return None
    values, weights = np.array(known, dtype=float).T
    return float(np.average(values, weights=weights))
