"""The plain CSV, as its documentation says, and mistakes in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.imu_csv import is_imu_csv, read_imu_csv


def written(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "walk.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_sensor_has_what_its_columns_say(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "time,left thigh_fx,left thigh_fy,left thigh_fz,hip_wx,hip_wy,hip_wz,hip_mx,hip_my,hip_mz",
        "0.5,0,0,9.81,1,2,3,,nan,0.4",
        "0.6,0,0,9.81,1,2,3,0.1,0.2,0.3",
        "0.75,0,0,9.81,1,2,3,0.1,0.2,0.3",
    )
    log = read_imu_csv(path)
    assert log.names == ("left thigh", "hip")
    assert [stream.holds for stream in log.streams] == [("f_sensor",), ("w_sensor", "m_sensor")]
    np.testing.assert_array_equal(log.streams[0].times, [0.5, 0.6, 0.75])
    m = [[np.nan, np.nan, 0.4], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]]
    np.testing.assert_array_equal(log.streams[1].m_sensor, m)
    assert log.notes == ()


def test_lost_samples_are_told(tmp_path: Path) -> None:
    rows = [f"{t},0,0,9.81" for t in (0, 0.1, 0.2, 0.6)]
    log = read_imu_csv(written(tmp_path, "time,a_fx,a_fy,a_fz", *rows))
    assert log.notes == ("3 packets (42.9%) lost in 1 gap, the longest of 0.30 s",)


def test_a_declaration_says_what_the_numbers_are(tmp_path: Path) -> None:
    path = written(tmp_path, "a_fx,a_fy,a_fz,a_wx,a_wy,a_wz", "0,0,1000,180,0,0", "0,0,1000,180,0,0")
    stream = read_imu_csv(path, acceleration_unit="mg", angular_unit="deg/s", rate_hz=10).streams[0]
    np.testing.assert_allclose(stream.f_sensor, [[0, 0, 9.80665]] * 2)
    np.testing.assert_allclose(stream.w_sensor, [[np.pi, 0, 0]] * 2)
    np.testing.assert_array_equal(stream.times, [0, 0.1])


@pytest.mark.parametrize(
    ("lines", "line", "message"),
    [
        (["time,a_fx,a_fy", "0,1,2"], 1, "there is no column a_fz"),
        (["time,a_fx,a_fy,a_fz,a_qx,a_qy,a_qz", "0,1,2,3,0,0,0"], 1, "there is no column a_qw"),
        (["time,a_fx,a_fy,a_fz,b", "0,1,2,3,4"], 1, "column 'b': expected time, or a sensor's name and"),
        (["time,_fx,_fy,_fz", "0,1,2,3"], 1, "column '_fx': expected time"),
        (["a_fx,a_fy,a_fz", "1,2,3"], 1, r"no column time \(s\); add it, or declare rate_hz"),
        (["time,a_fx,a_fy,a_fz", "0,1,2,3", "0,1,2,3"], 3, "time 0 s is not after the one above"),
        (["time,a_fx,a_fy,a_fz", "0,1,2,3", ",1,2,3"], 3, "time nan s is not after the one above"),
        (["time,a_fx,a_fy,a_fz"], None, "holds column names and no packet"),
    ],
)
def test_a_mistake_is_an_error_with_its_line(
    tmp_path: Path, lines: list[str], line: int | None, message: str
) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        read_imu_csv(written(tmp_path, *lines))
    assert caught.value.line == line


def test_it_is_known_by_its_first_line() -> None:
    assert is_imu_csv("time,a_fx,a_fy,a_fz\n")
    assert is_imu_csv("a_wx;a_wy;a_wz")
    assert not is_imu_csv("time,nose_x,nose_y\n")
    assert not is_imu_csv("")
