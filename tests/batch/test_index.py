"""Index: the worst first, every text escaped, links that lead to files, and pages that fit a phone."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest
from browser_support import WIDTHS, BrowserPage, needs_browser

from rtof_kin.batch import index
from rtof_kin.batch.rows import Row

ROWS = [
    Row("s1/a & <b>", "error", step="reconstruct", error="<script>alert(1)</script>", log="log/reconstruct.txt"),
    Row("s 2/'c'#", "fail", "it fails", frames=60, duration_s=1.0, report="report.html", log="log/report.txt"),
    Row("d", "weakly observed", "x" * 300, report="report.html"),
    Row("e", "pass", "checked", report="report.html"),
    Row("f", "done"),
]


def test_rows_are_escaped_and_linked(tmp_path: Path) -> None:
    index.write_index(tmp_path, ROWS, 7, "takes <x>")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "Batch of takes &lt;x&gt;" in page
    assert "reconstruct: &lt;script&gt;alert(1)" in page
    links = [unquote(unescape(link)) for link in re.findall('href="([^"]*)"', page)]
    assert links[:3] == ["s1/a & <b>/log/reconstruct.txt", "s 2/'c'#/report.html", "s 2/'c'#/log/report.txt"]
    assert "5 of 7 recordings; 2 are not done" in page
    assert page.index("weakly observed") < page.index(">e<")


def test_very_many_rows_have_pages_and_old_pages_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "ROWS_PER_PAGE", 2)
    index.write_index(tmp_path, ROWS, 5, "takes")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["index-2.html", "index-3.html", "index.html"]
    assert '<a href="index.html">1</a> <b>2</b> <a href="index-3.html">3</a>' in (tmp_path / "index-2.html").read_text(
        encoding="utf-8"
    )
    index.write_index(tmp_path, ROWS[:2], 5, "takes")
    assert [p.name for p in tmp_path.iterdir()] == ["index.html"]
    index.write_index(tmp_path, [], 5, "takes")
    assert "0 of 5" in (tmp_path / "index.html").read_text(encoding="utf-8")


@needs_browser
def test_ten_thousand_rows_fit_every_width(tmp_path: Path) -> None:
    many = [Row(f"s{k}/take-{k}-{'x' * 30}", "warn", "why " * 30, frames=9, report="r") for k in range(9990)]
    index.write_index(tmp_path, [*ROWS, *many], 9995, "takes-" * 20)
    with BrowserPage(tmp_path / "browser", 1280, 900) as page:
        page.open((tmp_path / "index.html").as_uri())
        for width in WIDTHS:
            page.resize(width, 900)
            found = page.value(
                "[document.documentElement.scrollWidth - innerWidth, document.querySelectorAll('tbody tr').length]"
            )
            assert found[0] <= 0
            assert found[1] == 9995
        assert page.errors == []
        page.open("about:blank")
        index.write_index(tmp_path, ROWS, 5, "takes")
        page.open((tmp_path / "index.html").as_uri())
        for width in WIDTHS:
            page.resize(width, 900)
            page.picture(tmp_path / f"{width}.png")
            assert page.layout_faults() == []
