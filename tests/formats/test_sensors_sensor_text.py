"""Text tables of sensors: any separator, bounded memory, and errors that name file and line."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from sensor_files import SERIALS, dot_text, mt_text, mvnx_text, truth

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.formats.sensors import sensor_text
from rtof_kin.formats.sensors.files import read_sensor_log
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


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_text("t,x\n1,2\n")
    with pytest.raises(FileFormatError, match="larger than 0 MiB"):
        list(sensor_text.text_lines(path, limit=4))
    with pytest.raises(FileFormatError, match="there is no such file"):
        list(sensor_text.text_lines(tmp_path / "other.csv"))
    with pytest.raises(FileFormatError, match="cannot be read"):
        list(sensor_text.text_lines(tmp_path))


ONE = truth(5, T=20)


@pytest.mark.parametrize(
    ("stamp", "utc"),
    [
        ("2021-08-20_20:21:13_835 GMT+8", datetime(2021, 8, 20, 12, 21, 13, 835_000, UTC)),
        ("2021-01-01_00:10:00_5 GMT-3:30", datetime(2021, 1, 1, 3, 40, 0, 5_000, UTC)),
        ("2021-01-01_00:10:00_000 UTC", datetime(2021, 1, 1, 0, 10, 0, 0, UTC)),
        ("2021-13-01_00:10:00_000 GMT+1", None),
        ("2021-01-01_00:10:00_000", None),
        ("2021-01-01_00:10:00_000 GMT+99", None),
    ],
)
def test_dot_states_its_zone(tmp_path: Path, stamp: str, utc: datetime | None) -> None:
    early, late = ((5_000_000 + shift + 16667 * np.arange(20)) for shift in (0, 500_000))
    for name, stamps, line in (("A", late, "2021-08-20_20:21:14_335 GMT+8"), ("B", early, stamp)):
        text = dot_text(ONE, stamps).replace("OutputRate", f"StartTime: ,{line}\nOutputRate")
        (tmp_path / f"{name}_20210820_202113.csv").write_text(text, encoding="utf-8")
    assert read_sensor_log(tmp_path).start_utc == utc  # that of the sensor that began first


def mt_with_utc(valid: int, month: int = 5) -> str:
    text = mt_text(ONE, np.arange(20) + 100)
    names = ["Nano", "Year", "Month", "Day", "Hour", "Minute", "Second", "Valid"]
    head, *rows = text.split("PacketCounter", 1)[1].splitlines()
    values = [500_000_000, 2023, month, 6, 7, 8, 9, valid]
    table = ["PacketCounter" + head + "".join(f"\tUTC_{name}" for name in names)]
    table += [row + "".join(f"\t{value}" for value in values) for row in rows]
    return text.split("PacketCounter", 1)[0] + "\n".join([*table, ""])


def test_mt_manager_has_utc_in_columns_that_say_they_are_valid(tmp_path: Path) -> None:
    path = tmp_path / f"MT_1_000-001_{SERIALS[0]}.txt"
    path.write_text(mt_with_utc(7))
    assert read_sensor_log(path).start_utc == datetime(2023, 5, 6, 7, 8, 9, 500_000, UTC)
    for text in (mt_with_utc(3), mt_with_utc(7, month=13)):
        path.write_text(text)
        assert read_sensor_log(path).start_utc is None


def test_a_time_without_a_zone_is_a_note(tmp_path: Path) -> None:
    path = tmp_path / f"MT_1_000-001_{SERIALS[0]}.txt"
    text = mt_text(ONE, np.arange(20) + 100)
    path.write_text(text.replace("Unknown", "10:12:32 05/14/2023"))
    log = read_sensor_log(path)
    assert log.start_utc is None
    assert log.notes == ("began at 10:12:32 05/14/2023, in a time zone that is not stated",)
    path.write_text(text)
    assert read_sensor_log(path).notes == ()


def test_mvnx_counts_milliseconds_since_1970(tmp_path: Path) -> None:
    path = tmp_path / "a.mvnx"
    path.write_text(mvnx_text([ONE]).replace("<subject ", '<subject recDateMSecsSinceEpoch="1700000000500" '))
    began = datetime.fromtimestamp(1700000000, UTC) + timedelta(milliseconds=500)
    assert read_sensor_log(path).start_utc == began
    cut = mvnx_text([ONE]).replace("<subject ", '<subject recDateMSecsSinceEpoch="later" ')
    path.write_text(cut)
    assert read_sensor_log(path).start_utc is None


def test_only_utc_is_a_start(tmp_path: Path) -> None:
    path = tmp_path / f"MT_1_000-001_{SERIALS[0]}.txt"
    path.write_text(mt_text(ONE, np.arange(20) + 100))
    log = read_sensor_log(path)
    for start in (datetime(2023, 1, 1), datetime(2023, 1, 1, tzinfo=timezone(timedelta(hours=2)))):
        with pytest.raises(InvalidInputError, match="is not in UTC"):
            replace(log, start_utc=start)
