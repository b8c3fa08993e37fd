"""Rows of a batch's table, and the files that keep those of each shard.

A row is appended to its shard's file, one line of JSON, as soon as its recording ends; a line that a killed
process left incomplete is ignored. Of several rows of one recording the one of the latest run counts: runs
are numbered, since clocks may differ or be set back.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Self
from urllib.parse import quote

from markupsafe import Markup
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from rtof_kin.core.errors import WritingError
from rtof_kin.core.files.text import write_text
from rtof_kin.reporting.audit_results import Grade
from rtof_kin.reporting.document import Badge, Document, Section, Table
from rtof_kin.reporting.html import render

ERROR: Final = "error"  #: Verdict of a recording on which a command failed
DONE: Final = "done"  #: Verdict of one without a motion, whose commands all succeeded
WORST_FIRST: Final = (
    ERROR,
    *(g.value for g in (Grade.FAIL, Grade.WARN, Grade.WEAK, Grade.NOT_CHECKED, Grade.PLAUSIBLE, Grade.PASS)),
    DONE,
)


@dataclass(frozen=True, config=ConfigDict(allow_inf_nan=False, extra="ignore"))
class Row:
    """What is known of one recording after its commands."""

    recording: str  #: Its name, which is its folder in the output
    verdict: str = ERROR  #: `ERROR`, a `Grade`'s value of the reconstruction, or `DONE`
    sentence: str = ""  #: Why
    step: str = ""  #: Command that failed
    error: str = ""
    frames: int = 0
    duration_s: float = 0.0  #: Of the motion
    certified_deg: float | None = None  #: Error of a segment without its sensor, see `reporting.certificate`
    certified_ratio: float | None = None  #: The same relative to what was stated of it
    seconds: float = 0.0  #: Sum over its commands, of the runs that gave the present results
    cpu_seconds: float = 0.0  #: The same of the processor
    peak_memory_mb: float = 0.0
    output_mb: float = 0.0
    version: str = ""  #: Of this package
    report: str = ""  #: Page of the report in its folder; '' if there is none
    log: str = ""  #: What the last command printed, in its folder

    @classmethod
    def of_plain(cls, plain: Any) -> Self | None:
        """Return a row, or None if it is none."""
        try:
            return TypeAdapter(cls).validate_python(plain)
        except ValidationError:
            return None

    def plain(self) -> dict[str, Any]:
        """Return the row as JSON data."""
        return asdict(self)

    @property
    def severity(self) -> tuple[int, str]:
        """Sort key, worst first."""
        place = WORST_FIRST.index(self.verdict) if self.verdict in WORST_FIRST else len(WORST_FIRST)
        return place, self.recording


Numbered = tuple[int, Row]  #: Number of the run, and its row


class RowFile:
    """Rows of one shard, kept as they come."""

    def __init__(self, path: Path, run: int, rows: Mapping[str, Numbered]):
        """Write the rows of earlier runs anew, without what a killed process left, and open for more."""
        self.path, self.run, self.rows = path, run, dict(rows)
        write_text(path, "".join(_line(n, row) for n, row in rows.values()), overwrite=True)

    def add(self, row: Row) -> None:
        """Append a row; raises WritingError: it cannot be written."""
        self.rows[row.recording] = (self.run, row)
        try:
            with self.path.open("ab", buffering=0) as stream:
                line = _line(self.run, row).encode()
                if stream.write(line) != len(line):
                    raise OSError("no room for a whole line")
        except OSError as error:
            raise WritingError(f"{self.path}: cannot be written ({error}); make room and go on") from error


def read_rows(paths: Iterable[Path]) -> dict[str, Numbered]:
    """Return the latest row of each recording in files of `RowFile`; incomplete lines are ignored."""
    latest: dict[str, Numbered] = {}
    for path in paths:
        for line in path.read_bytes().splitlines():
            try:
                plain = json.loads(line)
                run, row = int(plain["run"]), Row.of_plain(plain["row"])
            except (ValueError, KeyError, TypeError):
                continue
            if row is not None and latest.get(row.recording, (-1, row))[0] <= run:
                latest[row.recording] = (run, row)
    return latest


def _line(run: int, row: Row) -> str:
    return json.dumps({"run": run, "row": row.plain()}, separators=(",", ":")) + "\n"


MOST_ROWS: Final = 10_000  #: On the page, which a browser still opens at once: it lays out only rows in sight
INDEX_PAGE: Final = "index.html"
_COLUMNS: Final = ("Verdict", "Recording", "Why", "Motion", "Work", "Output")
_GRADES: Final = {ERROR: "fail", DONE: "pass"}  #: Colours of verdicts that are no grades


def write_index(out: Path, rows: Sequence[Row], total: int, source: str) -> None:
    """Write ``index.html``, a single file that opens offline and without a script: rows worst first, `MOST_ROWS` of
    very many.
    """
    found = document(rows, total, source)
    page = render("document.html", ("page.css", "document.css", "batch.css"), document=found, images={})
    write_text(out / INDEX_PAGE, page, overwrite=True)


def document(rows: Sequence[Row], total: int, source: str) -> Document:
    """Return a batch as a document."""
    counts = Counter(row.verdict for row in rows)
    waiting = f"; {total - len(rows)} are not done" if len(rows) < total else ""
    more = f" The page has the worst {MOST_ROWS}, batch.csv all." if len(rows) > MOST_ROWS else ""
    minutes, hours = sum(row.duration_s for row in rows) / 60, sum(row.seconds for row in rows) / 3600
    badges = [
        Markup('<span class="grade {}">{}</span> {}').format(_badge(verdict).grade, verdict, counts[verdict])
        for verdict in WORST_FIRST
        if counts[verdict]
    ]
    return Document(
        "index",
        f"Batch of {source}",
        f"{len(rows)} of {total} recordings{waiting}. {minutes:.1f} minutes of motion, {hours:.2f} hours of work."
        f"{more}",
        sections=[Section("recordings", "", [Table(_COLUMNS, list(map(_cells, rows[:MOST_ROWS])), kind="batch")])],
        lead=Markup("<p>{}</p>").format(Markup(" ").join(badges)),
    )


def _badge(verdict: str) -> Badge:
    return Badge(verdict, _GRADES.get(verdict, verdict.replace(" ", "-")))


def _cells(row: Row) -> list[str]:
    folder, name = quote(row.recording), Markup.escape(row.recording)
    if row.report:
        name = Markup('<a href="{}/{}">{}</a>').format(folder, quote(row.report), name)
    why = Markup.escape(row.sentence)
    if row.verdict == ERROR:
        why = Markup.escape(f"{row.step}: {row.error}" if row.step else row.error)
    if row.log:
        why += Markup(' <a class="log" href="{}/{}">log</a>').format(folder, quote(row.log))
    motion = f"{row.duration_s:.1f} s" if row.frames else ""
    return [_badge(row.verdict), name, why, motion, f"{row.seconds:.1f} s", f"{row.output_mb:.1f} MB"]
