"""Tables of results with a short name, figures averaged over frames, and the files of a protocol's document."""

from __future__ import annotations

import filecmp
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.files.folder import check_new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs import Outcome
from rtof_kin.reporting import document
from rtof_kin.reporting.document import Cell, Document

NAME: Final = "tables"  #: Of the document: its files are ``tables.json`` and ``tables.md``


STILL, LOW_PASSED = "no motion", "truth low-passed at 6 Hz"
"""Names of the rows that calibrate errors of acceleration and jerk."""
CALIBRATION: Final = frozenset((STILL, LOW_PASSED))


_LONG: Final = 30


class Table(document.Table):
    """A table of results; a missing figure is '-'."""

    name: str
    """Short name, as in JSON."""

    def __init__(
        self,
        name: str,
        title: str,
        columns: Sequence[str],
        digits: Sequence[int],
        rows: Sequence[Sequence[Cell]],
        notes: Sequence[str] = (),
    ) -> None:
        short = all(len(cell) < _LONG for row in rows for cell in row if isinstance(cell, str))
        kind = "errors" if short else ""  # words of short cells stay in one line
        super().__init__(tuple(columns), tuple(rows), title, tuple(notes), tuple(digits), kind)
        object.__setattr__(self, "name", name)

    def text(self, missing: str = "-") -> list[list[Any]]:
        """Return the cells as texts."""
        return super().text(missing)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; figures unrounded."""
        rows = [[None if isinstance(c, float) and not np.isfinite(c) else c for c in row] for row in self.rows]
        return {"title": self.title, "columns": self.columns, "rows": rows, "notes": self.notes}


def write_results(found: Document, folder: Path, json_file: Path | None = None, overwrite: bool = False) -> list[Path]:
    """Write a document and ``tables.md`` into a folder, and the JSON also elsewhere if asked; return the paths.

    The folder's own files are replaced; for `json_file` see `check_json_file`. `OutputExistsError`: `json_file` exists
    already; `RtofError`: one of them cannot be written.
    """
    if json_file is not None:
        check_json_file(folder, json_file, overwrite)
    text = "\n".join(table.markdown() for table in found.printed if isinstance(table, Table))
    write_text(folder / f"{NAME}.md", f"{found.headline}\n\n{text}", overwrite=True)
    written = [folder / f"{NAME}.md", *document.write_files(found, folder)]
    if json_file is not None:
        write_text(json_file, (folder / found.marker).read_text(encoding="utf-8"), overwrite=True)
        written.append(json_file)
    return written


def check_json_file(folder: Path, json_file: Path, overwrite: bool) -> None:
    """Check that a file may be written: it is new, a copy of the folder's own JSON, or may be replaced.
    `OutputExistsError`: another file exists.
    """
    before = folder / f"{NAME}.json"
    if not (json_file.is_file() and before.is_file() and filecmp.cmp(json_file, before, shallow=False)):
        check_new_file(json_file, overwrite)


def rows_of(outcome: Outcome) -> Iterator[dict[str, Any]]:
    """Yield one flat row for every take, camera and method that was measured."""
    for facts in outcome.done.values():
        about = {name: facts[name] for name in ("subject", "take", "camera")}
        for method, figures in facts["methods"].items():
            yield about | {"method": method} | figures


def pooled(rows: Iterable[Mapping[str, Any]], figure: str, weight: str = "frames") -> float | None:
    """Return the mean of a figure over all frames of rows (`rows_of`) that have it; None without any."""
    known = [
        (row[figure], row[weight])
        for row in rows
        if row.get(figure) is not None and np.isfinite(row[figure]) and row[weight] > 0
    ]
    if not known:
        return None
    values, weights = np.array(known, dtype=float).T
    return float(np.average(values, weights=weights))
