"""Pages of a batch: one row for each recording, the worst verdict first, with links to the reports.

Pages are single files that open offline and without a script. The browser does not lay out rows that are
out of sight, so that ten thousand open at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final
from urllib.parse import quote

from rtof_kin.batch.rows import DONE, ERROR, WORST_FIRST, Row
from rtof_kin.core.files.text import write_text
from rtof_kin.reporting.html import asset, fill, source_hash

ROWS_PER_PAGE: Final = 10_000
INDEX_PAGE: Final = "index.html"
_GRADES: Final = {ERROR: "fail", DONE: "pass"}
"""Colours of verdicts that are no grades."""


def write_index(out: Path, rows: Sequence[Row], total: int, source: str) -> None:
    """Write ``index.html``, and ``index-2.html`` and so on where there are very many recordings.

    Args:
        rows: worst first.
    """
    pages = [rows[k : k + ROWS_PER_PAGE] for k in range(0, len(rows), ROWS_PER_PAGE)] or [()]
    for number, part in enumerate(pages, start=1):
        page = _page(part, number, len(pages), _opening(rows, total), source)
        write_text(out / _page_name(number), page, overwrite=True)
    number = len(pages) + 1
    while (left := out / _page_name(number)).is_file():  # of a run with more recordings
        left.unlink()
        number += 1


def _page(rows: Sequence[Row], number: int, pages: int, opening: str, source: str) -> str:
    style = asset("page.css") + asset("batch.css")
    others = " ".join(
        f"<b>{k}</b>" if k == number else f'<a href="{_page_name(k)}">{k}</a>' for k in range(1, pages + 1)
    )
    parts = {
        "title": escape(f"Batch of {source}"),
        "style": style,
        "style_hash": source_hash(style),
        "opening": opening,
        "rows": "\n".join(map(_row, rows)),
        "pages": f'<nav aria-label="pages">Page {others}</nav>' if pages > 1 else "",
    }
    return fill(asset("batch.html"), parts)


def _page_name(number: int) -> str:
    return INDEX_PAGE if number == 1 else f"index-{number}.html"


def _opening(rows: Sequence[Row], total: int) -> str:
    counts = Counter(row.verdict for row in rows)
    texts = [f"{_badge(verdict)} {counts[verdict]}" for verdict in WORST_FIRST if counts[verdict]]
    waiting = f"; {total - len(rows)} are not done" if len(rows) < total else ""
    minutes, hours = sum(row.duration_s for row in rows) / 60, sum(row.seconds for row in rows) / 3600
    about = f"{minutes:.1f} minutes of motion, {hours:.2f} hours of work."
    return f"<p>{len(rows)} of {total} recordings{waiting}. {about}</p>\n<p>{' '.join(texts)}</p>"


def _badge(verdict: str) -> str:
    kind = _GRADES.get(verdict, verdict.replace(" ", "-"))
    return f'<span class="grade {escape(kind)}">{escape(verdict)}</span>'


def _row(row: Row) -> str:
    folder = quote(row.recording)
    name = escape(row.recording)
    if row.report:
        name = f'<a href="{folder}/{quote(row.report)}">{name}</a>'
    why = escape(row.sentence)
    if row.verdict == ERROR:
        why = f"{escape(row.step)}: {escape(row.error)}" if row.step else escape(row.error)
    if row.log:
        why += f' <a class="log" href="{folder}/{quote(row.log)}">log</a>'
    figures = f"{row.duration_s:.1f} s" if row.frames else ""
    return (
        f"<tr><td>{_badge(row.verdict)}</td><th scope=row>{name}</th><td>{why}</td><td>{figures}</td>"
        f"<td>{row.seconds:.1f} s</td><td>{row.output_mb:.1f} MB</td></tr>"
    )
