"""Movella DOT CSV: stamps that wrap, raw and free acceleration, sensors on one clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import REAL, dot_text, truth

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.xsens import is_xsens_dot, read_xsens_dot

ONE = truth(4, T=20)
STAMPS = 1_000_000 + 16667 * np.arange(20)


def written(folder: Path, content: str, name: str = "D422CD0001_20210820_202113.csv") -> Path:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


@pytest.mark.parametrize("raw", [False, True])
def test_raw_and_free_acceleration_give_the_same_force(tmp_path: Path, raw: bool) -> None:
    log = read_xsens_dot([written(tmp_path, dot_text(ONE, STAMPS, raw=raw))])
    assert log.declaration.gravity == ("included" if raw else "removed")
    (stream,) = log.streams
    assert stream.name == "D422CD0001"
    np.testing.assert_allclose(stream.f_sensor, ONE.f, atol=1e-9)
    np.testing.assert_allclose(stream.w_sensor, ONE.w, atol=1e-9)
    np.testing.assert_allclose(stream.times, STAMPS / 1e6)
    assert stream.notes == ()


def test_stamps_wrap_and_sensors_stay_on_one_clock(tmp_path: Path) -> None:
    wrap = 2**32
    early = np.mod(wrap - 5 * 16667 + 16667 * np.arange(20), wrap)
    late = np.mod(wrap + 2 * 16667 + 16667 * np.arange(20), wrap)
    a, b = read_xsens_dot(
        [written(tmp_path, dot_text(ONE, s), f"{n}_20210820_202113_1.csv") for s, n in
         ((early, "Pelvis"), (late, "Left Thigh"))]
    ).streams  # fmt: skip
    assert (a.name, b.name) == ("Pelvis", "Left Thigh")
    np.testing.assert_allclose(np.diff(a.times), 0.016667)
    assert b.times[0] - a.times[0] == pytest.approx(7 * 0.016667)
    assert a.notes == ("1 time SampleTimeFine passed 4294967295 and began again at 0",)


def test_lost_packets_are_counted_by_the_rate_in_the_header(tmp_path: Path) -> None:
    rows = np.arange(0, 20, 2)  # every other one: the median step is two periods
    one = truth(4, T=10)
    text = dot_text(one, STAMPS[rows], COUNTERS[rows])
    stream = read_xsens_dot([written(tmp_path, text)]).streams[0]
    assert stream.notes == ("9 packets (47.4%) lost in 9 gaps, the longest of 0.02 s",)
    assert read_xsens_dot(
        [written(tmp_path, text.replace("OutputRate:,60Hz", "OutputRate:,?"))]
    ).notes == ()  # fmt: skip


COUNTERS = np.arange(20) + 1


def test_a_declared_rate_and_the_counter_give_times_after_the_first_stamp(tmp_path: Path) -> None:
    jitter = STAMPS + np.array([0, 300, -300, 0] * 5)
    path = written(tmp_path, dot_text(ONE, jitter))
    times = read_xsens_dot([path], rate_hz=60).streams[0].times
    np.testing.assert_allclose(times, 1 + np.arange(20) / 60)


def test_stamps_that_start_anew_are_an_error_with_their_line(tmp_path: Path) -> None:
    stamps = np.concatenate([STAMPS[:10] + 2_000_000_000, STAMPS[:10]])
    with pytest.raises(FileFormatError, match="SampleTimeFine goes from .* it started anew") as caught:
        read_xsens_dot([written(tmp_path, dot_text(ONE, stamps))])
    assert caught.value.line == 17


def test_stamps_and_counter_are_needed(tmp_path: Path) -> None:
    text = dot_text(ONE, STAMPS).replace("SampleTimeFine", "Time")
    with pytest.raises(FileFormatError, match="has no column SampleTimeFine; export it too"):
        read_xsens_dot([written(tmp_path, text)])
    text = dot_text(ONE, STAMPS).replace("PacketCounter", "Packet")
    path = written(tmp_path, text)
    assert len(read_xsens_dot([path]).streams[0]) == 20
    with pytest.raises(FileFormatError, match="has no column PacketCounter"):
        read_xsens_dot([path], rate_hz=60)


def test_a_measurement_that_lacks_a_column_is_refused_by_file_and_column(tmp_path: Path) -> None:
    path = written(tmp_path, dot_text(ONE, STAMPS).replace("Quat_W", "Quat_S"))
    message = "has columns Quat_X, Quat_Y, Quat_Z and no Quat_W"
    with pytest.raises(FileFormatError, match=message) as caught:
        read_xsens_dot([path])
    assert caught.value.path == path


def test_real_sensors_share_a_clock_and_the_lossy_one_is_told() -> None:
    log = read_xsens_dot(sorted((REAL / "xsens_dot").glob("*.csv")))
    assert log.streams[1].times[1] == log.streams[0].times[0] == 3343.444552
    assert log.notes[0].startswith("LFemur: ")
    assert "packets" in log.notes[0]
    assert len(log.notes) == 1


def test_a_file_of_raw_columns_is_known_by_its_lines_about_the_device() -> None:
    columns = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n"
    assert is_xsens_dot("sep=,\nDeviceTag:,a\n\n" + columns)
    assert not is_xsens_dot(columns)  # degrees or radians: nobody can tell
