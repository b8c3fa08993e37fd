"""Markers in TRC and C3D files: what they say, in which axes and units, and what is refused."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import c3d as pure_python_c3d
import ezc3d
import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError, ShapeError
from rtof_kin.formats.c3d import read_c3d, write_c3d
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.trc import read_trc, write_trc
from rtof_kin.formats.world_axes import UP
from rtof_kin.vision.keypoint_files import read_detector_file

DATA = Path(__file__).parents[1] / "fixtures"
REAL = DATA / "markers" / "two_people_P2.trc"
BODY25B = {"RHip": 12, "RKnee": 14, "RAnkle": 16, "LHip": 11, "LKnee": 13, "LAnkle": 15, "RElbow": 8}
TRC = """PathFileType\t4\t(X/Y/Z)\twalk.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
50\t50\t2\t2\tmm\t50\t1\t2
Frame#\tTime\tLeft heel\t\t\tC7\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2

1\t0.0\t100\t200\t300\t1\t2\t3
2\t0.02\t\t\t\t4\t5\t6
"""


@pytest.fixture
def markers() -> MarkerSequence:
    """Three markers at 50 Hz, from 0.1 s on, with a gap."""
    p = np.random.default_rng(3).normal(size=(12, 3, 3))
    p[4:6, 1] = np.nan
    return MarkerSequence((5 + np.arange(12)) / 50, ("LASI", "RASI", "Left heel"), p)


def same(a: MarkerSequence, b: MarkerSequence, tolerance: float) -> None:
    assert a.names == b.names
    np.testing.assert_allclose(a.times, b.times, atol=1e-9)
    np.testing.assert_allclose(a.p_world, b.p_world, atol=tolerance)  # NaN at the same places


# --- the record ----------------------------------------------------------------------------------


def test_markers_are_missing_as_a_whole_and_finite_otherwise(markers: MarkerSequence) -> None:
    p = np.array(markers.p_world)
    p[0, 0, 1] = np.nan
    assert np.isnan(MarkerSequence(markers.times, markers.names, p).p_world[0, 0]).all()
    p[0, 0, 1] = np.inf
    with pytest.raises(InvalidInputError, match="infinite; write NaN"):
        MarkerSequence(markers.times, markers.names, p)
    with pytest.raises(InvalidInputError, match="marker names: LASI .*more than once"):
        MarkerSequence(markers.times, ("LASI", "LASI", "C7"), markers.p_world)
    assert len(markers[2:5]) == 3
    assert markers.rate_hz == pytest.approx(50)


# --- TRC -----------------------------------------------------------------------------------------


def written(folder: Path, text: str) -> Path:
    path = folder / "walk.trc"
    path.write_text(text)
    return path


def test_a_trc_file_is_read_by_its_header(tmp_path: Path) -> None:
    markers = read_trc(written(tmp_path, TRC))
    assert markers.names == ("Left heel", "C7")
    np.testing.assert_allclose(markers.times, [0, 0.02])
    np.testing.assert_allclose(markers.p_world[:, 1], [[0.003, 0.001, 0.002], [0.006, 0.004, 0.005]])
    assert np.isnan(markers.p_world[1, 0]).all()


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
@pytest.mark.parametrize("up", UP)
def test_what_is_written_to_trc_is_read_back(
    up: str, unit: str, markers: MarkerSequence, tmp_path: Path
) -> None:
    path = tmp_path / "out.trc"
    write_trc(path, markers, up=up, unit=unit)
    same(read_trc(path, up=up), markers, 1e-9)
    with pytest.raises(OutputExistsError, match="out.trc: is there already"):
        write_trc(path, markers)


def test_a_gap_is_written_as_empty_cells_with_all_their_tabs(markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.trc"
    write_trc(path, markers)
    lines = path.read_text().splitlines()
    assert {line.count("\t") for line in lines[3:]} == {2 + 3 * 3}  # a tab ends the line, as OpenSim's
    assert lines[5 + 4].split("\t")[5:8] == ["", "", ""]


def test_opensims_ground_keeps_x_and_has_z_on_the_right(markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.trc"
    write_trc(path, markers, up="opensim")
    x, y, z = np.moveaxis(markers.p_world, -1, 0)
    in_file = markers.p_world @ UP["y"]  # as read_trc takes it apart where nothing is declared
    same(read_trc(path, up="opensim"), markers, 1e-9)
    assert not np.allclose(in_file, np.stack([x, z, -y], -1), equal_nan=True)
    first = path.read_text().splitlines()[5].split("\t")[2:5]
    np.testing.assert_allclose([float(cell) for cell in first], [x[0, 0], z[0, 0], -y[0, 0]], atol=1e-9)


def test_a_point_that_was_not_seen_has_residual_minus_one_and_no_nan_in_the_file(
    markers: MarkerSequence, tmp_path: Path
) -> None:
    path = tmp_path / "out.c3d"
    write_c3d(path, markers)
    data = path.read_bytes()
    (block,) = struct.unpack("<h", data[16:18])
    words = np.frombuffer(data[(block - 1) * 512 :], "<f4", 12 * 3 * 4).reshape(12, 3, 4)
    assert np.isfinite(words).all()
    np.testing.assert_array_equal(words[..., 3] == -1, np.isnan(markers.p_world[..., 0]))


def test_real_triangulated_markers_project_onto_the_detections_they_came_from() -> None:
    camera = read_camera_toml(DATA / "markers" / "cam_01.toml")["cam_01"]
    seen = read_detector_file(DATA / "detectors" / "two_people", 1088, 1920).uv_px[:, 0]
    markers = read_trc(REAL)
    assert markers.rate_hz == pytest.approx(60)
    points = [markers.names.index(name) for name in BODY25B]
    error_px = np.linalg.norm(
        camera.project(markers.p_world[:, points]) - seen[:, list(BODY25B.values())], axis=-1
    )
    assert np.median(error_px) < 15  # the detector's bias; a wrong axis makes it a thousand


def test_a_real_file_keeps_its_numbers_when_written_again(tmp_path: Path) -> None:
    write_trc(tmp_path / "again.trc", read_trc(REAL))
    same(read_trc(tmp_path / "again.trc"), read_trc(REAL), 1e-9)


@pytest.mark.parametrize(
    "old, new, line, says",
    [
        ("PathFileType", "FilePathType", 1, "expected PathFileType"),
        ("NumFrames", "Frames", 2, "the key NumFrames is missing"),
        ("50\t50\t2", "50\t2", 3, "7 values for the 8 keys"),
        ("50\t50\t2", "50\t50\tmany", 3, "NumFrames is 'many'"),
        ("mm", "furlong", 3, "Units 'furlong'; known: m, mm, cm"),
        ("\tC7", "", 4, "expected Frame#, Time and 2 names, one in every third cell; found 1"),
        ("Left heel\t\t\t", "Left\theel\t\t", 4, "'heel' between"),
        ("\t4\t5\t6", "\t4\t5", 8, "7 cells where there are 8 columns"),
        ("\t4\t5\t6", "\t4\t5\tx", 8, "not a number"),
        ("\t4\t5\t6", "\t4\t5\tinf", 8, "a number is infinite; leave the cells of a gap empty"),
        ("\t50\t2\t2\t", "\t50\t3\t2\t", 8, "announces 3 frames and 2 follow; is the file cut off"),
    ],
)
def test_a_broken_trc_file_is_named_with_its_line(
    old: str, new: str, line: int, says: str, tmp_path: Path
) -> None:
    assert old in TRC
    path = written(tmp_path, TRC.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        read_trc(path)
    assert str(caught.value).startswith(f"{path}, line {line}: ")
    assert says in str(caught.value)


def test_what_is_no_trc_file_and_arguments_without_sense_are_refused(
    markers: MarkerSequence, tmp_path: Path
) -> None:
    path = written(tmp_path, TRC)
    for content, says in ((b"", "empty"), (b"\xff\xfe\x00", "not a text file")):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=says):
            read_trc(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_trc(tmp_path / "none.trc")
    with pytest.raises(FileFormatError, match="marker times: time does not increase"):
        read_trc(written(tmp_path, TRC.replace("0.02", "0.0")))
    with pytest.raises(ShapeError, match="up: 'up' is no axis"):
        read_trc(path, up="up")
    with pytest.raises(ShapeError, match="unit: 'inch'"):
        write_trc(tmp_path / "a.trc", markers, unit="inch")
    odd = MarkerSequence(markers.times, ("a\tb", "c", "d"), markers.p_world)
    with pytest.raises(ShapeError, match="a tab or a line's end"):
        write_trc(tmp_path / "a.trc", odd)
    with pytest.raises(RtofError, match="cannot be written"):
        write_trc(path / "a.trc", markers)


# --- C3D -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("up", UP)
def test_what_is_written_to_c3d_is_read_back_by_what_the_file_says_is_up(
    up: str, markers: MarkerSequence, tmp_path: Path
) -> None:
    path = tmp_path / "out.c3d"
    write_c3d(path, markers, up=up)
    same(read_c3d(path), markers, 1e-6)
    with pytest.raises(OutputExistsError, match="out.c3d: is there already"):
        write_c3d(path, markers)


def test_more_markers_than_one_parameter_can_name_are_written_and_read(tmp_path: Path) -> None:
    many = MarkerSequence(np.arange(2) / 100, tuple(f"m{i}" for i in range(300)), np.ones((2, 300, 3)))
    write_c3d(tmp_path / "many.c3d", many)
    same(read_c3d(tmp_path / "many.c3d"), many, 1e-6)


def test_two_other_readers_agree_about_what_is_written(markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.c3d"
    write_c3d(path, markers)
    file = ezc3d.c3d(str(path))
    p_mm = file["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(p_mm / 1000, markers.p_world, atol=1e-6)
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == pytest.approx(50)
    frames = pure_python_frames(path)
    seen = np.isfinite(markers.p_world).all(axis=-1)
    np.testing.assert_array_equal(frames[..., 3] >= 0, seen)
    np.testing.assert_allclose(frames[seen, :3] / 1000, markers.p_world[seen], atol=1e-6)


def pure_python_frames(path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of files without analog channels
        with path.open("rb") as stream:
            reader = pure_python_c3d.Reader(stream)
            return np.array([points for _, points, _ in reader.read_frames(copy=True)])


def dec_float(value: float) -> bytes:
    low, high = struct.unpack("<2H", struct.pack("<f", 4 * value))
    return struct.pack("<2H", high, low)


def c3d_bytes(processor: int, as_integers: bool, changes: dict[str, object] | None = None) -> bytes:
    """A C3D file made by hand: two frames of two points and one analog channel, in mm."""
    order = ">" if processor == 86 else "<"

    def integer(*values: int) -> bytes:
        return struct.pack(f"{order}{len(values)}h", *values)

    def real(*values: float) -> bytes:
        if processor == 85:
            return b"".join(map(dec_float, values))
        return struct.pack(f"{order}{len(values)}f", *values)

    scale = 0.5 if as_integers else -1.0
    header = bytes([2, 0x50]) + integer(2, 1, 11, 12, 10) + real(scale) + integer(3, 1) + real(100)
    values: dict[str, object] = {"UNITS": "mm", "LABELS": ["A", "Sum"], "Y_SCREEN": "+Z", "RATE": 100.0}
    values |= {"SCALE": scale, "DATA_START": 3, **(changes or {})}
    entries = bytes([5, 255]) + b"POINT" + integer(3) + b"\0"
    for name, value in values.items():
        if isinstance(value, float):
            body = b"\4\0" + real(value)
        elif isinstance(value, int):
            body = b"\2\0" + integer(value)
        else:
            texts = [value] if isinstance(value, str) else list(value)  # type: ignore[call-overload]
            body = bytes([255, 2, 8, len(texts)]) + "".join(t.ljust(8) for t in texts).encode()
        entries += bytes([len(name), 1]) + name.encode() + integer(3 + len(body)) + body + b"\0"
    parameters = bytes([1, 0x50, 1, processor]) + entries + b"\0"
    points = [[[100, 200, 300, 0], [4, 5, 6, 0]], [[102, 202, 302, 0], [7, 8, 9, -1]]]

    def stored(x: int, y: int, z: int, residual: int) -> bytes:
        if as_integers:
            return integer(round(x / scale), round(y / scale), round(z / scale), residual)
        return real(x, y, z, residual)

    analog = integer(77) if as_integers else real(77)
    frames = b"".join(stored(*a) + stored(*b) + analog for a, b in points)
    return b"".join(part.ljust(512, b"\0") for part in (header, parameters, frames))


@pytest.mark.parametrize("as_integers", [False, True], ids=["floats", "integers"])
@pytest.mark.parametrize("processor", [84, 85, 86], ids=["Intel", "DEC", "MIPS"])
def test_every_way_to_store_numbers_is_read_as_another_reader_does(
    processor: int, as_integers: bool, tmp_path: Path
) -> None:
    path = tmp_path / "made.c3d"
    path.write_bytes(c3d_bytes(processor, as_integers))
    markers = read_c3d(path)
    assert markers.names == ("A", "Sum")
    np.testing.assert_allclose(markers.times, [0.10, 0.11])
    np.testing.assert_allclose(markers.p_world[:, 0], [[0.1, 0.2, 0.3], [0.102, 0.202, 0.302]])
    assert np.isnan(markers.p_world[1, 1]).all()
    frames = pure_python_frames(path)
    np.testing.assert_allclose(frames[:, 0, :3] / 1000, markers.p_world[:, 0], rtol=1e-6)


def test_what_a_model_derived_is_no_marker_and_a_point_without_a_label_gets_one(tmp_path: Path) -> None:
    path = tmp_path / "made.c3d"
    path.write_bytes(c3d_bytes(84, False, {"ANGLES": ["Sum"]}))
    assert read_c3d(path).names == ("A",)
    path.write_bytes(c3d_bytes(84, False, {"LABELS": ["A"]}))
    assert read_c3d(path).names == ("A", "*2")
    path.write_bytes(c3d_bytes(84, False, {"ANGLES": ["Sum", "A"]}))
    with pytest.raises(FileFormatError, match="no point in it"):
        read_c3d(path)


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"UNITS": "inch"}, "POINT:UNITS is 'inch'; known: m, mm, cm"),
        ({"Y_SCREEN": ""}, r"which axis points up \(POINT:Y_SCREEN\); declare it, e.g. up='z'"),
        ({"RATE": 0.0}, "POINT:RATE is 0 frames"),
        ({"FRAMES": 200}, "announces 200 frames and holds 14; it is damaged or was cut off"),
        ({"LABELS": ["A", "A"]}, "A .*more than once"),
        ({"DATA_START": 1}, "2 points that begin in block 1"),
    ],
)
def test_a_c3d_file_that_does_not_say_what_is_needed_is_refused(
    changes: dict[str, object], says: str, tmp_path: Path
) -> None:
    path = tmp_path / "made.c3d"
    path.write_bytes(c3d_bytes(84, False, changes))
    with pytest.raises(FileFormatError, match=says):
        read_c3d(path)
    if "Y_SCREEN" in changes:
        assert len(read_c3d(path, up="z")) == 2


def test_what_is_no_c3d_file_and_markers_without_a_rate_are_refused(
    markers: MarkerSequence, tmp_path: Path
) -> None:
    path = tmp_path / "a.c3d"
    for content in (b"", b"\2\x50" * 10, b"\0" * 2000):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match="not a C3D file"):
            read_c3d(path)
    path.write_bytes(b"\2\x50" + bytes(2000))
    with pytest.raises(FileFormatError, match="no known processor"):
        read_c3d(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_c3d(tmp_path / "none.c3d")
    uneven = MarkerSequence(markers.times**2, markers.names, markers.p_world)
    with pytest.raises(ShapeError, match="resample to one rate"):
        write_c3d(tmp_path / "b.c3d", uneven)
    with pytest.raises(RtofError, match="cannot be written"):
        write_c3d(path / "b.c3d", markers)
