"""Tables of the errors of joint angles: ours, and ours beside published values of the same metric."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angle_errors import ALL, AngleErrors
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import can_draw
from rtof_kin.protocols.published_angles import METRICS, PUBLISHED, WITHOUT_METRIC, Metric
from rtof_kin.protocols.tables import Table, write_tables

CSV, PAGE = "angle_errors.csv", "angle_errors.html"
_COLUMNS: Final = (
    "joint angle",
    "movement",
    "takes",
    "samples",
    "RMSE",
    "mean abs.",
    "median abs.",
    "RMSE, no offset",
    "offset",
    "in 95 % band",
)
_DIGITS: Final = (0, 0, 0, 0, 1, 1, 1, 1, 1, 0)
_NOTES: Final = (
    "Degrees; estimate minus reference. Both sides of a joint are pooled. Offset: mean difference. No "
    "offset: RMSE after each take's own mean difference of each angle is removed.",
    "In 95 % band: percent of the samples within 1.96 of the estimate's own standard deviations of the "
    "reference, whose own errors and definition count as errors here.",
    "Samples are pooled and not independent: the number of takes says how sure a value is.",
)
_STYLE: Final = (
    "body{font:15px/1.45 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}"
    "table{border-collapse:collapse;margin:1rem 0}td,th{padding:.25rem .7rem;border-bottom:1px solid #ddd;"
    "text-align:right}.text{text-align:left}.first{font-weight:600}"
    "p{max-width:60rem}svg{max-width:100%;height:auto}"
)


def error_table(rows: Sequence[AngleErrors], title: str, notes: Sequence[str] = ()) -> Table:
    """Return the table of errors by joint angle and class of movement.

    Args:
        rows: see `error_rows`.
    """
    return Table("angles", title, _COLUMNS, _DIGITS, tuple(map(_cells, rows)), (*notes, *_NOTES))


def _cells(row: AngleErrors) -> tuple[str | float | None, ...]:
    angles = (row.rmse, row.mae, row.median, row.offset_removed, row.offset)
    degrees = [float(np.degrees(angle)) for angle in angles]
    within = 100 * row.within if np.isfinite(row.within) else None
    name = "all angles" if row.angle == ALL else row.angle.replace("_", " ")
    movement = "all" if row.movement == ALL else row.movement
    return (name, movement, float(row.takes), float(row.samples), *degrees, within)


def published_table(rows: Sequence[AngleErrors]) -> Table:
    """Return published values, each beside ours of the same metric and joint angle over all movements.

    Args:
        rows: see `error_rows`.
    """
    ours = {row.angle: row for row in rows if row.movement == ALL}
    cells = []
    for value in PUBLISHED:
        row = ours.get(value.angle)
        own = None if row is None else float(np.degrees(getattr(row, value.metric)))
        name = "all angles" if value.angle == ALL else value.angle.replace("_", " ")
        cells.append((name, METRICS[value.metric], own, value.degrees, value.system, value.source))
    columns = ("joint angle", "metric", "ours", "published", "system", "source")
    notes = (
        "Degrees. The same metric, but other people, movements, references and sets of angles: no ranking.",
        WITHOUT_METRIC,
    )
    return Table(
        "published", "Beside published values of the same metric", columns, (0, 0, 1, 1, 0, 0), tuple(cells), notes
    )


def plain_rows(rows: Sequence[AngleErrors]) -> list[dict[str, Any]]:
    """Return rows as plain values with units in their names; None where there is no value.

    Args:
        rows: see `error_rows`.
    """
    out = []
    for row in rows:
        angles = {
            f"{name}_deg": float(np.degrees(getattr(row, name)))
            for name in ("rmse", "mae", "median", "offset_removed", "offset")
        }
        within = row.within if np.isfinite(row.within) else None
        out.append(
            {"angle": row.angle, "movement": row.movement, "takes": row.takes, "samples": row.samples}
            | angles
            | {"within_95_share": within}
        )
    return out


def write_angle_tables(
    folder: Path, rows: Sequence[AngleErrors], tables: Sequence[Table], first: str, facts: Mapping[str, Any]
) -> list[Path]:
    """Write ``tables.md``, ``tables.json``, `CSV` and the page with the figure into a folder.

    Args:
        folder: its own files of these names are replaced. first: the sentence that a reader sees first.

    Returns:
        The paths written.

    Raises:
        RtofError: one of them cannot be written.
    """
    make_folders(folder)
    written = write_tables(folder, tables, {"first": first, "rows": plain_rows(rows)} | dict(facts))
    write_text(folder / "tables.md", f"{first}\n\n" + "\n".join(t.markdown() for t in tables), overwrite=True)
    text = io.StringIO(newline="")
    plain = plain_rows(rows)
    lines = csv.DictWriter(text, list(plain[0]) if plain else ["angle"], lineterminator="\n")
    lines.writeheader()
    lines.writerows(plain)
    write_text(folder / CSV, text.getvalue(), overwrite=True)
    write_text(folder / PAGE, _page(rows, tables, first), overwrite=True)
    return [*written, folder / CSV, folder / PAGE]


def _page(rows: Sequence[AngleErrors], tables: Sequence[Table], first: str) -> str:
    picture = _figure(rows) if can_draw() and rows else ""
    body = "".join(map(_html, tables))
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}"><title>Errors of joint angles</title>'
        f"<style>{_STYLE}</style></head><body><h1>Errors of joint angles</h1>"
        f'<p class="first">{escape(first)}</p>'
        f"{picture}{body}</body></html>\n"
    )


def _html(table: Table) -> str:
    texts = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]
    kinds = [' class="text"' if text else "" for text in texts]
    head = "".join(f"<th{kind}>{escape(name)}</th>" for kind, name in zip(kinds, table.columns, strict=True))
    lines = []
    for shown in table.text():
        cells = zip(kinds, shown, strict=True)
        lines.append("<tr>" + "".join(f"<td{kind}>{escape(text)}</td>" for kind, text in cells) + "</tr>")
    notes = "".join(f"<p>{escape(note)}</p>" for note in table.notes)
    return f"<h2>{escape(table.title)}</h2><table><tr>{head}</tr>{''.join(lines)}</table>{notes}"


def _figure(rows: Sequence[AngleErrors]) -> str:
    """Return a figure as SVG: three metrics of every joint angle, and published values in their colours."""
    from matplotlib.figure import Figure

    own = [row for row in rows if row.movement == ALL]
    colours: dict[Metric, str] = {"rmse": "#4c78a8", "mae": "#e08214", "median": "#2a9d5c"}
    figure = Figure(figsize=(9.5, 1.2 + 0.34 * len(own)), layout="constrained")
    axes = figure.subplots()
    for height, row in enumerate(own):
        for metric, colour in colours.items():
            value = np.degrees(getattr(row, metric))
            axes.plot(value, height, "o", color=colour, label=f"ours, {METRICS[metric]}" if not height else None)
            for published in PUBLISHED:
                if (published.angle, published.metric) == (row.angle, metric):
                    axes.plot(published.degrees, height, "D", mfc="none", color=colour)
    axes.plot([], [], "D", mfc="none", color="#555555", label="published, in the colour of its metric")
    names = ("all angles" if row.angle == ALL else row.angle.replace("_", " ") for row in own)
    axes.set_yticks(range(len(own)), list(names))
    axes.set_ylim(len(own) - 0.4, -0.6)
    axes.set_xlim(left=0)
    axes.set_xlabel("error [degrees]")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return text.getvalue()[text.getvalue().index("<svg") :]
