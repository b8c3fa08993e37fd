"""Markers in TRC and C3D files: values, axes, units, and what is refused."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import c3d as pure_python_c3d
import ezc3d
import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.markers import MarkerSequence, rate_hz, read_c3d, read_trc, write_c3d, write_trc
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


def assert_same(a: MarkerSequence, b: MarkerSequence, tolerance: float) -> None:
    assert a.names == b.names
    np.testing.assert_allclose(a.times, b.times, atol=1e-9)
    np.testing.assert_allclose(a.p_world, b.p_world, atol=tolerance)  # NaN at the same places


def written(folder: Path, content: str | bytes, name: str = "walk.trc") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_markers_are_missing_as_a_whole_and_otherwise_finite(markers: MarkerSequence) -> None:
    p = np.array(markers.p_world)
    p[0, 0, 1] = np.nan
    assert np.isnan(MarkerSequence(markers.times, markers.names, p).p_world[0, 0]).all()
    p[0, 0, 1] = np.inf
    with pytest.raises(InvalidInputError, match="infinite"):
        MarkerSequence(markers.times, markers.names, p)
    with pytest.raises(InvalidInputError, match="LASI"):
        MarkerSequence(markers.times, ("LASI", "LASI", "C7"), markers.p_world)
    assert len(markers[2:5]) == 3
    assert rate_hz(markers.times) == pytest.approx(50)


@pytest.mark.parametrize("up", UP)
@pytest.mark.parametrize("unit", ["m", "cm", "mm", "c3d"])
def test_written_markers_are_read_back(up: str, unit: str, markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.c3d"
    if unit == "c3d":
        write_c3d(path, markers, up=up)
        assert_same(read_c3d(path), markers, 1e-6)
    else:
        write_trc(path, markers, up=up, unit=unit)
        assert_same(read_trc(path, up=up), markers, 1e-9)


@pytest.mark.parametrize("write", [write_trc, write_c3d])
def test_existing_file_and_folder_as_path_are_refused(write, markers: MarkerSequence, tmp_path: Path) -> None:
    write(tmp_path / "out.c3d", markers)
    with pytest.raises(OutputExistsError, match="out"):
        write(tmp_path / "out.c3d", markers)
    with pytest.raises(RtofError, match="cannot be written"):
        write(tmp_path / "out.c3d" / "deep", markers)
    with pytest.raises(InvalidInputError, match="up: 'w'"):
        write(tmp_path / "other", markers, up="w")


def test_trc_is_read_by_its_header(tmp_path: Path) -> None:
    markers = read_trc(written(tmp_path, TRC))
    assert markers.names == ("Left heel", "C7")
    np.testing.assert_allclose(markers.times, [0, 0.02])
    np.testing.assert_allclose(markers.p_world[:, 1], [[0.003, 0.001, 0.002], [0.006, 0.004, 0.005]])
    assert np.isnan(markers.p_world[1, 0]).all()


def test_trc_gap_is_empty_cells_with_all_their_tabs(markers: MarkerSequence, tmp_path: Path) -> None:
    write_trc(tmp_path / "out.trc", markers)
    lines = (tmp_path / "out.trc").read_text().splitlines()
    assert {line.count("\t") for line in lines[3:]} == {2 + 3 * 3}  # a tab ends the line, as OpenSim's
    assert lines[5 + 4].split("\t")[5:8] == ["", "", ""]


def test_trc_in_opensims_ground_has_z_on_the_right(markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.trc"
    write_trc(path, markers, up="opensim")
    assert_same(read_trc(path, up="opensim"), markers, 1e-9)
    x, y, z = markers.p_world[0, 0]
    first = path.read_text().splitlines()[5].split("\t")[2:5]
    np.testing.assert_allclose([float(cell) for cell in first], [x, z, -y], atol=1e-9)


def test_real_triangulated_markers_project_onto_their_detections(tmp_path: Path) -> None:
    camera = read_camera_toml(DATA / "markers" / "cam_01.toml")["cam_01"]
    seen = read_detector_file(DATA / "detectors" / "two_people", 1088, 1920).uv_px[:, 0]
    markers = read_trc(REAL)
    assert rate_hz(markers.times) == pytest.approx(60)
    points = [markers.names.index(name) for name in BODY25B]
    uv = camera.project(markers.p_world[:, points])
    error_px = np.linalg.norm(uv - seen[:, list(BODY25B.values())], axis=-1)
    assert np.median(error_px) < 15  # the detector's bias; a wrong axis makes it a thousand
    write_trc(tmp_path / "again.trc", markers)
    assert_same(read_trc(tmp_path / "again.trc"), markers, 1e-9)


@pytest.mark.parametrize(
    "old, new, line, says",
    [
        ("PathFileType", "FilePathType", 1, "PathFileType"),
        ("50\t50\t2", "50\t50\tmany", 3, "NumFrames is 'many'"),
        ("\t4\t5\t6", "\t4\t5", 8, "expected 7 cells of time and markers"),
        ("\t50\t2\t2\t", "\t50\t3\t2\t", 8, "3 frames and 2 follow"),
    ],
)
def test_broken_trc_is_named_with_its_line(old: str, new: str, line: int, says: str, tmp_path: Path) -> None:
    assert old in TRC
    path = written(tmp_path, TRC.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        read_trc(path)
    assert (caught.value.path, caught.value.line) == (path, line)
    assert says in str(caught.value)


def test_invalid_trc_and_arguments_are_refused(markers: MarkerSequence, tmp_path: Path) -> None:
    for content, says in ((b"", "empty"), (b"\xff\xfe\x00", "text"), (TRC.replace("0.02", "0.0"), "increase")):
        with pytest.raises(FileFormatError, match=says):
            read_trc(written(tmp_path, content))
    with pytest.raises(InvalidInputError, match="unit: 'inch'"):
        write_trc(tmp_path / "a.trc", markers, unit="inch")
    odd = MarkerSequence(markers.times, ("a\tb", "c", "d"), markers.p_world)
    with pytest.raises(InvalidInputError, match="a tab"):
        write_trc(tmp_path / "a.trc", odd)


def test_c3d_of_more_markers_than_one_parameter_can_name(tmp_path: Path) -> None:
    many = MarkerSequence(np.arange(2) / 100, tuple(f"m{i}" for i in range(300)), np.ones((2, 300, 3)))
    write_c3d(tmp_path / "many.c3d", many)
    assert_same(read_c3d(tmp_path / "many.c3d"), many, 1e-6)


def pure_python_frames(path: Path) -> np.ndarray:
    with warnings.catch_warnings(), path.open("rb") as stream:
        warnings.simplefilter("ignore")  # it warns of files without analog channels
        return np.array([p for _, p, _ in pure_python_c3d.Reader(stream).read_frames(copy=True)])


def test_two_other_readers_agree_about_a_written_c3d(markers: MarkerSequence, tmp_path: Path) -> None:
    path = tmp_path / "out.c3d"
    write_c3d(path, markers)
    file = ezc3d.c3d(str(path))
    p_mm = file["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(p_mm / 1000, markers.p_world, atol=1e-6)
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == pytest.approx(50)
    frames = pure_python_frames(path)
    assert np.isfinite(frames).all()
    seen = np.isfinite(markers.p_world).all(axis=-1)
    np.testing.assert_array_equal(frames[..., 3] == -1, ~seen)
    np.testing.assert_allclose(frames[seen, :3] / 1000, markers.p_world[seen], atol=1e-6)


def test_another_reader_counts_more_frames_than_the_header_can(tmp_path: Path) -> None:
    times = np.arange(70_000) / 100
    write_c3d(tmp_path / "long.c3d", MarkerSequence(times, ("a",), np.arange(210_000.0).reshape(-1, 1, 3) / 1e3))
    with warnings.catch_warnings(), (tmp_path / "long.c3d").open("rb") as stream:
        warnings.simplefilter("ignore")
        reader = pure_python_c3d.Reader(stream)
        assert (reader.first_frame, reader.last_frame) == (1, 70_000)
    assert len(read_c3d(tmp_path / "long.c3d")) == 70_000


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
def test_c3d_of_every_storage_of_numbers(processor: int, as_integers: bool, tmp_path: Path) -> None:
    markers = read_c3d(written(tmp_path, c3d_bytes(processor, as_integers), "made.c3d"))
    assert markers.names == ("A", "Sum")
    np.testing.assert_allclose(markers.times, [0.10, 0.11])
    np.testing.assert_allclose(markers.p_world[:, 0], [[0.1, 0.2, 0.3], [0.102, 0.202, 0.302]])
    assert np.isnan(markers.p_world[1, 1]).all()
    frames = pure_python_frames(tmp_path / "made.c3d")
    np.testing.assert_allclose(frames[:, 0, :3] / 1000, markers.p_world[:, 0], rtol=1e-6)


@pytest.mark.parametrize(
    "changes, names",
    [({"ANGLES": ["Sum"]}, ("A",)), ({"LABELS": ["A"]}, ("A", "*2")), ({"LABELS": [], "LABELS2": 3}, ("*1", "*2"))],
)
def test_c3d_unlabelled_points(changes: dict[str, object], names: tuple[str, ...], tmp_path: Path) -> None:
    assert read_c3d(written(tmp_path, c3d_bytes(84, False, changes))).names == names


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"ANGLES": ["Sum", "A"]}, "no point"),
        ({"Y_SCREEN": ""}, "POINT:Y_SCREEN.*up='z'"),
        ({"FRAMES": 200}, "announces 200 frames and holds 14"),
        ({"DATA_START": 1}, "block 1"),
    ],
)
def test_incomplete_c3d_is_refused(changes: dict[str, object], says: str, tmp_path: Path) -> None:
    path = written(tmp_path, c3d_bytes(84, False, changes))
    with pytest.raises(FileFormatError, match=says):
        read_c3d(path)
    if "Y_SCREEN" in changes:
        assert len(read_c3d(path, up="z")) == 2


@pytest.mark.parametrize(
    "content, says",
    [
        (b"", "not a C3D file"),
        (b"\2\x50" * 10, "not a C3D file"),
        (b"\0" * 2000, "not a C3D file"),
        (b"\2\x50" + bytes(2000), "no known processor"),
        (c3d_bytes(84, False)[:560].ljust(1024, b"\xff"), "parameter"),
    ],
)
def test_damaged_c3d_is_refused(content: bytes, says: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=says):
        read_c3d(written(tmp_path, content))


def test_c3d_needs_times_of_one_rate(markers: MarkerSequence, tmp_path: Path) -> None:
    uneven = MarkerSequence(markers.times**2, markers.names, markers.p_world)
    with pytest.raises(InvalidInputError, match="resample"):
        write_c3d(tmp_path / "b.c3d", uneven)
