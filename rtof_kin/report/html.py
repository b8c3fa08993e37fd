"""The page of a report, one file that opens offline: text and tables as HTML, drawings by its own script.

Everything that comes from files or options is escaped, or travels as JSON that holds no markup. A content
security policy lets the page run its own script and style alone, and nothing from a network.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from rtof_kin.report.plot_data import Data

_ASSETS = Path(__file__).parent / "assets"
_SCRIPTS = ("unpack.js", "charts.js", "player.js", "start.js")
_DRAWN = ("angles", "cycles", "player", "bands")
"""Parts of the data that the script draws."""
_NO_LIMIT = "no limit"


def page_html(data: Data) -> str:
    """The whole page.

    Args:
        data: of `page_data`.
    """
    style, script = _asset("page.css"), "".join(_asset(name) for name in _SCRIPTS)
    parts = {
        "style_hash": _hash(style),
        "script_hash": _hash(script),
        "style": style,
        "script": script,
        "data": _json({name: data[name] for name in _DRAWN}),
        "title": escape(data["title"]),
        "headline": _badge(data["headline"]["grade"]) + " " + escape(data["headline"]["text"]),
        "read_from_it": escape(data["read_from_it"]),
        "header": _pairs(data["header"]),
        "verdicts": _verdicts(data),
        "audit": _audit(data["findings"]),
        "calibration": _calibration(data["calibration"]),
        "ranges": _ranges(data["ranges"]),
        "gait": _gait(data["gait"]),
        "torques": _torques(data["torques"]),
        "drawn_hz": f"{data['drawn_hz']:.3g}",
        "bands": _bands_text(data["bands"]),
        "isb": _isb(data["isb"]),
        "citation": escape(data["citation"]),
        "acknowledgement": escape(data["acknowledgement"]),
    }
    out = []
    for piece in _asset("page.html").split("{{"):
        name, closed, rest = piece.partition("}}")
        out.append(parts[name] + rest if closed else piece)
    return "".join(out)


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """As a content security policy names an inline script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json(data: Any) -> str:
    """JSON without anything that HTML would take for markup."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _cell(value: Any, unit: str = "") -> str:
    if value is None:
        return ""
    text = f"{value:.3g}" if isinstance(value, float) else str(value)
    return escape(f"{text} {unit}".rstrip())


def _table(header: Iterable[str], rows: Iterable[Iterable[str]], kind: str = "") -> str:
    """A table of cells that are HTML already."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>'


def _pairs(rows: Iterable[Iterable[str]]) -> str:
    return "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)


def _badge(grade: str) -> str:
    return f'<span class="grade {escape(grade.replace(" ", "-"))}">{escape(grade)}</span>'


def _verdicts(data: Data) -> str:
    rows = []
    for verdict in data["verdicts"]:
        reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict["reasons"])
        why = f"<ul>{reasons}</ul>" if reasons else "every figure is within its limits"
        rows.append((escape(verdict["title"]), _badge(verdict["grade"]), why))
    return _table(("section", "verdict", "why"), rows, "verdicts")


def _audit(findings: Iterable[Data]) -> str:
    def limit(value: float | None, unit: str) -> str:
        if value is None:
            return _NO_LIMIT
        return _cell(value, unit) if value >= 0 else "any"

    rows = (
        (escape(f["section"]), escape(f["subject"]), escape(f["name"]), _cell(f["value"], f["unit"]),
         limit(f["warn"], f["unit"]), limit(f["fail"], f["unit"]), _badge(f["grade"]),
         escape(f["note"] if f["grade"] != "pass" else ""), escape(f["source"]))
        for f in findings
    )  # fmt: skip
    columns = ("section", "of", "figure", "value", "warns above", "fails above", "", "note", "limits")
    return _table(columns, rows, "audit")


def _calibration(found: Any) -> str:
    if not isinstance(found, dict):
        return "<p>Nothing was estimated from the recording: everything is taken as it was given.</p>"
    rows = ((escape(str(cell)) for cell in row) for row in found.get("rows", []))
    return _table(map(str, found.get("columns", [])), rows)


def _ranges(rows: Iterable[Data]) -> str:
    def cells(found: Data | None) -> tuple[str, ...]:
        if found is None:
            return ("", "", "")
        low, high, extent = (_whole(found[name]) for name in ("low", "high", "range"))
        missing = f" <small>seen {100 * found['known']:.0f} %</small>" if found["known"] < 0.995 else ""
        return (f"{low} to {high}" if low else "", f"<b>{extent}</b>{missing}", _whole(found["speed"]))

    out = []
    for row in rows:
        right, left = row.get("right"), row.get("left", None)
        both = row.get("both")
        difference = ""
        if right and left and None not in (right["range"], left["range"]):
            difference = f"{round(right['range'] - left['range']) + 0:+d}"
        sides = (*cells(both), "", "", "") if both else (*cells(right), *cells(left))
        out.append((escape(row["name"]), *sides, difference))
    columns = ("angle [deg]", "right: from, to", "range", "peak deg/s", "left: from, to", "range",
               "peak deg/s", "range right - left")  # fmt: skip
    return _table(columns, out, "ranges") if out else "<p>No angle was seen at all.</p>"


def _whole(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}"


def _gait(gait: Data) -> str:
    def cell(found: Data | None) -> str:
        if found is None:
            return ""
        spread = f" &plusmn; {found['sd']:.2g}" if found["sd"] is not None else ""
        return f"{found['mean']:.3g}{spread} ({found['n']})"

    notes = "".join(f"<li>{escape(note)}</li>" for note in gait["notes"])
    notes = f"<ul>{notes}</ul>" if notes else ""
    if not gait["rows"]:
        return "<p>No gait cycle was found, so there are no curves over one.</p>" + notes
    rows = (
        (escape(f"{row['name']} {row['unit']}"), cell(row.get("right")), cell(row.get("left")),
         "" if row["symmetry"] is None else f"{row['symmetry']:+.1f} %")
        for row in gait["rows"]
    )  # fmt: skip
    header = ("mean, standard deviation (strides)", "right", "left", "(right - left) / mean")
    return _table(header, rows) + notes


def _torques(rows: list[Data]) -> str:
    if not rows:
        return "<p>Not computed: no weight is given, and torques are proportional to it.</p>"
    cells = (
        (escape(row["clinical"]), escape(row["name"]), _cell(row["peak"]), _cell(row["per_kg"]),
         f"{100 * row['known']:.0f} %")
        for row in rows
    )  # fmt: skip
    return _table(("turn", "revolute of the URDF", "peak N m", "peak N m/kg", "told"), cells)


def _bands_text(bands: bool) -> str:
    if bands:
        return "Bands are 95 % intervals of the motion's own confidence."
    return "There are no bands: the mode that made this motion does not say how certain it is."


def _isb(items: Iterable[Data]) -> str:
    blank = '<span class="blank">to be filled in:</span>'
    rows = []
    topic = ""
    for item in items:
        known = item["known"]
        text = blank if known is None else escape(known) + (f" {blank}" if known.endswith(":") else "")
        rows.append((escape(item["topic"] if item["topic"] != topic else ""), escape(item["name"]), text))
        topic = item["topic"]
    return _table(("", "to state", "in this recording"), rows, "isb")
