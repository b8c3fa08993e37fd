"""`RecordingReader`: any span of time equals that of the whole recording, in bounded memory."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from same_records import assert_same

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_motion import write_camera_motion
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording, RecordingReader

FIRST, LAST = 0.0, 10.0


def demo() -> Recording:
    """Ten seconds of the demo, whose sensors start later, with a second camera that starts later still."""
    whole = Recording.load(model_path("demo")).between(FIRST, LAST)
    assert whole.keypoints is not None
    assert whole.imus is not None
    return replace(whole, imus=whole.imus[30:], views=(whole.keypoints[150:400:2],), is_part=False)


# --- formats -------------------------------------------------------------------------------------


def as_saved(folder: Path) -> None:
    demo().save(folder)


def in_fortran_order(folder: Path) -> None:
    demo().save(folder)
    for path in folder.glob("*.npz"):
        with np.load(path) as arrays:
            turned: dict[str, Any] = {name: np.asfortranarray(arrays[name]) for name in arrays}
        np.savez(path, **turned)


def as_csv(folder: Path) -> None:
    recording = demo()
    recording.save(folder)
    keypoints, imus = recording.keypoints, recording.imus
    assert keypoints is not None
    assert imus is not None
    columns = {"time": keypoints.times}
    for i, name in enumerate(keypoints.names):
        columns |= {f"{name}_u_px": keypoints.uv_px[:, i, 0], f"{name}_v_px": keypoints.uv_px[:, i, 1]}
        columns |= {f"{name}_confidence": keypoints.confidence[:, i]}
    write_csv(folder / "keypoints.csv", columns)
    quat = so3.known_to_quat_wxyz(imus.R_inertial_sensor)
    columns = {"time": imus.times}
    for i, name in enumerate(imus.names):
        columns |= {f"{name}_q{axis}": quat[:, i, k] for k, axis in enumerate("wxyz")}
        columns |= {f"{name}_f{axis}": imus.f_sensor[:, i, k] for k, axis in enumerate("xyz")}
    write_csv(folder / "imus.csv", columns)
    with changed(folder) as index:
        index["keypoints"] = {"file": "keypoints.csv", "start_s": 0.0}
        index["imus"] |= {"file": "imus.csv", "clock_drift": 2e-5}
        del index["imus"]["names"]


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=",".join(columns), comments="")


def of_a_detector(folder: Path) -> None:
    """A detector's own file, without times, in which a person is followed."""
    demo().save(folder)
    with np.load(folder / "keypoints.npz") as arrays:
        uv, confidence = np.nan_to_num(arrays["uv_px"]), arrays["confidence"]
    np.savez(folder / "detected.npz", keypoints=uv, scores=confidence)
    with changed(folder) as index:
        person = {"layout": "joints", "person": 0}
        index["keypoints"] = {"file": "detected.npz", "rate_hz": 60.0, "start_s": 0.01} | person


def of_a_turning_camera(folder: Path) -> None:
    demo().save(folder)
    times = np.arange(-1, 12, 0.04)
    angles = np.stack([0.1 * np.sin(times), 0.3 * np.sin(0.5 * times), 0.02 * times], axis=-1)
    write_camera_motion(folder / "motion.npz", CameraMotion(times, so3.exp(angles), sigma=0.01))
    with changed(folder) as index:
        index["camera"]["motion"] = {"file": "motion.npz"}


def that_was_stabilised(folder: Path) -> None:
    """A saved recording of a handheld camera, with arrays that lead back to the video."""
    of_a_turning_camera(folder.parent / "turning")
    Recording.load(folder.parent / "turning").save(folder)


def without_a_camera(folder: Path) -> None:
    replace(demo(), keypoints=None, views=()).save(folder)


def of_sensor_files(folder: Path) -> None:
    """Sensors in the columns of a log, whose orientation is estimated over the whole."""
    recording = demo()
    recording.save(folder)
    imus = recording.imus
    assert imus is not None
    columns = {"time": imus.times}
    for i, name in enumerate(imus.names):
        R = imus.R_inertial_sensor[:, i]
        w = np.gradient(so3.log(R[0].T @ R), imus.times, axis=0)
        columns |= {f"{name}_w{axis}": w[:, k] for k, axis in enumerate("xyz")}
        columns |= {f"{name}_f{axis}": imus.f_sensor[:, i, k] for k, axis in enumerate("xyz")}
    write_csv(folder / "sensors.csv", columns)
    with changed(folder) as index:
        index["imus"]["file"] = "sensors.csv"


class changed:
    """The table of a folder's index, written back at the end."""

    def __init__(self, folder: Path):
        self.path = folder / INDEX

    def __enter__(self) -> dict[str, Any]:
        self.index = tomllib.loads(self.path.read_text())
        return self.index

    def __exit__(self, *_: object) -> None:
        self.path.write_text(tomli_w.dumps(self.index))


FORMATS = [
    as_saved,
    in_fortran_order,
    as_csv,
    of_a_detector,
    of_a_turning_camera,
    that_was_stabilised,
    without_a_camera,
    of_sensor_files,
]


@pytest.fixture(scope="module", params=FORMATS, ids=lambda made: made.__name__)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made: Callable[[Path], None] = request.param
    path = tmp_path_factory.mktemp(made.__name__) / "recording"
    made(path)
    return path


@pytest.fixture(scope="module")
def both(folder: Path) -> Iterator[tuple[Recording, RecordingReader]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rtof_kin.recording.streams.BLOCK", 128)
        patch.setattr("rtof_kin.core.over_time.BLOCK", 128)
        with RecordingReader.open(folder) as reader:
            yield Recording.load(folder), reader


# --- equality ------------------------------------------------------------------------------------


instants = st.floats(FIRST - 1, LAST + 1) | st.integers(0, 600).map(lambda frame: frame / 60)


@settings(max_examples=25, deadline=None)
@given(instants, instants)
def test_any_span_equals_that_of_the_whole(both: tuple[Recording, RecordingReader], one: float, other: float) -> None:
    whole, reader = both
    span = min(one, other), max(one, other)
    try:
        wanted = whole.between(*span)
    except InvalidInputError as error:
        with pytest.raises(InvalidInputError, match=re.escape(str(error))):
            reader.between(*span)
        return
    assert_same(reader.between(*span), wanted)


def test_it_is_saved_by_blocks_as_the_whole_is_by_numpy(
    both: tuple[Recording, RecordingReader], tmp_path: Path
) -> None:
    for name, recording in zip(("whole", "blocks"), both, strict=True):
        recording.save(tmp_path / name)
    files = [path for path in (tmp_path / "whole").glob("[!.]*") if path.suffix != ".toml"]
    assert files
    for file in files:
        content = file.read_bytes()
        assert (tmp_path / "blocks" / file.name).read_bytes() == content
        with np.load(file) as saved:
            np.savez_compressed(file, **saved)
        assert file.read_bytes() == content


# --- borders and streams that are missing --------------------------------------------------------


def test_samples_at_the_ends_belong_to_the_span() -> None:
    whole = demo()
    keypoints = whole.video
    part = whole.between(keypoints.times[10], keypoints.times[20])
    assert len(part.video) == 11
    assert part.first_frame == whole.first_frame + 10
    assert len(whole.between(keypoints.times[10] + 1e-9, keypoints.times[20] - 1e-9).video) == 9


def test_streams_without_samples_in_the_span_are_none() -> None:
    whole = demo()
    part = whole.between(0.1, 0.3)
    assert part.imus is None
    assert part.views == ()
    assert part.calibration is whole.calibration


def test_a_part_with_a_short_free_fall_keeps_the_unit_of_the_whole() -> None:
    whole = demo()
    assert whole.imus is not None
    f = np.array(whole.imus.f_sensor)
    f[100:140] *= 1e-3
    falling = replace(whole, imus=replace(whole.imus, f_sensor=f))
    assert falling.imus is not None
    times = falling.imus.times
    part = falling.between(times[100], times[139])
    assert part.imus is not None
    assert len(part.imus.select(part.imus.names[:2])) == 40


# --- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "array", "rows", "value", "message"),
    [
        # at the border of two blocks
        ("keypoints.npz", "times", 256, lambda times: times[255], "keypoint times: .* from index 255"),
        ("imus.npz", "times", 256, lambda times: times[255], "IMU times: .* from index 255"),
        ("truth.npz", "times", 256, lambda times: times[255], "pose times: .* from index 255"),
        ("imus.npz", "f_sensor", slice(None), lambda f: f / 9.81, "imus.npz: IMU .*which is one gravity in g"),
        ("imus.npz", "R_inertial_sensor", (300, 2), lambda R: R[300, 2] * 1.1, r"at index \(300, 2\)"),
        ("keypoints.npz", "confidence", (400, 3), lambda _: 2.0, r"confidence: outside \[0, 1\]"),
        ("keypoints.npz", "confidence", None, lambda confidence: confidence[:-1], "confidence: expected shape"),
        ("keypoints.npz", "uv", None, lambda _: np.zeros(3), "unknown array in .*'uv'"),
    ],
)
def test_errors_count_samples_from_the_start_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, array: str, rows: Any, value: Any, message: str
) -> None:
    monkeypatch.setattr("rtof_kin.recording.streams.BLOCK", 128)
    monkeypatch.setattr("rtof_kin.core.over_time.BLOCK", 128)
    folder = tmp_path / "recording"
    demo().save(folder)
    with np.load(folder / file) as saved:
        arrays: dict[str, Any] = {name: np.array(saved[name]) for name in saved}
    if rows is None:
        arrays[array] = value(arrays.get(array))
    else:
        arrays[array][rows] = value(arrays[array])
    np.savez(folder / file, **arrays)
    with pytest.raises(RtofError, match=message):
        RecordingReader.open(folder)


# --- memory --------------------------------------------------------------------------------------


def test_reading_by_minutes_takes_the_memory_of_some_minutes(tmp_path: Path) -> None:
    """All arrays of these minutes are 125 MB, and loading them takes several times that."""
    minutes = 8
    long = demo().between(1.0, 3.0)
    assert long.truth is not None
    tiled(long, minutes * 3600, 0).save(tmp_path / "hour")
    script = f"""
import resource
from rtof_kin.recording.recording import RecordingReader
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
with RecordingReader.open({str(tmp_path / "hour")!r}) as reader:
    assert len(reader.times) == {minutes * 3600}
    for minute in range({minutes}):
        part = reader.between(60 * minute - 3, 60 * minute + 63)
        assert len(part.truth) >= 3600
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 90


def tiled(recording: Recording, count: int, first: int) -> Recording:
    """A recording's first frames over and over, at 60 Hz from some frame on."""
    times = (first + np.arange(count)) / 60
    index = np.arange(count) % 100
    seen, imus, truth = recording.video, recording.imus, recording.truth
    assert imus is not None
    assert truth is not None
    return replace(
        recording,
        keypoints=replace(seen, times=times, uv_px=seen.uv_px[index], confidence=seen.confidence[index]),
        imus=ImuSequence(times, imus.R_inertial_sensor[index], imus.f_sensor[index], imus.names),
        truth=PoseSequence(times, truth.p_world_joint[index], truth.R_world_bone[index], truth.names),
        views=(),
    )
