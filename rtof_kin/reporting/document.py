"""A document: what a study has to say, and its four writers: terminal, JSON, CSV and HTML.

A study makes one `Document` of its result. `show` prints it, `write` makes a folder of it: ``NAME.json`` with the
sentences and facts, a CSV file for each of its `tables`, the figures as PNG, and ``NAME.html``, one page that opens
offline, if it has `sections`.

A cell is a text, a number, or None (also NaN) where there is none. `Badge` is a text with a grade, and
`markupsafe.Markup` a text with HTML in it; both are plain text elsewhere than on the page.
"""

from __future__ import annotations

import base64
import csv
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from markupsafe import Markup

from rtof_kin.core.files.folder import new_file, new_folder
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import can_draw
from rtof_kin.reporting.audit_results import Grade
from rtof_kin.reporting.html import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot
    from rich.console import Console

Cell = str | float | None
STYLES: Final = {"pass": "green", "plausible": "cyan", "warn": "yellow", "fail": "bold red"}
"""Style of a badge on the terminal by grade."""
GRADE_WORDS: Final = {
    Grade.PASS: "good",
    Grade.PLAUSIBLE: "plausible",
    Grade.WARN: "use with care",
    Grade.FAIL: "do not use",
    Grade.WEAK: "not verified",
    Grade.NOT_CHECKED: "not checked",
    Grade.INFORMATION: "for information",
}
"""What a grade means to the reader of a page."""
ESTIMATE, TRUTH = "#c0392b", "#2e8b57"  #: Colours of figures
_LEAST: Final = 16  # characters of a column of words on a narrow terminal, if it has longer ones
_CHARTS: Final = ("unpack.js", "charts.js", "comparison.js")
_NUMBER: Final = re.compile(r"[-+<>= (]*[\d.]|$")


class Badge(str):
    """A text with a grade, shown by colour, sign and word."""

    grade: str  #: 'pass', 'plausible', 'warn', 'fail', 'not-checked', ..., as in the style sheet

    def __new__(cls, word: str, grade: str) -> Self:
        """Make a badge of a word."""
        badge = super().__new__(cls, word)
        badge.grade = grade
        return badge


@dataclass(frozen=True)
class Table:
    """A table, with units in the names of its columns."""

    columns: Sequence[str]
    rows: Iterable[Sequence[Cell]]  #: In CSV and JSON with all digits
    title: str = ""
    notes: Sequence[str] = ()  #: Sentences under the table
    digits: Sequence[int | None] = ()
    """Digits after the point in each column, for readers; None: up to six significant ones."""
    kind: str = ""  #: Class in the style sheet
    row_headers: bool = False  #: Whether the first cell of a row is its header
    attributes: Sequence[Mapping[str, str]] = ()  #: HTML attributes of each row

    @classmethod
    def of(cls, records: Sequence[Mapping[str, Cell]]) -> Self:
        """Return the table of rows by column, at least one."""
        return cls(tuple(records[0]), [tuple(record.values()) for record in records])

    def text(self, missing: str = "") -> list[list[Any]]:
        """Return the cells as texts, `missing` for None and NaN; badges and HTML remain what they are."""
        digits = self.digits or (None,) * len(self.columns)
        return [[_shown(cell, own, missing) for cell, own in zip(row, digits, strict=True)] for row in self.rows]

    def records(self) -> list[dict[str, Any]]:
        """Return the rows as JSON data, by column."""
        return [dict(zip(self.columns, map(_known, row), strict=True)) for row in self.rows]

    def markdown(self) -> str:
        """Return the table with its title and notes as Markdown."""
        lines = [f"### {self.title}", "", f"| {' | '.join(self.columns)} |", "|---" * len(self.columns) + "|"]
        for row in self.text("-"):  # a message may have lines and bars of its own
            lines.append("| " + " | ".join(" ".join(_plain(cell).split()).replace("|", "\\|") for cell in row) + " |")
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes)]) + "\n"


@dataclass(frozen=True)
class Figure:
    """A figure, drawn when it is written, where matplotlib is installed."""

    name: str  #: Path in the folder without suffix, e.g. 'figures/gait'.
    alt: str  #: What it shows, for those who cannot see it
    draw: Callable[[], Plot]


@dataclass(frozen=True)
class Section:
    """A part of the page: paragraphs, HTML, lists (tuples), definitions (mappings), tables, figures, sections."""

    name: str  #: Identifier; '' within other sections
    title: str
    parts: Sequence[str | Markup | tuple[str, ...] | Mapping[str, str] | Table | Figure | Section]
    folded: bool = False  #: Whether it is opened by the reader, and not printed unless opened


@dataclass(frozen=True)
class Document:
    """What a study has to say."""

    name: str  #: Of its files, without suffix
    title: str
    headline: str  #: The sentence that a reader sees first
    sentences: Sequence[str] = ()  #: Those that follow it
    cautions: Sequence[str] = ()  #: What to be careful about
    alarm: bool = False  #: Whether the headline says that the result may be worthless
    printed: Sequence[Table | str] = ()  #: What the terminal shows below the sentences
    sections: Sequence[Section] = ()  #: Of the page; without any there is no page
    figures: Sequence[Figure] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)  #: Name of a CSV file -> all of its rows
    facts: Mapping[str, Any] | None = field(default_factory=dict)
    """JSON data with units in the names, beside 'sentences' and 'cautions'; None: no JSON file of the document."""
    data: Mapping[str, Any] = field(default_factory=dict)  #: Name of a further JSON file -> its data
    lead: Markup = Markup()  # noqa: RUF009
    """HTML below the sentences."""
    charts: Mapping[str, Any] | None = None  #: Data of the interactive charts of the page

    @property
    def marker(self) -> str:
        """Name of the file by which a folder of this kind is known: the JSON, without one the first table."""
        return f"{self.name}.json" if self.facts is not None else next(iter(self.tables))

    def plain(self) -> dict[str, Any]:
        """Return the JSON data."""
        said = {"sentences": [self.headline, *self.sentences], "cautions": list(self.cautions)}
        return {"headline": self.headline} | said | dict(self.facts or {})


# --- writers -------------------------------------------------------------------------------------


def show(document: Document, out: Console) -> None:
    """Print a document to a terminal."""
    out.print(document.headline, style="bold red" if document.alarm else "bold", soft_wrap=True)
    for line in document.sentences:
        out.print(line, style="bold", soft_wrap=True)
    for line in document.cautions:
        out.print(f"caution: {line}", style="yellow", soft_wrap=True)
    for part in document.printed:
        show_table(part, out) if isinstance(part, Table) else out.print(part, soft_wrap=True)


def show_table(table: Table, out: Console) -> None:
    """Print a table to a terminal; columns of numbers are aligned to the right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Column
    from rich.table import Table as Grid
    from rich.text import Text

    rows = table.text()
    right = [
        c > 0 and all(_NUMBER.match(text := _plain(row[c])) and len(text) <= _LEAST for row in rows)
        for c in range(len(table.columns))
    ]
    columns = []
    for c, name in enumerate(table.columns):
        longest = max(len(word) for row in [table.columns, *rows] for word in [*_plain(row[c]).split(), ""])
        side: Any = "right" if right[c] else "left"
        columns.append(Column(name, justify=side, no_wrap=right[c], overflow="fold", min_width=min(longest, _LEAST)))
    grid = Grid(*columns, title=table.title or None, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for row in rows:
        grid.add_row(*(Text(_plain(cell), STYLES.get(getattr(cell, "grade", ""), "")) for cell in row))
    out.print(grid)
    for note in table.notes:
        out.print(note, soft_wrap=True)


def write(
    document: Document, folder: str | Path, overwrite: bool = False, inputs: Mapping[str, str] | None = None
) -> None:
    """Make a folder of a document; it appears complete or not at all. `OutputExistsError`: the folder exists and may
    not be replaced; `WritingError`: it cannot be written.

    Args:
        overwrite: replace an earlier folder of this kind, see `check_replaceable`.
        inputs: fingerprints of what it is made from, for its manifest.
    """
    with new_folder(folder, document.marker, overwrite, inputs) as new:
        write_files(document, new)


def write_files(document: Document, folder: Path) -> list[Path]:
    """Write the files of a document into a folder, each complete or not at all, the JSON last; return their paths."""
    pictures = write_figures(document.figures, folder)
    paths = [folder / f"{figure}.png" for figure in pictures]
    for name, table in document.tables.items():
        write_csv(folder / name, table)
        paths.append(folder / name)
    for name, data in document.data.items():
        write_json(folder / name, data)
        paths.append(folder / name)
    if document.sections:
        paths.append(folder / f"{document.name}.html")
        write_text(paths[-1], page(document, pictures), overwrite=True)
    if document.facts is not None:
        paths.append(folder / document.marker)
        write_json(paths[-1], document.plain())
    return paths


def write_csv(path: Path, table: Table) -> None:
    """Write the rows of a table, one after the other; a cell without a value is empty."""
    with new_file(path, overwrite=True) as file, file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(table.columns)
        writer.writerows(["" if (known := _known(cell)) is None else known for cell in row] for row in table.rows)


def write_json(path: Path, data: Any) -> None:
    """Write JSON data without NaN."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n", overwrite=True)


def subplots(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Plot, Any]:
    """Return a figure of some inches without pyplot's global state, and its axes (rows, columns)."""
    from matplotlib.figure import Figure as Plot

    figure = Plot(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def label_panel(ax: Any, title: str, y: str, x: str = "") -> None:
    """Label the axes of a figure in small letters, with a grid."""
    ax.set_title(title, fontsize=9, loc="left")
    ax.set_ylabel(y, fontsize=8)
    ax.grid(alpha=0.3)
    if x:
        ax.set_xlabel(x, fontsize=8)


def write_figures(figures: Iterable[Figure], folder: Path) -> dict[str, bytes]:
    """Draw figures, write them as PNG, and return them by name; none without matplotlib."""
    pictures: dict[str, bytes] = {}
    if not can_draw():
        return pictures
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    for figure in figures:
        path, plot = folder / f"{figure.name}.png", figure.draw()
        plot.set_canvas(FigureCanvasAgg(plot))  # no global pyplot state
        with new_file(path, overwrite=True) as whole:
            plot.savefig(whole)
        pictures[figure.name] = path.read_bytes()
    return pictures


def page(document: Document, pictures: Mapping[str, bytes] | None = None) -> str:
    """Return a document as one HTML page, with the pictures of `write_figures`."""
    images = {name: base64.b64encode(data).decode() for name, data in (pictures or {}).items()}
    return render(
        "document.html",
        styles=("page.css", "document.css"),
        scripts=_CHARTS if document.charts is not None else (),
        data=document.charts,
        document=document,
        images=images,
    )


# --- grades, numbers and words ------------------------------------------------------------------


def badge(grade: Grade, word: str = "") -> Badge:
    """Return the badge of a grade, with a word in place of that of `GRADE_WORDS`."""
    return Badge(word or GRADE_WORDS[grade], grade.value.replace(" ", "-"))


def number(value: Any, digits: int = 6) -> float | None:
    """Return a number with as many significant digits; None, which is null in JSON, for NaN and infinity."""
    return float(f"{float(value):.{digits}g}") if np.isfinite(value) else None


def fixed(value: float, digits: int, sign: bool = False) -> str:
    """Return a number with as many digits after the point, and no sign of zero; '' for NaN and infinity."""
    if not np.isfinite(value):
        return ""
    text = f"{value:{'+' if sign else ''}.{digits}f}"
    return text if float(text) else text.lstrip("-+")


def sentence(text: str) -> str:
    """Return a text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def _known(cell: Cell) -> Cell:
    if isinstance(cell, str):
        return _plain(cell)
    return cell if cell is not None and math.isfinite(cell) else None


def _shown(cell: Cell, digits: int | None, missing: str) -> Any:
    if isinstance(cell, str):
        return cell
    if cell is None or not math.isfinite(cell):
        return missing
    return f"{cell:.6g}" if digits is None else f"{cell:.{digits}f}"


def _plain(cell: Any) -> str:
    return str(cell.striptags()) if isinstance(cell, Markup) else str(cell)
