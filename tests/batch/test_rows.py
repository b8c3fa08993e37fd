"""Rows: kept as they come; damaged lines are ignored, and the latest run counts whatever the clock says."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

from rtof_kin.batch import rows as module
from rtof_kin.batch.rows import Row, RowFile, read_rows


@pytest.mark.parametrize(
    "line",
    [
        b'{"run": 9, "row": {"recording": "a", "verd',
        b"\x00\xff\n",
        b'{"run": 9, "row": {"recording": 3}}\n',
        b'{"run": 9, "row": {"recording": "a", "frames": "many"}}\n',
        b'{"run": 9, "row": {"recording": "a", "seconds": NaN}}\n',
    ],
)
def test_damaged_lines_are_ignored_and_left_out_by_the_next_run(line: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    RowFile(path, 1, {}).add(Row("a", "pass"))
    with path.open("ab") as stream:
        stream.write(line)
    found = read_rows([path])
    assert found == {"a": (1, Row("a", "pass"))}
    again = RowFile(path, 2, found)
    again.add(Row("b", "warn"))
    assert [json.loads(text)["row"]["recording"] for text in path.read_text().splitlines()] == ["a", "b"]
    RowFile(tmp_path / "other", 1, {}).add(Row("b", "fail"))
    for order in ([path, tmp_path / "other"], [tmp_path / "other", path]):  # the latest run counts in whatever file
        assert {name: row.verdict for name, (_, row) in read_rows(order).items()} == {"a": "pass", "b": "warn"}


ROWS = [
    Row("s1/a & <b>", "error", step="reconstruct", error="<script>alert(1)</script>", log="log/reconstruct.txt"),
    Row("s 2/'c'#", "fail", "it fails", frames=60, duration_s=1.0, report="report.html", log="log/report.txt"),
    Row("d", "weakly observed", "x" * 300, report="report.html"),
    Row("p", "plausible", "checked; not proven: add a sensor", report="report.html"),
    Row("e", "pass", "checked", report="report.html"),
    Row("f", "done"),
]


def test_rows_are_escaped_and_linked(tmp_path: Path) -> None:
    module.write_index(tmp_path, ROWS, 7, "takes <x>")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "Batch of takes &lt;x&gt;" in page
    assert "reconstruct: &lt;script&gt;alert(1)" in page
    links = [unquote(unescape(link)) for link in re.findall('href="([^"]*)"', page)]
    assert links[:3] == ["s1/a & <b>/log/reconstruct.txt", "s 2/'c'#/report.html", "s 2/'c'#/log/report.txt"]
    assert "6 of 7 recordings; 1 are not done" in page
    assert page.index("weakly observed") < page.index(">e<")
    assert '<span class="grade plausible">plausible</span> 1' in page
    assert sorted(ROWS[::-1], key=lambda row: row.severity) == ROWS


def test_the_page_has_the_worst_of_very_many_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_ROWS", 2)
    module.write_index(tmp_path, ROWS, 5, "takes")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "The page has the worst 2, batch.csv all." in page
    assert "it fails" in page
    assert "xxx" not in page
    module.write_index(tmp_path, [], 5, "takes")
    assert "0 of 5" in (tmp_path / "index.html").read_text(encoding="utf-8")
