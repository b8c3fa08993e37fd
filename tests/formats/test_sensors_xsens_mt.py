"""MT Manager text: every orientation and separator, counters, rates, and what users get wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import REAL, Truth, mt_text, truth

from rtof_kin.core.errors import FileFormatError, UnitError
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.formats.sensors.xsens import is_xsens_mt, read_xsens_mt

ONE = truth(3, T=20)
COUNTERS = np.arange(20) + 600


def written(folder: Path, content: str, serial: str = "00b40001") -> Path:
    path = folder / f"MT_walk_{serial}.txt"
    path.write_text(content)
    return path


def first(path: Path) -> SensorStream:
    return read_xsens_mt([path]).streams[0]


@pytest.mark.parametrize("orientation", ["Quat", "Mat", "Euler"])
@pytest.mark.parametrize("delimiter", ["\t", ";", ","])
def test_every_orientation_and_separator_gives_the_same(
    tmp_path: Path, orientation: str, delimiter: str
) -> None:
    text = mt_text(ONE, COUNTERS, orientation, delimiter)
    assert is_xsens_mt(text)
    stream = first(written(tmp_path, text))
    assert stream.name == "00B40001"
    assert stream.R_inertial_sensor is not None
    np.testing.assert_allclose(stream.R_inertial_sensor, ONE.R.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(stream.times, COUNTERS / 60)
    assert (stream.quaternion_norm is None) == (orientation != "Quat")
    assert stream.notes == ()


def free(one: Truth, names: str = "XYZ") -> str:
    """The same with FreeAcc instead of Acc."""
    text = mt_text(Truth(one.R, one.a, one.a, one.w, one.m), COUNTERS)
    for axis, name in zip("XYZ", names, strict=True):
        text = text.replace(f"\tAcc_{axis}", f"\tFreeAcc_{name}")
    return text


@pytest.mark.parametrize("names", ["XYZ", "ENU"])
def test_free_acceleration_gets_gravity_back(tmp_path: Path, names: str) -> None:
    log = read_xsens_mt([written(tmp_path, free(ONE, names))])
    assert (log.declaration.gravity, log.declaration.acceleration_axes) == ("removed", "inertial")
    np.testing.assert_allclose(log.streams[0].f_sensor, ONE.f, atol=1e-9)


def test_what_is_free_acceleration_under_the_wrong_name_can_be_declared() -> None:
    """A real file: its tool wrote free acceleration under Acc, and 100 Hz in the header."""
    paths = list((REAL / "xsens_dot_as_mtw").glob("*.txt"))
    wrong = read_xsens_mt(paths)
    with pytest.raises(UnitError, match="LFemur"):
        wrong.imus()
    assert any("60 Hz in microseconds, and the rate is taken as 100 Hz" in n for n in wrong.notes)
    right = read_xsens_mt(paths, gravity="removed", acceleration_axes="inertial", rate_hz=60)
    assert not any("rate" in n for n in right.notes)
    assert np.median(np.linalg.norm(right.imus()[0].f_sensor, axis=-1)) == pytest.approx(9.81, abs=0.1)


def test_sensors_whose_counters_wrapped_between_their_beginnings_share_times(tmp_path: Path) -> None:
    early = written(tmp_path, mt_text(ONE, np.mod(COUNTERS - 600 + 65533, 65536)), "00B40001")
    late = written(tmp_path, mt_text(ONE, COUNTERS - 600 + 1), "00B40002")
    a, b = read_xsens_mt([early, late]).streams
    assert set(np.round(a.times * 60)) & set(np.round(b.times * 60))
    assert b.times[0] - a.times[0] == pytest.approx(4 / 60)
    assert a.notes == ("1 time PacketCounter passed 65535 and began again at 0",)


def test_counters_of_32_bits_are_not_taken_to_have_wrapped(tmp_path: Path) -> None:
    early = written(tmp_path, mt_text(ONE, COUNTERS), "00B40001")
    late = written(tmp_path, mt_text(ONE, COUNTERS + 100_000), "00B40002")
    a, b = read_xsens_mt([early, late]).streams
    np.testing.assert_allclose(b.times - a.times, 100_000 / 60)


def test_lost_and_doubled_packets_are_told_and_leave_no_trace_in_the_others(tmp_path: Path) -> None:
    rows = [0, 1, 2, 5, 4, 5, 6, 7, 12]
    one = Truth(ONE.R[rows], ONE.a[rows], ONE.f[rows], ONE.w[rows], ONE.m[rows])
    stream = first(written(tmp_path, mt_text(one, COUNTERS[rows])))
    taken = [0, 1, 2, 4, 5, 6, 7, 12]
    np.testing.assert_allclose(stream.f_sensor, ONE.f[taken], atol=1e-9)
    np.testing.assert_allclose(stream.times, COUNTERS[taken] / 60)
    assert stream.notes == (
        "1 packet late, put in their places",
        "1 packet sent again, taken once",
        "5 packets (38.5%) lost in 2 gaps, the longest of 0.07 s",
    )


def test_without_a_counter_lines_are_counted_and_that_is_told(tmp_path: Path) -> None:
    text = mt_text(ONE, COUNTERS).replace("PacketCounter", "Counter")
    stream = first(written(tmp_path, text))
    np.testing.assert_allclose(stream.times, np.arange(20) / 60)
    assert stream.notes == ("no PacketCounter: packets that were lost cannot be seen",)


def test_a_rate_is_needed_and_the_same_for_all(tmp_path: Path) -> None:
    path = written(tmp_path, mt_text(ONE, COUNTERS).replace("// Update Rate", "// Rate"))
    with pytest.raises(FileFormatError, match="no line '// Update Rate: ... Hz'; declare rate_hz"):
        read_xsens_mt([path])
    assert read_xsens_mt([path], rate_hz=100).streams[0].rate_hz == pytest.approx(100)
    for rate in ("0", "1.2.3", "99999999"):
        bad = written(tmp_path, mt_text(ONE, COUNTERS, rate=rate))
        with pytest.raises(FileFormatError, match=f"Update Rate: {rate}Hz"):
            read_xsens_mt([bad])
    both = [
        written(tmp_path, mt_text(ONE, COUNTERS, rate=rate), serial)
        for rate, serial in (("60.0", "00B40001"), ("100.0", "00B40002"))
    ]
    with pytest.raises(FileFormatError, match="00B40002.txt: its rate is 100 Hz and that of .* 60 Hz"):
        read_xsens_mt(both)


def test_a_trial_whose_files_differ_in_acceleration_is_refused(tmp_path: Path) -> None:
    paths = [
        written(tmp_path, text, serial)
        for text, serial in ((mt_text(ONE, COUNTERS), "00B40001"), (free(ONE), "00B40002"))
    ]
    with pytest.raises(FileFormatError, match="00B40002.txt: has no Acc_X, Acc_Y, Acc_Z, as other"):
        read_xsens_mt(paths)


def test_a_counter_that_started_anew_is_an_error_with_its_line(tmp_path: Path) -> None:
    counters = np.concatenate([COUNTERS[:10] + 40000, np.arange(10)])
    with pytest.raises(FileFormatError, match="line 14: PacketCounter goes from 40609 back to 0") as e:
        first(written(tmp_path, mt_text(ONE, counters)))
    assert e.value.line == 14


def test_matrices_that_are_none_are_an_error_and_missing_ones_are_missing(tmp_path: Path) -> None:
    lines = mt_text(ONE, COUNTERS, "Mat").splitlines()
    cells = lines[6].split("\t")
    gap = "\t".join([*cells[:10], *[""] * 9])
    stream = first(written(tmp_path, "\n".join([*lines[:6], gap, *lines[7:]])))
    assert stream.R_inertial_sensor is not None
    assert np.isnan(stream.R_inertial_sensor[3]).all()
    assert np.isfinite(stream.R_inertial_sensor[4]).all()
    wrong = "\t".join([*cells[:10], "2", *cells[11:]])
    with pytest.raises(FileFormatError, match="00B40001: the matrix of sample 3 is no rotation"):
        first(written(tmp_path, "\n".join([*lines[:6], wrong, *lines[7:]])))


def test_free_acceleration_without_orientation_is_of_no_use_and_that_is_said(tmp_path: Path) -> None:
    rows = [line.split("\t")[:10] for line in free(ONE).splitlines()]
    with pytest.raises(FileFormatError, match="of no use without an orientation"):
        first(written(tmp_path, "\n".join("\t".join(row) for row in rows)))
