"""HTML building blocks of a report: tables, badges, and the page's template with its script and style.

The page is one file that opens offline. Text is escaped, or embedded as JSON without markup; a content
security policy allows only the script and style of the page, and no network access.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from rtof_kin.reporting.audit_results import Grade

_ASSETS: Final = Path(__file__).parent / "assets"
GRADE_WORDS: Final = {
    Grade.PASS: "good",
    Grade.WARN: "use with care",
    Grade.FAIL: "do not use",
    Grade.WEAK: "not verified",
    Grade.NOT_CHECKED: "not checked",
    Grade.INFORMATION: "for information",
}
"""What a grade means to the reader of a page."""
_SCRIPTS: Final = ("unpack.js", "charts.js", "scene.js", "player.js", "start.js")


@cache
def _environment() -> Environment:
    """Templates of the assets; what stands in them is escaped."""
    environment = Environment(
        loader=FileSystemLoader(_ASSETS),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters["source_hash"] = source_hash
    return environment


def render(template: str, styles: Iterable[str], scripts: Iterable[str] = (), **parts: Any) -> str:
    """Return a page of a template of the assets, in one file that opens offline.

    Args:
        template: extends ``base.html``. styles, scripts: assets, joined in this order; a page without scripts has
            a policy that allows none. parts: of the template; text is escaped unless it is `markupsafe.Markup`.
    """
    style, script = (Markup("".join(map(asset, names))) for names in (styles, scripts))
    return _environment().get_template(template).render(style=style, script=script, **parts)


def fill_template(parts: Mapping[str, str], plots: Mapping[str, Any], foot: str = "") -> str:
    """Return the page."""
    style = asset("page.css") + fill(asset("report.css"), {"foot": css_string(foot)})
    return self_contained("page.html", style, _SCRIPTS, parts, plots)


def self_contained(
    template: str, style: str, scripts: Iterable[str], parts: Mapping[str, str], plots: Mapping[str, Any]
) -> str:
    """Return a page with its style, script and data, and their hashes for the content security policy."""
    script = "".join(asset(name) for name in scripts)
    data = json.dumps(plots, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        data = data.replace(character, f"\\u{ord(character):04x}")
    own = {"style": style, "style_hash": source_hash(style), "script": script}
    return fill(asset(template), {**parts, **own, "script_hash": source_hash(script), "data": data})


def fill(template: str, parts: Mapping[str, str]) -> str:
    """Return a template with its ``{{name}}`` replaced."""
    out = []
    for piece in template.split("{{"):
        name, closed, rest = piece.partition("}}")
        out.append(parts[name] + rest if closed else piece)
    return "".join(out)


def asset(name: str) -> str:
    """Return a style sheet, script or template of the report."""
    return (_ASSETS / name).read_text(encoding="utf-8")


def source_hash(text: str) -> str:
    """Return the hash of an inline script or style for the content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def css_string(text: str) -> str:
    """Return a text as a string of a style sheet, with everything but ASCII letters and digits escaped.

    Args:
        text: any.
    """
    own = (c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in text if c.isprintable())
    return f'"{"".join(own)}"'


def table(
    header: Iterable[str],
    rows: Iterable[Iterable[str]],
    kind: str = "",
    caption: str = "",
    row_headers: bool = False,
    shown: Iterable[str] = (),
    further: Iterable[bool] = (),
) -> str:
    """Return a table, which a narrow screen shows as one card for each row.

    Args:
        caption: text; none without. row_headers: whether the first cell of a row is its header.
        shown: `AngleName.shown` of each row; all are always shown without.
        further: whether a narrow screen shows each row only if asked to.
    """
    names = [escape(name) for name in header]
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    within, less = [*shown], [*further]
    body = []
    for number, row in enumerate(map(list, rows)):
        only = f' data-in="{within[number]}"' if within else ""
        only += ' class="further"' if less and less[number] else ""
        cells = [f'<td data-label="{name}">{cell}</td>' for name, cell in zip(names, row, strict=True)]
        if row_headers:
            cells[0] = f'<th scope="row">{row[0]}</th>'
        body.append(f"<tr{only}>{''.join(cells)}</tr>")
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    top = f'<table class="{f"stack {kind}".strip()}">{title}<thead><tr>{head}</tr></thead>'
    return "\n".join((top, "<tbody>", *body, "</tbody></table>"))


def folded(summary: str, inside: str) -> str:
    """Return a part that is folded until it is asked for, and not printed while it is."""
    return f"<details><summary>{escape(summary)}</summary>\n{inside}\n</details>"


def definitions(rows: Iterable[Iterable[str]]) -> str:
    """Return the entries of a definition list from pairs of texts."""
    return "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)


def bullets(texts: Iterable[str]) -> str:
    """Return a bullet list, or nothing for no texts."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if items else ""


def badge(grade: Grade, word: str = "") -> str:
    """Return a label, told apart by colour, sign and word.

    Args:
        word: in place of that of `GRADE_WORDS`.
    """
    kind = grade.value.replace(" ", "-")
    return f'<span class="grade {kind}">{escape(word or GRADE_WORDS[grade])}</span>'
