"""Live page: one HTML document, and the headers with which it is served."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

from rtof_kin.reporting.html import asset, fill, source_hash

_ASSETS: Final = Path(__file__).parent / "assets"
_SCRIPTS: Final = ("unpack.js", "charts.js", "scene.js")
"""Shared with the report."""


@cache
def _sources() -> tuple[str, str]:
    """Return style sheet and script of the page."""
    style = asset("page.css") + _own("live.css")
    return style, "".join(map(asset, _SCRIPTS)) + _own("live.js")


def _own(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def live_page() -> str:
    """Return the page; it holds no data, which come over a WebSocket of the same host and port."""
    style, script = _sources()
    return fill(_own("live.html"), {"style": style, "script": script})


def page_headers(host: str) -> dict[str, str]:
    """Return HTTP headers of the page: it may run its own script, and connect to its own server only.

    Args:
        host: of the server, ``HOST:PORT`` as the browser names it; checked by the caller.
    """
    style, script = map(source_hash, _sources())
    policy = (
        f"default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data:; "
        f"connect-src ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Security-Policy": policy,
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
