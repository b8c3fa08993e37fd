"""What is recorded becomes a recording, also after the process was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from full_disk import full_disk
from live_support import FakeEstimator, FakeSource, count, demo, drive, frame_samples, imu_samples, name_of, shaken

from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.recorded_session import LIVE, finish
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import Clock, ImuSample, Sample
from rtof_kin.live.session import LiveSession
from rtof_kin.recording.recording import Recording

SUPPORT = Path(__file__).parent.parent / "support"
KILLED = """
import sys, time
from live_support import demo, frame_samples, imu_samples
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.recorder import Recorder
recorder = Recorder(sys.argv[1], demo(), chunk_s=0.5)
recorder.landmarks(demo().video.names)
for sample in sorted(imu_samples(2.2) + frame_samples(2.2), key=lambda sample: sample.time):
    recorder.add(Arrived("demo", sample, sample.time, sample.time))
while len(list((recorder.folder / "live").glob("0*.npz"))) < 4:
    time.sleep(0.01)
print("ready", flush=True)
time.sleep(60)
"""


def recorded(folder: Path, samples: list[Sample], **options: float) -> Recorder:
    """A recorder that took these samples, without a thread."""
    recorder = Recorder(folder, demo(), in_background=False, **options)
    recorder.landmarks(demo().video.names)
    for sample in sorted(samples, key=lambda sample: sample.time):
        recorder.add(Arrived("demo", sample, sample.time, sample.time))
    return recorder


def test_recording_has_what_came(tmp_path: Path) -> None:
    assert recorded(tmp_path / "walk", imu_samples(3.0) + frame_samples(3.0)).finish() == ()
    found, whole = Recording.load(tmp_path / "walk"), demo()
    assert found.imus is not None
    assert whole.imus is not None
    n, start = len(found.imus), whole.imus.times[0]
    np.testing.assert_allclose(found.imus.times, whole.imus.times[:n] - start, atol=1e-12)
    np.testing.assert_allclose(found.imus.R_inertial_sensor, whole.imus.R_inertial_sensor[:n], atol=1e-9)
    np.testing.assert_array_equal(found.imus.f_sensor, whole.imus.f_sensor[:n])
    np.testing.assert_array_equal(found.video.uv_px, whole.video.uv_px[: len(found.video)])
    np.testing.assert_allclose(found.video.times, whole.video.times[: len(found.video)] - start, atol=1e-12)
    assert found.imus.names == whole.imus.names
    assert found.calibration is not None
    assert found.calibration.sensors == whole.calibration.sensors
    np.testing.assert_array_equal(found.joint_offsets, whole.joint_offsets)


def test_lost_samples_are_missing_in_the_recording(tmp_path: Path) -> None:
    kept = [sample for _, sample in shaken(imu_samples(3.0), 0.0, 0.1, seed=1)]
    notes = recorded(tmp_path / "walk", kept).finish()
    found = Recording.load(tmp_path / "walk").imus
    assert found is not None
    known = np.isfinite(found.f_sensor).all(axis=-1)
    assert known.sum() == len(kept)
    assert sum("did not come" in note for note in notes) == len(found.names)


def test_sensors_of_other_rates_are_joined(tmp_path: Path) -> None:
    slow = [s for i, s in enumerate(imu_samples(3.0)) if name_of(s) != "L_UpArm" or i % 16 < 8]
    moved = [replace(s, time=s.time + 0.005) if name_of(s) == "R_UpArm" else s for s in slow]
    recorded(tmp_path / "walk", moved).finish()
    found = Recording.load(tmp_path / "walk").imus
    assert found is not None
    assert found.names == demo().imus.names
    assert np.isfinite(found.f_sensor).all(axis=-1).mean() > 0.9


def test_video_delay_is_taken_off(tmp_path: Path) -> None:
    recorded(tmp_path / "walk", imu_samples(2.0) + frame_samples(2.0), video_delay_s=0.05).finish()
    found, whole = Recording.load(tmp_path / "walk"), demo()
    assert whole.imus is not None
    expected = whole.video.times[0] - whole.imus.times[0] - 0.05
    assert found.video.times[0] == pytest.approx(expected)


def test_frozen_samples_are_no_part_of_the_recording(tmp_path: Path) -> None:
    stuck = next(s for s in imu_samples(3.0) if name_of(s) == "R_UpLeg" and s.time > 1.0)
    samples = [
        replace(stuck, time=s.time) if name_of(s) == "R_UpLeg" and 1.0 < s.time < 2.0 else s for s in imu_samples(3.0)
    ]
    notes = recorded(tmp_path / "walk", samples).finish()
    found = Recording.load(tmp_path / "walk").imus
    assert found is not None
    known = np.isfinite(found.f_sensor[:, found.names.index("R_UpLeg")]).all(axis=-1)
    assert np.sum(~known) == pytest.approx(59, abs=1)
    assert any("R_UpLeg" in note and "repeated" in note for note in notes)


def test_sensor_of_wrong_unit_and_unknown_sensor_are_left_out_with_a_note(tmp_path: Path) -> None:
    samples: list[Sample] = []
    for s in imu_samples(2.0):
        assert isinstance(s, ImuSample)
        if s.sensor == "L_UpArm":
            s = replace(s, f_sensor=s.f_sensor / 9.80665)
        samples.append(replace(s, sensor="phone") if s.sensor == "R_UpArm" else s)
    notes = recorded(tmp_path / "walk", samples).finish()
    found = Recording.load(tmp_path / "walk")
    assert found.imus is not None
    assert not {"L_UpArm", "R_UpArm", "phone"} & set(found.imus.names)
    assert any("L_UpArm" in note for note in notes)
    assert any("phone" in note for note in notes)
    assert all(note in found.notes for note in notes)


def test_samples_and_estimates_stay_as_they_came(tmp_path: Path) -> None:
    source = FakeSource("imus", [(s.time + 500, s) for s in imu_samples(1.0)], Clock.OWN)
    recorder = Recorder(tmp_path / "walk", demo(), in_background=False)
    session = LiveSession(demo(), [source], FakeEstimator(), recorder=recorder, in_background=False)
    drive(session, [source], 501.0, 500.0)
    summary = session.finish(501.0)
    assert summary.folder == tmp_path / "walk"
    chunk = read_npz_as_saved(tmp_path / "walk" / LIVE / "000001.npz", kinds="fiubU")
    first = imu_samples(1.0)[0]
    assert chunk["imu_stamp"][0] == first.time
    assert chunk["imu_arrival"][0] == pytest.approx(500 + first.time, abs=0.02)
    assert chunk["imu_time"][0] == pytest.approx(500 + first.time, abs=0.02)
    assert list(chunk["imu_sources"]) == ["imus"]
    assert len(chunk["pose_time"]) == len(chunk["p_world_joint"]) == summary.frames
    assert len(Recording.load(tmp_path / "walk").imus or ()) > 50


def test_killed_session_is_finished_later(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(SUPPORT)])}
    with subprocess.Popen([sys.executable, "-c", KILLED, folder], stdout=subprocess.PIPE, env=env) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        with pytest.raises(OutputExistsError, match="a session is recorded there"):
            finish(folder)
        process.send_signal(signal.SIGKILL)
    finish(folder)
    found = Recording.load(folder)
    assert found.imus is not None
    assert 110 <= len(found.imus) <= 130
    assert len(found.video) >= 110
    with pytest.raises(OutputExistsError, match="walk"):
        finish(folder)


def test_damaged_file_is_noted_and_the_rest_kept(tmp_path: Path) -> None:
    recorder = recorded(tmp_path / "walk", imu_samples(3.0), chunk_s=1.0)
    recorder.close()
    path = tmp_path / "walk" / LIVE / "000002.npz"
    path.write_bytes(path.read_bytes()[:1000])
    notes = finish(tmp_path / "walk")
    assert any("000002.npz" in note for note in notes)
    found = Recording.load(tmp_path / "walk").imus
    assert found is not None
    assert len(found) == pytest.approx(120, abs=2)


def test_folder_with_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match=r"mine\.txt"):
        Recorder(tmp_path, demo())
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_files_of_the_user_survive_the_finish(tmp_path: Path) -> None:
    recorder = recorded(tmp_path / "walk", imu_samples(1.0))
    (tmp_path / "walk" / "mine.txt").write_text("mine")
    recorder.finish()
    assert (tmp_path / "walk" / "mine.txt").read_text() == "mine"
    with pytest.raises(OutputExistsError, match=r"mine\.txt"):
        demo().save(tmp_path / "walk", overwrite=True)


@pytest.mark.parametrize("in_background", [False, True])
def test_a_file_that_cannot_be_written_is_tried_again_and_nothing_is_lost(
    tmp_path: Path, in_background: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtof_kin.live.recorder._AGAIN", 0.02)
    source = FakeSource("imus", [(s.time, s) for s in imu_samples(2.0)])
    recorder = Recorder(tmp_path / "walk", demo(), chunk_s=0.5, in_background=in_background)
    session = LiveSession(demo(), [source], FakeEstimator(), recorder=recorder, in_background=False)
    with full_disk():
        told = drive(session, [source], 1.5)
        deadline = time.monotonic() + 5
        while not (told and count(told, "walk")) and time.monotonic() < deadline:
            time.sleep(0.01)
            told += drive(session, [source], 1.6, 1.5)
    told += drive(session, [source], 2.0, 1.6)
    assert count(told, "000001.npz cannot be written", "tried again") == 1
    summary = session.finish(2.0)
    assert sum("written again; lost: nothing" in text for text in summary.sentences) == 1
    assert summary.folder == tmp_path / "walk"
    assert len(Recording.load(tmp_path / "walk").imus or ()) >= 119


def test_what_a_full_disk_cost_is_told_and_the_rest_can_be_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtof_kin.live.recorder._PENDING", 2)
    source = FakeSource("imus", [(s.time, s) for s in imu_samples(3.0)])
    recorder = Recorder(tmp_path / "walk", demo(), chunk_s=0.25, in_background=False)
    session = LiveSession(demo(), [source], FakeEstimator(), recorder=recorder, in_background=False)
    told = drive(session, [source], 1.0)
    with full_disk():
        told += drive(session, [source], 2.0, 1.0)
        assert count(told, "goes on without being recorded") == 1
        drive(session, [source], 3.0, 2.0)
        summary = session.finish(3.0)
    assert summary.folder is None
    said = " ".join(summary.sentences[-2:])
    assert "no recording was made" in said
    assert "s are not recorded" in said
    with pytest.raises(FileFormatError, match=r"was not finished; rtof-kin live --finish .*walk makes"):
        Recording.load(tmp_path / "walk")
    finish(tmp_path / "walk")
    assert 40 < len(Recording.load(tmp_path / "walk").imus or ()) < 80


def test_nothing_recorded_and_no_session_are_errors(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="walk"):
        Recorder(tmp_path / "walk", demo()).finish()
    with pytest.raises(FileFormatError, match="empty"):
        finish(tmp_path / "empty")
