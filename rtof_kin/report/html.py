"""HTML building blocks of a report: tables, badges, and the page's template with its script and style.

The page is one file that opens offline. Text is escaped, or embedded as JSON without markup; a content
security policy allows only the script and style of the page, and no network access.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any, Final

from rtof_kin.report.audit_results import Grade

_ASSETS: Final = Path(__file__).parent / "assets"
_SCRIPTS: Final = ("unpack.js", "charts.js", "scene.js", "player.js", "start.js")


def fill_template(parts: Mapping[str, str], plots: Mapping[str, Any]) -> str:
    """Return the page.

    Args:
        parts: name in the template -> HTML. plots: data for the script.
    """
    style, script = asset("page.css"), "".join(asset(name) for name in _SCRIPTS)
    data = json.dumps(plots, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        data = data.replace(character, f"\\u{ord(character):04x}")
    own = {"style": style, "style_hash": source_hash(style), "script": script}
    return fill(asset("page.html"), {**parts, **own, "script_hash": source_hash(script), "data": data})


def fill(template: str, parts: Mapping[str, str]) -> str:
    """Return a template with its ``{{name}}`` replaced.

    Args:
        template: HTML. parts: name -> HTML, of all names in the template.
    """
    out = []
    for piece in template.split("{{"):
        name, closed, rest = piece.partition("}}")
        out.append(parts[name] + rest if closed else piece)
    return "".join(out)


def asset(name: str) -> str:
    """Return a style sheet, script or template of the report.

    Args:
        name: of the file.
    """
    return (_ASSETS / name).read_text(encoding="utf-8")


def source_hash(text: str) -> str:
    """Return the hash of an inline script or style for the content security policy.

    Args:
        text: of the script or style.
    """
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def table(header: Iterable[str], rows: Iterable[Iterable[str]], kind: str = "") -> str:
    """Return a table.

    Args:
        header: text. rows: cells that are HTML. kind: CSS class.
    """
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>'


def definitions(rows: Iterable[Iterable[str]]) -> str:
    """Return the entries of a definition list from pairs of texts."""
    return "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)


def bullets(texts: Iterable[str]) -> str:
    """Return a bullet list, or nothing for no texts."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if items else ""


def badge(grade: Grade) -> str:
    """Return a coloured label."""
    return f'<span class="grade {grade.value.replace(" ", "-")}">{grade.value}</span>'
