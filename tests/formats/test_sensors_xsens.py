"""MT Manager text and DOT CSV: orientations, separators, counters, stamps, rates, and common mistakes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from sensor_files import REAL, Truth, dot_text, mt_text, truth

from rtof_kin.core.errors import FileFormatError, UnitError
from rtof_kin.formats.sensors.xsens import is_xsens_mt, read_xsens_dot, read_xsens_mt
from rtof_kin.recording.sensor_files import imus_of_log

ONE = truth(3, T=20)
COUNTERS = np.arange(20) + 600
STAMPS = 1_000_000 + 16667 * np.arange(20)


def mt(folder: Path, content: str, serial: str = "00b40001") -> Path:
    path = folder / f"MT_walk_{serial}.txt"
    path.write_text(content)
    return path


def dot(folder: Path, content: str, name: str = "D422CD0001") -> Path:
    path = folder / f"{name}_20210820_202113.csv"
    path.write_text(content, encoding="utf-8")
    return path


def free(one: Truth, names: str = "XYZ") -> str:
    """MT Manager text with FreeAcc instead of Acc."""
    text = mt_text(Truth(one.R, one.a, one.a, one.w, one.m), COUNTERS)
    for axis, name in zip("XYZ", names, strict=True):
        text = text.replace(f"\tAcc_{axis}", f"\tFreeAcc_{name}")
    return text


@pytest.mark.parametrize("orientation", ["Quat", "Mat", "Euler"])
@pytest.mark.parametrize("delimiter", ["\t", ";", ","])
def test_mt_every_orientation_and_separator(tmp_path: Path, orientation: str, delimiter: str) -> None:
    text = mt_text(ONE, COUNTERS, orientation, delimiter)
    assert is_xsens_mt(text)
    (stream,) = read_xsens_mt([mt(tmp_path, text)]).streams
    assert (stream.name, stream.notes) == ("00B40001", ())
    np.testing.assert_allclose(stream.R_inertial_sensor, ONE.R.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(stream.times, COUNTERS / 60)
    assert (stream.quaternion_norm is None) == (orientation != "Quat")


@pytest.mark.parametrize("names", ["XYZ", "ENU"])
def test_mt_free_acceleration_gets_gravity_back(tmp_path: Path, names: str) -> None:
    log = read_xsens_mt([mt(tmp_path, free(ONE, names))])
    assert (log.declaration.gravity, log.declaration.acceleration_axes) == ("removed", "inertial")
    np.testing.assert_allclose(log.streams[0].f_sensor, ONE.f, atol=1e-9)


def test_mt_free_acceleration_under_the_wrong_name_can_be_declared() -> None:
    """A real file: its tool wrote free acceleration under Acc, and 100 Hz in the header."""
    paths = list((REAL / "xsens_dot_as_mtw").glob("*.txt"))
    wrong = read_xsens_mt(paths)
    with pytest.raises(UnitError, match="LFemur"):
        imus_of_log(wrong)
    assert any("60 Hz in microseconds, and the rate is taken as 100 Hz" in n for n in wrong.notes)
    right = read_xsens_mt(paths, gravity="removed", acceleration_axes="inertial", rate_hz=60)
    assert not any("rate" in n for n in right.notes)
    assert np.median(np.linalg.norm(imus_of_log(right).f_sensor, axis=-1)) == pytest.approx(9.81, abs=0.1)


@pytest.mark.parametrize(
    "early, late, seconds",
    [(np.mod(np.arange(20) + 65533, 65536), np.arange(20) + 1, 4 / 60), (COUNTERS, COUNTERS + 100_000, 100_000 / 60)],
    ids=["16 bits that wrap", "32 bits"],
)
def test_mt_counters_of_a_trial(tmp_path: Path, early: np.ndarray, late: np.ndarray, seconds: float) -> None:
    paths = [mt(tmp_path, mt_text(ONE, c), n) for c, n in ((early, "00B40001"), (late, "00B40002"))]
    a, b = read_xsens_mt(paths).streams
    np.testing.assert_allclose(b.times - a.times, seconds)


def test_mt_lost_late_and_repeated_packets_are_reported(tmp_path: Path) -> None:
    rows = [0, 1, 2, 5, 4, 5, 6, 7, 12]
    one = Truth(ONE.R[rows], ONE.a[rows], ONE.f[rows], ONE.w[rows], ONE.m[rows])
    (stream,) = read_xsens_mt([mt(tmp_path, mt_text(one, COUNTERS[rows]))]).streams
    taken = [0, 1, 2, 4, 5, 6, 7, 12]
    np.testing.assert_allclose(stream.f_sensor, ONE.f[taken], atol=1e-9)
    np.testing.assert_allclose(stream.times, COUNTERS[taken] / 60)
    late, again, lost = stream.notes
    assert late.startswith("1 packet late")
    assert again.startswith("1 packet sent again")
    assert lost.startswith("5 packets (38.5%) lost in 2 gaps")


def test_mt_without_a_counter_lines_are_counted(tmp_path: Path) -> None:
    (stream,) = read_xsens_mt([mt(tmp_path, mt_text(ONE, COUNTERS).replace("PacketCounter", "Counter"))]).streams
    np.testing.assert_allclose(stream.times, np.arange(20) / 60)
    assert stream.notes == ("no PacketCounter: packets that were lost cannot be seen",)


def test_mt_rate_can_be_declared_and_must_be_common(tmp_path: Path) -> None:
    path = mt(tmp_path, mt_text(ONE, COUNTERS).replace("// Update Rate", "// Rate"))
    with pytest.raises(FileFormatError, match="declare rate_hz"):
        read_xsens_mt([path])
    assert read_xsens_mt([path], rate_hz=100).streams[0].rate_hz == pytest.approx(100)
    for rate in ("0", "1.2.3", "99999999"):
        with pytest.raises(FileFormatError, match="Update Rate: ... Hz.* found none"):
            read_xsens_mt([mt(tmp_path, mt_text(ONE, COUNTERS, rate=rate))])
    both = [mt(tmp_path, mt_text(ONE, COUNTERS, rate=r), n) for r, n in (("60", "00B40001"), ("100", "00B40002"))]
    with pytest.raises(FileFormatError, match="found 60 Hz in .*00B40001.txt and 100 Hz"):
        read_xsens_mt(both)


def test_mt_files_of_a_trial_have_the_same_acceleration(tmp_path: Path) -> None:
    paths = [mt(tmp_path, mt_text(ONE, COUNTERS), "00B40001"), mt(tmp_path, free(ONE), "00B40002")]
    with pytest.raises(FileFormatError, match="00B40002.txt: has no Acc_X"):
        read_xsens_mt(paths)


def test_mt_missing_matrix_is_nan_and_another_matrix_an_error(tmp_path: Path) -> None:
    lines = mt_text(ONE, COUNTERS, "Mat").splitlines()
    cells = lines[6].split("\t")

    def with_row(row: Sequence[str]) -> Path:
        return mt(tmp_path, "\n".join([*lines[:6], "\t".join(row), *lines[7:]]))

    (stream,) = read_xsens_mt([with_row([*cells[:10], *[""] * 9])]).streams
    missing = np.isnan(stream.R_inertial_sensor).all(axis=(1, 2))
    np.testing.assert_array_equal(missing, np.arange(20) == 3)
    with pytest.raises(FileFormatError, match="00B40001: the matrix of sample 3"):
        read_xsens_mt([with_row([*cells[:10], "2", *cells[11:]])])


def test_mt_free_acceleration_needs_an_orientation(tmp_path: Path) -> None:
    rows = [line.split("\t")[:10] for line in free(ONE).splitlines()]
    with pytest.raises(FileFormatError, match="orientation"):
        read_xsens_mt([mt(tmp_path, "\n".join("\t".join(row) for row in rows))])


@pytest.mark.parametrize("raw", [False, True])
def test_dot_raw_and_free_acceleration_give_the_same_force(tmp_path: Path, raw: bool) -> None:
    log = read_xsens_dot([dot(tmp_path, dot_text(ONE, STAMPS, raw=raw))])
    assert log.declaration.gravity == ("included" if raw else "removed")
    (stream,) = log.streams
    assert (stream.name, stream.notes) == ("D422CD0001", ())
    np.testing.assert_allclose(stream.f_sensor, ONE.f, atol=1e-9)
    np.testing.assert_allclose(stream.w_sensor, ONE.w, atol=1e-9)
    np.testing.assert_allclose(stream.times, STAMPS / 1e6)


def test_dot_stamps_wrap_and_sensors_share_a_clock(tmp_path: Path) -> None:
    wrap = 2**32
    paths = [
        dot(tmp_path, dot_text(ONE, np.mod(wrap + first * 16667 + 16667 * np.arange(20), wrap)), name)
        for first, name in ((-5, "Pelvis"), (2, "Left Thigh"))
    ]
    a, b = read_xsens_dot(paths).streams
    assert (a.name, b.name) == ("Pelvis", "Left Thigh")
    np.testing.assert_allclose(np.diff(a.times), 0.016667)
    assert b.times[0] - a.times[0] == pytest.approx(7 * 0.016667)
    assert a.notes == ("1 time SampleTimeFine passed 4294967295 and began again at 0",)


def test_dot_lost_packets_are_counted_by_the_rate_in_the_header(tmp_path: Path) -> None:
    every_other = slice(0, 20, 2)  # the median step is two periods
    text = dot_text(truth(4, T=10), STAMPS[every_other], COUNTERS[every_other])
    (note,) = read_xsens_dot([dot(tmp_path, text)]).streams[0].notes
    assert note.startswith("9 packets (47.4%) lost in 9 gaps")
    assert read_xsens_dot([dot(tmp_path, text.replace("OutputRate:,60Hz", "OutputRate:,?"))]).notes == ()


def test_dot_restarted_stamps_are_an_error_with_their_line(tmp_path: Path) -> None:
    stamps = np.concatenate([STAMPS[:10] + 2_000_000_000, STAMPS[:10]])
    with pytest.raises(FileFormatError, match="line 17: SampleTimeFine goes from"):
        read_xsens_dot([dot(tmp_path, dot_text(ONE, stamps))])
