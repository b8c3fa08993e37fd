"""Rows: kept as they come; damaged lines are ignored, and the latest run counts whatever the clock says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rtof_kin.batch.rows import Row, RowFile, read_rows


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "a.jsonl", 1, {})
    kept = [Row("s/ü \u2028", "warn", '"quoted"\nline', frames=3, seconds=1.5), Row("b", error="x")]
    for row in kept:
        rows.add(row)
    assert read_rows([rows.path]) == {row.recording: (1, row) for row in kept}


@pytest.mark.parametrize(
    "line",
    [
        b'{"run": 9, "row": {"recording": "a", "verd',
        b"\x00\xff\n",
        b"[]\n",
        b'{"run": "x", "row": {}}\n',
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


def test_the_latest_run_counts_in_whatever_file(tmp_path: Path) -> None:
    files = [RowFile(tmp_path / name, run, {}) for name, run in (("x", 3), ("y", 2), ("z", 3))]
    files[0].add(Row("a", "warn"))
    files[0].add(Row("a", "pass"))
    files[1].add(Row("a", "fail"))
    files[2].add(Row("b", "fail"))
    for order in (files, files[::-1]):
        assert {n: r.verdict for n, (_, r) in read_rows(f.path for f in order).items()} == {"a": "pass", "b": "fail"}
