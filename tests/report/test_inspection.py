"""`inspect` says what every kind of file is, what it holds, and what of it cannot be true."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.core.plausibility import Verdict
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.formats.c3d import write_c3d
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.motion_npz import write_motion_npz
from rtof_kin.formats.trc import write_trc
from rtof_kin.recording.recording import Recording
from rtof_kin.report.inspection import inspect
from rtof_kin.report.inspection_figures import MOST, picture

DATA = Path(__file__).parents[1] / "fixtures"
SENSORS = DATA / "inertial"
YAML = """%YAML:1.0
---
image_width: 1920
image_height: 1080
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1250., 0., 960., 0., 1250., 540., 0., 0., 1. ]
"""
CAL = "1 1\n0 1079 0 1919\n1250 1250 960 540\n0\n1 0 0\n0 -1 0\n0 0 -1\n-1 2 5\n"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seconds of the demo as a recording folder."""
    recording = Recording.load(model_path("demo"))
    folder = tmp_path_factory.mktemp("recordings") / "short"
    replace(recording, keypoints=recording.keypoints[600:900]).save(folder)
    return folder


def markers(T: int = 30) -> MarkerSequence:
    body = np.array([[0, -0.1, 0.9], [0, -0.1, 0.5], [0, -0.1, 0.1], [0, 0, 1.5], [0, 0, 1.7]])
    p = body + np.linspace(0, 1, T)[:, None, None] * np.array([1.0, 0, 0])
    return MarkerSequence(np.arange(T) / 60, ("RHip", "RKnee", "RAnkle", "Neck", "Head"), p)


def copy_with(source: Path, target: Path, old: str, new: str) -> Path:
    text = source.read_text()
    assert old in text
    target.write_text(text.replace(old, new))
    return target


# --- every kind of file --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, title",
    [
        ("inertial/hipose_mtw17", "MT Manager"),
        ("inertial/opensense_mtw8", "MT Manager"),
        ("inertial/qmt_walking", "MATLAB"),
        ("inertial/xio_lowerbody", "x-IMU3"),
        ("inertial/xsens_dot", "DOT"),
        ("mocap/02_01_excerpt.bvh", "BVH"),
        ("mocap/16_15.amc", "AMC motion capture with 16.asf"),
        ("detectors/two_people/cam01.0040.json", "keypoints"),
    ],
)
def test_real_files_are_told_for_what_they_are(name: str, title: str) -> None:
    found = inspect(DATA / name)
    assert title in found.title
    assert found.contents
    assert all(name and value for name, value in found.contents)


def test_a_sensor_log_tells_its_sensors_and_what_is_declared() -> None:
    contents = dict(inspect(SENSORS / "hipose_mtw17").contents)
    sensor = next(value for name, value in contents.items() if name.startswith("sensor"))
    assert "at 60 Hz" in sensor
    assert sensor.endswith("acceleration, gyroscope, magnetometer, orientation")
    assert contents["declared acceleration unit"] == "m/s2"


def test_a_recording_is_checked_by_its_truth_and_its_sensors(demo: Path) -> None:
    for path in (demo, demo / "recording.toml"):
        found = inspect(path)
        assert found.title == "recording"
        assert not found.failed
        names = {check.name for check in found.checks if check.passed}
        assert {"median reprojection error", "direction of gravity", "spread of length"} <= names


def test_a_recording_that_nobody_filmed_is_checked_by_its_sensors_and_its_truth(
    demo: Path, tmp_path: Path
) -> None:
    replace(Recording.load(demo), keypoints=None).save(tmp_path / "blind")
    found = inspect(tmp_path / "blind")
    assert [name for name, _ in found.contents] == ["IMUs", "truth"]


def test_a_recording_whose_camera_is_another_fails_by_reprojection(demo: Path, tmp_path: Path) -> None:
    recording = Recording.load(demo)
    keypoints = replace(recording.keypoints, uv_px=recording.keypoints.uv_px + np.array([120.0, 0.0]))
    replace(recording, keypoints=keypoints).save(tmp_path / "moved")
    failed = inspect(tmp_path / "moved").failed
    assert [check.name for check in failed] == ["median reprojection error"]


def test_a_motion_tells_its_skeleton_and_keeps_its_bones(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.default(), 12)
    write_motion_npz(tmp_path / "motion.npz", motion, mode="rtof")
    found = inspect(tmp_path / "motion.npz")
    assert found.title == "reconstructed motion"
    assert dict(found.contents)["mode"] == "rtof"
    assert not found.failed
    assert len(found.bone_lengths) == 20


@pytest.mark.parametrize("write", [write_trc, write_c3d])
def test_markers_are_checked_for_size_and_rigid_bones(write: object, tmp_path: Path) -> None:
    path = tmp_path / ("m.trc" if write is write_trc else "m.c3d")
    write(path, markers())  # type: ignore[operator]
    found = inspect(path)
    assert not found.failed
    assert set(found.bone_lengths) == {"RHip to RKnee", "RKnee to RAnkle"}
    swapped = np.array(markers().p_world)
    swapped[10:20, [0, 1]] = swapped[10:20, [1, 0]]
    write(path, replace(markers(), p_world=swapped), overwrite=True)  # type: ignore[operator]
    assert [check.subject for check in inspect(path).failed] == ["RKnee to RAnkle"]


def test_a_trc_in_millimetres_that_says_metres_is_no_person(tmp_path: Path) -> None:
    write_trc(tmp_path / "m.trc", markers(), unit="mm")
    path = copy_with(tmp_path / "m.trc", tmp_path / "wrong.trc", "\tmm\t", "\tm\t")
    check = next(c for c in inspect(path).failed if c.name == "size of the person")
    assert check.advice.endswith("are they in mm?")


def test_cameras_of_three_formats_are_checked(tmp_path: Path) -> None:
    camera = Camera.looking_at([4.0, 0, 1.5], [0, 0, 1.0], 1250.0)
    write_camera_toml(tmp_path / "c.toml", {"left": camera})
    (tmp_path / "c.yml").write_text(YAML)
    (tmp_path / "c.cal").write_text(CAL)
    for name, title in (("c.toml", "TOML"), ("c.yml", "OpenCV"), ("c.cal", "Total Capture")):
        found = inspect(tmp_path / name)
        assert title in found.title
        assert not found.failed
        assert len(found.checks) == 3
    bad = copy_with(tmp_path / "c.yml", tmp_path / "b.yml", "[ 1250.", "[ 12.50")
    assert {check.name for check in inspect(bad).failed} == {"focal length", "pixels not square"}


def test_an_unknown_skeleton_is_a_note(tmp_path: Path) -> None:
    source = DATA / "mocap" / "02_01_excerpt.bvh"
    path = copy_with(source, tmp_path / "odd.bvh", "LeftLeg", "Portside")
    found = inspect(path)
    assert dict(found.contents)["skeleton"] == "not known"
    assert "cannot be carried over" in found.notes[0]


def test_a_csv_is_sensors_or_keypoints_by_what_it_holds(tmp_path: Path) -> None:
    sensors, points = tmp_path / "s.csv", tmp_path / "k.csv"
    rows = "\n".join(f"{i / 60:.4f},0.01,0.02,{9.8 + 0.001 * (i % 3)}" for i in range(120))
    sensors.write_text(f"time,a_fx,a_fy,a_fz\n{rows}\n")
    points.write_text("time,nose_x,nose_y,hip_x,hip_y\n0,100,200,110,400\n0.1,101,201,111,401\n")
    assert "sensor a" in dict(inspect(sensors).contents)
    assert inspect(points).title == "keypoints of a detector"
    with pytest.raises(FileFormatError, match="no file of sensors that is known"):
        inspect(points, acceleration_unit="g")


def test_what_is_not_there_or_not_known_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no such file or folder"):
        inspect(tmp_path / "nothing.csv")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(FileFormatError, match="no file of sensors that is known"):
        inspect(tmp_path / "notes.txt")
    (tmp_path / "a.npz").write_bytes(b"PK no zip")
    with pytest.raises(FileFormatError, match=r"a\.npz"):
        inspect(tmp_path / "a.npz")
    with pytest.raises(ShapeError, match="no sensor log, so gravity cannot be declared"):
        inspect(DATA / "mocap" / "02_01_excerpt.bvh", gravity="removed")
    with pytest.raises(UnknownNameError, match="acceleration unit 'G'"):
        inspect(SENSORS / "hipose_mtw17", acceleration_unit="G")


# --- pictures ------------------------------------------------------------------------------------


def test_every_axis_of_a_picture_has_a_unit_or_counts_frames(tmp_path: Path) -> None:
    write_trc(tmp_path / "m.trc", markers())
    for path in (SENSORS / "xsens_dot_as_mtw", SENSORS / "hipose_mtw17", tmp_path / "m.trc"):
        figure = picture(inspect(path))
        assert figure is not None
        for ax in figure.axes:
            assert "[" in ax.get_ylabel()
        labels = [ax.get_xlabel() for ax in figure.axes if ax.get_xlabel()]
        assert set(labels) <= {"time [s]", "frame"}
    assert picture(inspect(DATA / "detectors" / "two_people" / "cam01.0040.json")) is None


def test_the_sensor_that_is_furthest_off_is_drawn_first(tmp_path: Path) -> None:
    T = 300
    columns, rows = ["time"], [np.arange(T) / 60]
    for i in range(MOST + 2):
        columns += [f"s{i}_f{axis}" for axis in "xyz"]
        f = np.random.default_rng(i).normal(0, 0.02, (T, 3))
        f[:, 2] += 9.81 if i != 5 else 0.98
        rows += list(f.T)
    text = "\n".join(",".join(f"{x:.5f}" for x in row) for row in np.array(rows).T)
    (tmp_path / "log.csv").write_text(f"{','.join(columns)}\n{text}\n")
    figure = picture(inspect(tmp_path / "log.csv"))
    assert figure is not None
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    assert len(titles) == MOST
    assert titles[0] == "s5"


# --- the command ---------------------------------------------------------------------------------


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["inspect", *map(str, arguments)])
    text = capsys.readouterr()
    return code, " ".join(text.out.split()), " ".join(text.err.split())


def test_good_files_exit_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = run(capsys, SENSORS / "hipose_mtw17", DATA / "mocap" / "02_01_excerpt.bvh")
    assert code == 0
    assert "MT Manager" in text
    assert "BVH" in text
    assert "does not hold" not in text


def test_a_wrong_file_exits_with_1_and_names_the_option_that_repairs_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = SENSORS / "xio_lowerbody"
    code, text, _ = run(capsys, path, "--declare", "acceleration_unit=m/s2", "angular_unit=rad/s")
    assert code == 1
    assert "likely: --declare acceleration_unit=g angular_unit=deg/s" in text
    code, text, _ = run(capsys, path, "--declare", "acceleration_unit=g", "angular_unit=deg/s")
    assert "likely" not in text


def test_all_prints_every_sensor(capsys: pytest.CaptureFixture[str]) -> None:
    brief = run(capsys, SENSORS / "hipose_mtw17")[1]
    full = run(capsys, SENSORS / "hipose_mtw17", "--all")[1]
    assert brief.count("direction of gravity") == 1
    assert full.count("direction of gravity") == 2


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_a_narrow_terminal_loses_no_figure_and_no_verdict(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    path = SENSORS / "hipose_mtw17"
    assert main(["inspect", str(path), "--all"]) == 0
    text = capsys.readouterr().out
    assert "\u2026" not in text
    checks = inspect(path).checks
    assert sum(text.count(f"  {verdict.value} ") for verdict in Verdict) == len(checks)
    assert {f"{check.value:.3g}" for check in checks if check.passed} <= set(re.split("[ ,]", text))


def test_a_picture_is_written_and_never_replaced_unasked(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    target = tmp_path / "p.png"
    assert run(capsys, SENSORS / "hipose_mtw17", "--plot", target)[0] == 0
    assert target.read_bytes().startswith(b"\x89PNG")
    target.write_text("mine")
    code, _, text = run(capsys, SENSORS / "hipose_mtw17", "--plot", target)
    assert (code, target.read_text()) == (2, "mine")
    assert "is there already; ask to overwrite it (--overwrite;" in text
    assert run(capsys, SENSORS / "hipose_mtw17", "--plot", target, "--overwrite")[0] == 0
    assert target.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere"], "there is no such file or folder"),
        ([SENSORS / "hipose_mtw17", "--declare", "unit=g"], "field of a declaration 'unit'"),
        ([SENSORS / "hipose_mtw17", "--declare", "rate_hz=fast"], "'fast' is not a number"),
        ([SENSORS / "hipose_mtw17", "--plot", "p.pdf"], "ends in .png"),
        (["a", "b", "--plot", "p.png"], "--plot draws one FILE, 2 are named"),
    ],
)
def test_wrong_input_exits_with_2_and_one_line(
    arguments: list[object], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, text = run(capsys, *arguments)
    assert code == 2
    assert message in text


def test_a_declaration_without_a_value_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["inspect", "x", "--declare", "gravity"])
    assert "is not FIELD=VALUE, such as acceleration_unit=g" in capsys.readouterr().err


def test_a_copy_of_the_folder_is_read_without_changing_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(SENSORS / "xio_lowerbody", tmp_path / "log")
    before = {p: p.read_bytes() for p in (tmp_path / "log").rglob("*") if p.is_file()}
    run(capsys, tmp_path / "log")
    assert {p: p.read_bytes() for p in (tmp_path / "log").rglob("*") if p.is_file()} == before
