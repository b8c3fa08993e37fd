"""Every format is recognised by its content and read in SI units; `test_fuzz_readers` damages files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import REAL, SERIALS, WRITERS, truth, write_csv, write_dot, write_mt

from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.data.imu_stream import CHOICES
from rtof_kin.formats.sensors.files import FORMATS, read_sensor_log

TRUTHS = [truth(1), truth(2)]


@pytest.mark.parametrize("title", [kind.title for kind in FORMATS])
def test_written_file_is_read_in_si_units(title: str, tmp_path: Path) -> None:
    log = read_sensor_log(WRITERS[title](tmp_path, TRUTHS))
    assert log.format == title
    assert [name.removeprefix("s") for name in log.names] == list(SERIALS)
    for stream, true in zip(log.streams, TRUTHS, strict=True):
        R = true.R.as_matrix()
        for name, value in (("R_inertial_sensor", R), ("f_sensor", true.f), ("w_sensor", true.w), ("m_sensor", true.m)):
            if name in stream.holds:
                np.testing.assert_allclose(getattr(stream, name), value, atol=1e-8)
        assert "R_inertial_sensor" in stream.holds or title == "Noraxon CSV"
        assert stream.rate_hz == pytest.approx(60, rel=1e-4)
        assert len(stream) == 40


@pytest.mark.parametrize("title", WRITERS)
def test_one_format_recognises_a_file(title: str, tmp_path: Path) -> None:
    place = WRITERS[title](tmp_path, TRUTHS)
    files = [place] if place.is_file() else [one for one in place.rglob("*") if one.is_file()]
    for path in files:
        head = path.read_bytes()[:16384].decode("utf-8-sig", errors="replace")
        assert [kind.title for kind in FORMATS if kind.recognise(head)] == [title]


@pytest.mark.parametrize("title", WRITERS)
def test_declaration_can_be_changed(title: str, tmp_path: Path) -> None:
    place = WRITERS[title](tmp_path, TRUTHS)
    usual = read_sensor_log(place)
    log = read_sensor_log(place, rate_hz=50, inertial_axes="z down", acceleration_unit=None)
    assert log.declaration.inertial_axes == "z down"
    assert log.declaration.acceleration_unit == usual.declaration.acceleration_unit
    assert log.streams[0].rate_hz == pytest.approx(50)
    R, turned = usual.streams[0].R_inertial_sensor, log.streams[0].R_inertial_sensor
    if R is not None:
        np.testing.assert_allclose(turned, np.diag([1, -1, -1]) @ R, atol=1e-12)
    with pytest.raises(UnknownNameError, match="'units'"):
        read_sensor_log(place, units="g")


def test_trial_is_a_folder_several_files_or_one(tmp_path: Path) -> None:
    folder = write_mt(tmp_path, TRUTHS)
    (folder / "readme.md").write_text("hello")
    (folder / "subjects.txt").write_text("hello")
    files = sorted(folder.glob("MT_*"))
    assert read_sensor_log(folder).names == read_sensor_log(files).names == SERIALS
    assert read_sensor_log(str(files[1])).names == SERIALS[1:]
    assert read_sensor_log(folder).notes == ("left aside, as no files of sensors: subjects.txt",)


def test_folder_of_two_trials_is_refused(tmp_path: Path) -> None:
    write_csv(tmp_path, TRUTHS)
    (tmp_path / "again.csv").write_bytes((tmp_path / "trial.csv").read_bytes())
    with pytest.raises(FileFormatError, match=r"2 trials \(again.csv, trial.csv\); name one"):
        read_sensor_log(tmp_path)
    write_dot(tmp_path, TRUTHS)
    with pytest.raises(FileFormatError, match="Movella DOT CSV and of plain CSV"):
        read_sensor_log(tmp_path)


def test_one_sensor_in_two_files_is_refused(tmp_path: Path) -> None:
    write_mt(tmp_path, TRUTHS)
    first = tmp_path / f"MT_1_000-001_{SERIALS[0]}.txt"
    first.with_name(f"MT_1_000-002_{SERIALS[0]}.txt").write_bytes(first.read_bytes())
    with pytest.raises(FileFormatError, match="00B40001 .*more than once"):
        read_sensor_log(tmp_path)


@pytest.mark.parametrize("content", [b"", b"hello\n", b"a,b\n1,2\n", b"\xff\xfe"])
def test_unknown_file_error_lists_the_formats(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(content)
    for place in (path, tmp_path):
        with pytest.raises(FileFormatError) as caught:
            read_sensor_log(place)
        assert str(place) in str(caught.value)
        assert all(kind.title in str(caught.value) for kind in FORMATS)


@pytest.mark.parametrize("name, says", [("walk.csv", "no such file"), ("", "in this folder"), (None, "named")])
def test_missing_file_is_an_error(name: str | None, says: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=says):
        read_sensor_log([] if name is None else tmp_path / name)


@pytest.mark.parametrize(
    ("name", "title", "sensors", "rate", "samples"),
    [
        ("opensense_mtw8", "Xsens MT Manager text", ("00B42268", "00B42279"), 100, 120),
        ("hipose_mtw17", "Xsens MT Manager text", ("00B45C26", "00B45C2D"), 60, 600),
        ("xsens_dot", "Movella DOT CSV", ("LFemur", "Pelvis"), 60, 80),
        ("xio_lowerbody", "x-IMU3 folders", ("Left Foot", "Pelvis"), 50, 150),
        ("qmt_fullbody_16imu", "MATLAB structs", ("hip", "foot_left"), 100, 150),
    ],
)
def test_real_recordings(name: str, title: str, sensors: tuple[str, ...], rate: float, samples: int) -> None:
    log = read_sensor_log(REAL / name)
    assert (log.format, log.names) == (title, sensors)
    stream = log.streams[-1]
    assert len(stream) == pytest.approx(samples, abs=1)
    assert stream.rate_hz == pytest.approx(rate, rel=0.01)
    f, R = stream.f_sensor, stream.R_inertial_sensor
    assert np.median(np.linalg.norm(f, axis=1)) == pytest.approx(9.81, abs=0.4)
    if name != "qmt_fullbody_16imu":  # whose quaternions are not the sensors'
        up = np.mean(np.einsum("tij,tj->ti", R, f), axis=0)
        np.testing.assert_allclose(up, [0, 0, 9.81], atol=0.5)


def test_documentation_has_every_format_and_field_and_a_valid_example(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "sensors.md").read_text(encoding="utf-8")
    plain = text.replace("`", "")
    assert all(f"| {kind.title}" in plain for kind in FORMATS)
    for field, values in CHOICES.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{field}`")]
        assert all(f"`{value}`" in row for value in values)
    example = tmp_path / "walk.csv"
    example.write_text(text.split("```csv\n")[1].split("```")[0])
    (stream,) = read_sensor_log(example).streams
    assert (stream.name, stream.holds) == ("thigh", ("f_sensor", "w_sensor"))
