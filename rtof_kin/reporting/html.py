"""HTML building blocks of a report: tables, badges, and the page's template with its script and style.

The page is one file that opens offline. Text is escaped, or embedded as JSON without markup; a content
security policy allows only the script and style of the page, and no network access.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

_ASSETS: Final = Path(__file__).parent / "assets"


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


def render(template: str, styles: Iterable[str], scripts: Iterable[str] = (), rules: str = "", **parts: Any) -> str:
    """Return a page of a template that extends ``base.html``, in one file that opens offline.

    Styles and scripts are assets, joined in this order; a page without scripts has a policy that allows none. Further
    `rules` end the style sheet. Text in parts is escaped unless it is `markupsafe.Markup`.
    """
    style, script = Markup("".join(map(asset, styles)) + rules), Markup("".join(map(asset, scripts)))
    return _environment().get_template(template).render(style=style, script=script, **parts)


def asset(name: str) -> str:
    """Return a style sheet, script or template of the report."""
    return (_ASSETS / name).read_text(encoding="utf-8")


def source_hash(text: str) -> str:
    """Return the hash of an inline script or style for the content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def css_string(text: str) -> str:
    """Return a text as a string of a style sheet, with everything but ASCII letters and digits escaped."""
    own = (c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in text if c.isprintable())
    return f'"{"".join(own)}"'
