"""XDF files with planted numbers: times on one clock, names, what is left aside, damage."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from xdf_file import Stream, content

from rtof_kin.core.errors import FileFormatError, InvalidInputError, MissingPackageError
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.xdf import read_xdf, read_xdf_points
from rtof_kin.reporting.inspection import inspect
from rtof_kin.setup.sources import SourceKind, recognise_source
from rtof_kin.vision.keypoint_files import read_detector_file

LABELS = ("qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z")
T = 60
RNG = np.random.default_rng(5)
VALUES = RNG.normal(size=(T, 7)) + np.array([3.0, 0, 0, 0, 0, 0, 9.8])
TIMES = 1000 + np.arange(T) / 60
IMU = Stream(1, "pelvis", LABELS, TIMES, VALUES)
EEG = Stream(7, "EEG", ("Fz", "Cz", "Pz"), TIMES, VALUES[:, :3], type="EEG")
POINTS = Stream(
    3,
    "pose",
    ("Nose_x", "Nose_y", "Nose_confidence", "LeftHand_x", "LeftHand_y"),
    TIMES[::2],
    RNG.uniform(0.1, 1, (T // 2, 5)),
    type="MoCap",
    rate_hz=30,
)


def file(folder: Path, *streams: Stream) -> Path:
    path = folder / "take.xdf"
    path.write_bytes(content(*streams))
    return path


def test_numbers_and_stamps_are_those_of_the_file(tmp_path: Path) -> None:
    log = read_xdf(file(tmp_path, IMU))
    (stream,) = log.streams
    assert stream.name == "pelvis"
    np.testing.assert_allclose(stream.times, TIMES, atol=1e-9)
    assert stream.f_sensor is not None
    np.testing.assert_array_equal(stream.f_sensor, VALUES[:, 4:])
    assert stream.quaternion_norm is not None
    np.testing.assert_allclose(stream.quaternion_norm, np.linalg.norm(VALUES[:, :4], axis=1))
    assert log.notes == ("pelvis: the file has no offsets of its clock; its stamps are taken as they are",)


@pytest.mark.parametrize("kind", ["float32", "int16"])
@pytest.mark.parametrize("stamped", [1, 16])
def test_other_number_formats_and_stamps_left_out(kind: str, stamped: int, tmp_path: Path) -> None:
    stream = replace(IMU, format=kind, stamped=stamped)
    (read,) = read_xdf(file(tmp_path, stream)).streams
    assert read.f_sensor is not None
    expected = VALUES[:, 4:].astype("i2" if kind == "int16" else "f4")
    np.testing.assert_array_equal(read.f_sensor, expected)
    np.testing.assert_allclose(read.times, TIMES, atol=1e-9)


def test_streams_of_two_clocks_are_on_one(tmp_path: Path) -> None:
    drift = [(t, 50.0 + 1e-4 * (t - 1000)) for t in np.arange(995.0, 1010.0, 1.0)]
    a = replace(IMU, offsets=drift)
    b = replace(IMU, number=2, name="head", times=TIMES + 300.0, offsets=[(1300.0, -250.0), (1306.0, -250.0)])
    log = read_xdf(file(tmp_path, a, b))
    np.testing.assert_allclose(log.streams[0].times, TIMES + 50 + 1e-4 * (TIMES - 1000), atol=1e-6)
    np.testing.assert_allclose(log.streams[1].times, TIMES + 50, atol=1e-6)
    assert log.notes == ()


def test_clock_that_began_anew_is_said(tmp_path: Path) -> None:
    count = 1200
    own = np.arange(count) / 60 + np.where(np.arange(count) < 600, 1000.0, -10.0)
    offsets = [(1000.0 + t, 0.0) for t in np.arange(0, 10, 0.5)]
    offsets += [(t, 1010.0) for t in np.arange(0.2, 10, 0.5)]
    values = np.tile(VALUES[:1], (count, 1))
    log = read_xdf(file(tmp_path, replace(IMU, times=own, values=values, offsets=offsets)))
    np.testing.assert_allclose(log.streams[0].times, 1000 + np.arange(count) / 60, atol=1e-3)
    assert "began anew" in log.notes[0]


def test_lost_packets_keep_the_times_of_the_others(tmp_path: Path) -> None:
    kept = np.flatnonzero((RNG.uniform(size=T) > 0.1) & (np.arange(T) != 30))
    log = read_xdf(file(tmp_path, replace(IMU, times=TIMES[kept], values=VALUES[kept])))
    np.testing.assert_allclose(log.streams[0].times, TIMES[kept], atol=1e-9)
    assert any("lost" in note for note in log.notes)


def test_jitter_is_said_and_a_declared_rate_removes_it(tmp_path: Path) -> None:
    path = file(tmp_path, replace(IMU, times=np.sort(TIMES + RNG.uniform(0, 0.05, T))))
    assert any("jitter" in note for note in read_xdf(path).notes)
    log = read_xdf(path, rate_hz=60.0)
    assert not any("jitter" in note for note in log.notes)
    np.testing.assert_allclose(np.diff(log.streams[0].times), 1 / 60)


def test_late_and_repeated_samples(tmp_path: Path) -> None:
    times = TIMES.copy()
    times[[10, 11]] = times[[11, 10]]
    times[21] = times[20]
    log = read_xdf(file(tmp_path, replace(IMU, times=times)))
    assert len(log.streams[0]) == T - 1
    assert [note.split()[1:3] for note in log.notes[:2]] == [["1", "samples"]] * 2


@pytest.mark.parametrize(("ids", "names"), [(("A1", "B2"), ("imu A1", "imu B2")), (("", ""), ("imu #4", "imu #9"))])
def test_two_streams_of_one_name_are_told_apart(ids: tuple[str, str], names: tuple[str, str], tmp_path: Path) -> None:
    pair = [
        replace(IMU, number=n, name="imu", source_id=i, values=VALUES + n) for n, i in zip((4, 9), ids, strict=True)
    ]
    log = read_xdf(file(tmp_path, *pair))
    assert log.names == names
    assert log.streams[1].f_sensor is not None
    np.testing.assert_array_equal(log.streams[1].f_sensor, VALUES[:, 4:] + 9)
    assert "imu" in log.file_notes[-1]


def test_streams_of_other_kinds_and_without_samples_are_left_aside(tmp_path: Path) -> None:
    empty = replace(IMU, number=2, name="head", times=TIMES[:0], values=VALUES[:0])
    unlabelled = replace(IMU, number=4, name="bare", labels=())
    forces = replace(EEG, number=5, name="plate", labels=("Fx", "Fy", "Fz"))
    log = read_xdf(file(tmp_path, EEG, IMU, empty, unlabelled, forces, POINTS))
    assert log.names == ("pelvis",)
    for name in ("EEG", "head", "bare", "plate", "pose"):
        assert any(f"stream {name}" in note for note in log.file_notes), name


def test_file_without_sensors_says_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="EEG"):
        read_xdf(file(tmp_path, EEG))


def test_units_of_each_stream(tmp_path: Path) -> None:
    grams = replace(IMU, number=2, name="head", units=[""] * 4 + ["g"] * 3)
    log = read_xdf(file(tmp_path, IMU, grams))
    pelvis, head = (one.f_sensor for one in log.streams)
    assert pelvis is not None
    assert head is not None
    np.testing.assert_allclose(head, 9.80665 * pelvis)
    assert any("units" in note for note in log.file_notes)


def test_points_as_detections(tmp_path: Path) -> None:
    path = file(tmp_path, IMU, POINTS)
    points = read_xdf_points(path)
    assert points.names == ("Nose", "LeftHand")
    np.testing.assert_allclose(points.times, TIMES[::2], atol=1e-9)
    np.testing.assert_array_equal(points.uv_px[:, 1], POINTS.values[:, 3:])
    np.testing.assert_array_equal(points.confidence[:, 0], POINTS.values[:, 2])
    two = file(tmp_path, POINTS, replace(POINTS, number=4, name="other"))
    with pytest.raises(FileFormatError, match="pose, other"):
        read_xdf_points(two)
    in_pixels = replace(POINTS, values=100 * POINTS.values, labels=[*POINTS.labels[:2], "z", *POINTS.labels[3:]])
    detected = read_detector_file(file(tmp_path, in_pixels))
    np.testing.assert_allclose(detected.uv_px[:, 0, 1], in_pixels.values[:, 3:])
    with pytest.raises(FileFormatError, match="pelvis"):
        read_xdf_points(file(tmp_path, IMU))


def test_file_is_recognised_by_its_content(tmp_path: Path) -> None:
    path = file(tmp_path, IMU, EEG).rename(tmp_path / "take.bin")
    assert recognise_source(path) is SourceKind.SENSORS
    assert read_sensor_log(path).format == "XDF"
    assert "pelvis" in str(inspect(path))


def test_recording_that_was_cut_off_is_read_up_to_its_last_chunk(tmp_path: Path) -> None:
    whole = content(IMU)
    path = tmp_path / "take.xdf"
    path.write_bytes(whole[: whole.rindex(b"<info><sample_count>") - 200])
    log = read_xdf(path)
    assert 0 < len(log.streams[0]) < T
    np.testing.assert_allclose(log.streams[0].times, TIMES[: len(log.streams[0])], atol=1e-9)
    assert "incomplete" in log.file_notes[0]
    path.write_bytes(whole[:300])
    with pytest.raises(FileFormatError):
        read_xdf(path)


@pytest.mark.parametrize("tag", [b"<info><version>", b"<info><name>pelvis", b"<info><sample_count>"])
def test_entities_are_refused_wherever_pyxdf_would_expand_them(tag: bytes, tmp_path: Path) -> None:
    whole = content(IMU)
    assert tag in whole
    path = tmp_path / "take.xdf"
    path.write_bytes(whole.replace(tag, b"<!DOCTYPE a>".ljust(len(tag)) if len(tag) >= 12 else tag))
    with pytest.raises(FileFormatError, match="declarations"):
        read_xdf(path)


def test_missing_file_and_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_xdf(tmp_path / "none.xdf")
    path = file(tmp_path, IMU)
    with pytest.raises(InvalidInputError, match="rate_hz"):
        read_xdf(path, rate_hz=-1.0)
    monkeypatch.setitem(sys.modules, "pyxdf", None)
    with pytest.raises(MissingPackageError, match=r"needs pyxdf.*rtof-kin\[live\]"):
        read_xdf(path)
