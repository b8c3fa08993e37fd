"""Text tables of sensors: any separator, bounded memory, and errors that name file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors import sensor_text
from rtof_kin.formats.sensors.sensor_text import SensorTable, read_table

HEAD = "// made here\n\nt,x,Status\n"


def table(tmp_path: Path, content: str | bytes) -> SensorTable:
    path = tmp_path / "walk.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path, lambda names: "x" in names, lambda name: name in "tx")


@pytest.mark.parametrize("delimiter", ["\t", ",", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_separators_line_ends_and_marks(tmp_path: Path, delimiter: str, end: str, mark: bytes) -> None:
    lines = ["// © made here", "t,x,Status", "1, 2.5 ,ok", "", "2,,", "3,-4e-1,bad,", ""]
    got = table(tmp_path, mark + end.join(lines).replace(",", delimiter).encode())
    assert got.names == ("t", "x")
    assert got.header == ("// © made here",)
    assert list(got.lines) == [3, 5, 6]
    np.testing.assert_array_equal(got.values, [[1, 2.5], [2, np.nan], [3, -0.4]])
    np.testing.assert_array_equal(got.columns("X", "T"), got.values[:, ::-1])
    assert got.columns("x", "y") is None
    assert got.column("y") is None
    assert got.notes == ()


def test_cut_last_line_is_left_out_with_a_note(tmp_path: Path) -> None:
    got = table(tmp_path, HEAD + "1,2,ok\n2,3")
    assert got.values.tolist() == [[1, 2]]
    assert got.notes == ("line 5 was cut off and is left out",)


@pytest.mark.parametrize(
    ("content", "line", "message"),
    [
        ("", 1, "ends before a line of column names"),
        (HEAD + "1,2,ok,5\n", 4, "4 cells under 3 column names"),
        ("t;x;Status\n1;2,5;ok\n", 2, "'2,5' is not a number; write decimal points"),
        (HEAD + "1," + "2" * 70000 + ",ok\n", 4, "longer than 65536 bytes"),
    ],
)
def test_damaged_table(tmp_path: Path, content: str | bytes, line: int | None, message: str) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        table(tmp_path, content)
    assert caught.value.line == line
    assert "walk.csv" in str(caught.value)


def test_ignored_column_may_hold_anything(tmp_path: Path) -> None:
    assert table(tmp_path, HEAD + "1,2,1e999\n").values.tolist() == [[1, 2]]


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_text("t,x\n1,2\n")
    with pytest.raises(FileFormatError, match="larger than 0 MiB"):
        list(sensor_text.text_lines(path, limit=4))
    with pytest.raises(FileFormatError, match="there is no such file"):
        list(sensor_text.text_lines(tmp_path / "other.csv"))
    with pytest.raises(FileFormatError, match="cannot be read"):
        list(sensor_text.text_lines(tmp_path))
