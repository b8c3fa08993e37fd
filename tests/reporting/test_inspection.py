"""Inspection of input files: type, contents, checks, figures and the command `rtof-kin inspect`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core.checks import Verdict
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.markers import MarkerSequence, write_c3d, write_trc
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.inspection import MOST, inspect, picture

DATA = Path(__file__).parents[1] / "fixtures"
SENSORS = DATA / "inertial"
MTW = SENSORS / "hipose_mtw17"
WALK = DATA / "mocap" / "02_01_excerpt.bvh"
KEYPOINTS = DATA / "detectors" / "two_people" / "cam01.0040.json"
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


@pytest.mark.parametrize(
    "path, title",
    [
        (MTW, "MT Manager"),
        (SENSORS / "opensense_mtw8", "MT Manager"),
        (SENSORS / "qmt_walking", "MATLAB"),
        (SENSORS / "xio_lowerbody", "x-IMU3"),
        (SENSORS / "xsens_dot", "DOT"),
        (WALK, "BVH"),
        (DATA / "mocap" / "16_15.amc", "AMC motion capture with 16.asf"),
        (KEYPOINTS, "keypoints"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_types_of_real_files_are_recognised(path: Path, title: str) -> None:
    before = {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}
    found = inspect(path)
    assert title in found.title
    assert found.contents
    assert all(name and value for name, value in found.contents)
    assert {p: p.read_bytes() for p in path.rglob("*") if p.is_file()} == before


def test_sensor_logs_list_sensors_and_declaration() -> None:
    contents = dict(inspect(MTW).contents)
    sensor = next(value for name, value in contents.items() if name.startswith("sensor"))
    assert "at 60 Hz" in sensor
    assert sensor.endswith("acceleration, gyroscope, magnetometer, orientation")
    assert contents["declared acceleration unit"] == "m/s2"


def test_recordings_are_checked_by_reference_and_sensors(demo: Path, tmp_path: Path) -> None:
    for path in (demo, demo / "recording.toml"):
        found = inspect(path)
        assert (found.title, found.failed) == ("recording", ())
        names = {check.name for check in found.checks if check.passed}
        assert {"median reprojection error", "direction of gravity", "spread of length"} <= names
    recording = Recording.load(demo)
    replace(recording, keypoints=None).save(tmp_path / "blind")
    assert [name for name, _ in inspect(tmp_path / "blind").contents] == ["IMUs", "truth"]
    keypoints = replace(recording.keypoints, uv_px=recording.keypoints.uv_px + np.array([120.0, 0.0]))
    replace(recording, keypoints=keypoints).save(tmp_path / "moved")
    failed = inspect(tmp_path / "moved").failed
    assert [check.name for check in failed] == ["median reprojection error"]


def test_motions_list_their_skeleton_and_have_constant_bones(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.default(), 12)
    write_motion(tmp_path / "motion.h5", motion, mode="rtof")
    found = inspect(tmp_path / "motion.h5")
    assert (found.title, found.failed) == ("reconstructed motion", ())
    assert dict(found.contents)["mode"] == "rtof"
    assert len(found.bone_lengths) == 20


@pytest.mark.parametrize("suffix", ["trc", "c3d"])
def test_markers_are_checked_for_size_and_constant_bones(suffix: str, tmp_path: Path) -> None:
    write: Any = {"trc": write_trc, "c3d": write_c3d}[suffix]
    path = tmp_path / f"m.{suffix}"
    write(path, markers())
    found = inspect(path)
    assert not found.failed
    assert set(found.bone_lengths) == {"RHip to RKnee", "RKnee to RAnkle"}
    swapped = np.array(markers().p_world)
    swapped[10:20, [0, 1]] = swapped[10:20, [1, 0]]
    write(path, replace(markers(), p_world=swapped), overwrite=True)
    assert [check.subject for check in inspect(path).failed] == ["RKnee to RAnkle"]


def test_markers_in_a_wrong_unit_fail_by_size(tmp_path: Path) -> None:
    write_trc(tmp_path / "m.trc", markers(), unit="mm")
    path = copy_with(tmp_path / "m.trc", tmp_path / "wrong.trc", "\tmm\t", "\tm\t")
    check = next(c for c in inspect(path).failed if c.name == "size of the person")
    assert "mm" in check.advice


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


def test_unknown_skeletons_are_noted(tmp_path: Path) -> None:
    found = inspect(copy_with(WALK, tmp_path / "odd.bvh", "LeftLeg", "Portside"))
    assert dict(found.contents)["skeleton"] == "not known"
    assert "cannot be converted" in found.notes[0]


def test_csv_files_contain_sensors_or_keypoints(tmp_path: Path) -> None:
    sensors, points = tmp_path / "s.csv", tmp_path / "k.csv"
    rows = "\n".join(f"{i / 60:.4f},0.01,0.02,{9.8 + 0.001 * (i % 3)}" for i in range(120))
    sensors.write_text(f"time,a_fx,a_fy,a_fz\n{rows}\n")
    points.write_text("time,nose_x,nose_y,hip_x,hip_y\n0,100,200,110,400\n0.1,101,201,111,401\n")
    assert "sensor a" in dict(inspect(sensors).contents)
    assert inspect(points).title == "keypoints of a detector"
    with pytest.raises(FileFormatError, match=r"k\.csv"):
        inspect(points, acceleration_unit="g")


def test_missing_unknown_and_damaged_files_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "a.npz").write_bytes(b"PK no zip")
    for name in ("nothing.csv", "notes.txt", "a.npz"):
        with pytest.raises(FileFormatError, match=re.escape(name)):
            inspect(tmp_path / name)
    with pytest.raises(InvalidInputError, match="gravity"):
        inspect(WALK, gravity="removed")
    with pytest.raises(UnknownNameError, match="acceleration unit 'G'"):
        inspect(MTW, acceleration_unit="G")


def test_the_worst_sensors_are_plotted_first(tmp_path: Path) -> None:
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
    assert (len(titles), titles[0]) == (MOST, "s5")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["inspect", *map(str, arguments)])
    text = capsys.readouterr()
    return code, " ".join(text.out.split()), " ".join(text.err.split())


def test_plausible_files_exit_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = run(capsys, MTW, WALK)
    assert code == 0
    assert "MT Manager" in text
    assert "BVH" in text
    assert Verdict.FAILED.value not in text
    assert text.count("direction of gravity") == 1
    assert run(capsys, MTW, "--all")[1].count("direction of gravity") == 2


def test_an_implausible_file_exits_with_1_and_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    path = SENSORS / "xio_lowerbody"
    code, text, _ = run(capsys, path, "--declare", "acceleration_unit=m/s2", "angular_unit=rad/s")
    assert code == 1
    assert "--declare acceleration_unit=g angular_unit=deg/s" in text
    assert "likely" not in run(capsys, path, "--declare", "acceleration_unit=g", "angular_unit=deg/s")[1]


def test_a_figure_is_written_and_replaced_only_on_request(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    target = tmp_path / "p.png"
    target.write_text("mine")
    code, _, text = run(capsys, MTW, "--plot", target)
    assert (code, target.read_text()) == (2, "mine")
    assert "--overwrite" in text
    assert run(capsys, MTW, "--plot", target, "--overwrite")[0] == 0
    assert target.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere"], "nowhere"),
        ([MTW, "--declare", "unit=g"], "'unit'"),
        ([MTW, "--declare", "rate_hz=fast"], "'fast'"),
        ([MTW, "--plot", "p.pdf"], ".png"),
        (["a", "b", "--plot", "p.png"], "--plot"),
        (["x", "--declare", "gravity"], "FIELD=VALUE"),
    ],
)
def test_wrong_input_exits_with_2_and_one_line(
    arguments: list[object], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, text = run(capsys, *arguments)
    assert code == 2
    assert message in text
