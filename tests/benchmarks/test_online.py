"""The benchmark of the online estimator, with a stand-in that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from benchmarks.online import accuracy, figure, recordings, soak, speed
from benchmarks.online.running import tracks
from benchmarks.online.speed import Spent, drift_mb_per_hour
from benchmarks.online.streams import frozen, portions, setup_of
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import PoseSequence
from rtof_kin.live.replay import Faults
from rtof_kin.live.samples import FrameSample, OnlineEstimate, Sample
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip

BODY = SkeletonModel.default()


@dataclass(frozen=True)
class Settings:
    lag_s: float = 0.0
    confidence: bool = False
    video_delay_s: float = 0.0


@dataclass
class StandIn:
    """Returns the truth, raised by 10 mm at lag 0 and by less later; without a camera it sinks."""

    truth: PoseSequence
    settings: Settings
    given: int = 0
    newest: float = -np.inf
    frames: list[float] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    hurried: int = 0

    def push(self, sample: Sample) -> None:
        self.newest = max(self.newest, sample.time)
        if isinstance(sample, FrameSample):
            self.frames.append(sample.time)

    def advance(self, time: float | None = None, *, hurry: bool = False) -> list[OnlineEstimate]:
        now = self.newest if time is None else time
        found = []
        due = now - self.settings.lag_s + 1e-9
        while self.given < len(self.truth) and self.truth.times[self.given] <= due:
            found.append(self._one())
        return found

    def finish(self) -> list[OnlineEstimate]:
        return self.advance(np.inf)

    def _one(self) -> OnlineEstimate:
        t = self.given
        self.given += 1
        poses = self.truth[t : t + 1]
        unseen = max(float(poses.times[0]) - max(self.frames, default=0.0) - 0.1, 0.0)
        up = np.array([0.0, 0.0, 0.01 * (1 - self.settings.lag_s) - 0.1 * unseen])
        raised = poses.with_poses(slice(None), poses.p_world_joint + up)
        return OnlineEstimate(raised, self.settings.lag_s, 0.0)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> recordings.Job:
    walk, _ = planted.walking(BODY, 1.8)
    clip = replace(MocapClip("walk", walk.poses, BODY.joint_offsets, "S"), category="walking")
    return recordings.Job(clip, 0, "8", 0, str(tmp_path_factory.mktemp("work")))


@pytest.fixture(scope="module")
def recording(job: recordings.Job) -> Recording:
    return job.recorded()


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch, recording: Recording) -> None:
    truth = recordings.truth_of(recording)
    for module in (accuracy, soak, speed):
        monkeypatch.setattr(module, "estimator", lambda setup, names, own: StandIn(truth, own))
        monkeypatch.setattr(module, "settings", Settings)


def test_a_setup_tells_no_truth_and_hardly_any_data(recording: Recording) -> None:
    setup = setup_of(recording)
    assert setup.truth is None
    assert setup.video.times[-1] - setup.video.times[0] < 1.0
    assert setup.imus is None
    assert setup.calibration is not None


def test_every_sample_arrives_once_and_not_before_its_time(recording: Recording) -> None:
    ticks, came = recording.video.times, 0
    for now, samples in portions(recording, ticks):
        assert all(now - 1 / 60 - 1e-3 < sample.time <= now + 1e-5 for sample in samples) or came == 0
        assert sum(isinstance(sample, FrameSample) for sample in samples) == 1
        came += len(samples)
    assert recording.imus is not None
    assert came == len(ticks) + 8 * np.count_nonzero(recording.imus.times <= ticks[-1])


def test_a_late_video_arrives_late(recording: Recording) -> None:
    ticks = recording.video.times
    late = portions(recording, ticks, Faults(video_delay_s=0.1))
    frames = [sum(isinstance(sample, FrameSample) for sample in samples) for _, samples in late]
    assert sum(frames[:5]) == 0
    assert sum(frames) == len(ticks) - 6


def test_a_frozen_camera_shows_one_picture(recording: Recording) -> None:
    video, start = recording.video, float(recording.video.times[0])
    still = frozen(recording, [(start + 0.5, start + 1.0)]).video
    inside = (video.times >= start + 0.5) & (video.times < start + 1.0)
    first = video.uv_px[inside][0]
    np.testing.assert_array_equal(still.uv_px[inside], np.broadcast_to(first, still.uv_px[inside].shape))
    np.testing.assert_array_equal(still.uv_px[~inside], video.uv_px[~inside])


def test_each_lag_covers_the_whole_recording(recording: Recording) -> None:
    truth = recordings.truth_of(recording)
    found = tracks(recording, lambda setup, names, own: StandIn(truth, own), Settings(), (0.0, 0.5))
    for lag, track in found.items():
        np.testing.assert_array_equal(track.poses.times, truth.times)
        up = track.poses.p_world_joint - truth.p_world_joint
        np.testing.assert_allclose(up[..., 2], 0.01 * (1 - lag), atol=1e-9)


@pytest.mark.usefixtures("stand_in")
def test_errors_against_lag_are_those_of_the_stand_in(job: recordings.Job, tmp_path: Path) -> None:
    rows = accuracy.measured(job, (), False, tmp_path)
    online = {row["lag"]: row for row in rows if row["estimate"] == accuracy.ONLINE}
    assert online[0.0]["mpjpe_mm"] == pytest.approx(10.0)
    assert online[0.25]["mpjpe_mm"] == pytest.approx(7.5)
    assert online[0.0]["mpjpe_rr_mm"] == pytest.approx(0.0, abs=1e-6)
    assert online[0.0]["root_mm"] == pytest.approx(10.0)
    batch = next(row for row in rows if row["estimate"] == accuracy.BATCH)
    assert 5.0 < batch["mpjpe_rr_mm"] < 80.0
    assert 0.5 < batch["inside_relative"] <= 1.0
    assert {row["estimate"] for row in rows} == {accuracy.ONLINE, accuracy.BATCH, accuracy.CAUSAL}
    kept = accuracy.measured(job, (), False, None)
    again = next(row for row in kept if row["estimate"] == accuracy.BATCH)
    assert again["mpjpe_rr_mm"] == pytest.approx(batch["mpjpe_rr_mm"], abs=1e-6)
    with np.load(tmp_path / f"{job.key}.npz") as data:
        assert {"online_0_p", "batch_0_p", "true_p"} <= set(data.files)


def row(motion: str, estimate: str, lag: float, error: float, **more: Any) -> dict[str, Any]:
    names = (*accuracy.COLUMNS, *accuracy.BANDS)
    about = {"motion": motion, "camera": 0, "sensors": "8", "frames": 100}
    return dict.fromkeys(names, error) | about | {"estimate": estimate, "lag": lag} | more


def test_ratios_are_pooled_by_error_and_by_motion(tmp_path: Path) -> None:
    rows = []
    for motion, whole, online in (("a", 20.0, 22.0), ("b", 40.0, 48.0)):
        rows += [row(motion, accuracy.BATCH, 0.0, whole), row(motion, accuracy.CAUSAL, 0.0, 50.0)]
        rows += [row(motion, accuracy.ONLINE, lag, online) for lag in accuracy.GOALS]
        rows += [row(motion, accuracy.WINDOW, lag, online) for lag in accuracy.LAGS]
    lag, ratios, motions = accuracy.tables(rows)
    assert len(lag.rows) == len(accuracy.LAGS) + len(accuracy.GOALS) + 2
    cells = dict(zip(ratios.columns, ratios.rows[0], strict=True))
    assert cells["above batch %, pooled"] == pytest.approx(100 * 10 / 60)
    assert cells["mean of motions %"] == pytest.approx(15.0)
    assert cells["worst motion %"] == pytest.approx(20.0)
    assert [line[1:4] for line in motions.rows] == [("a", 20.0, pytest.approx(10.0)), ("b", 40.0, pytest.approx(20.0))]
    figure.error_against_lag(rows, tmp_path / "lag.png")
    assert (tmp_path / "lag.png").stat().st_size > 10_000


@pytest.mark.usefixtures("stand_in")
def test_times_and_memory_of_every_frame(recording: Recording, tmp_path: Path) -> None:
    spent = speed.timed(recording, speed.steps(recording, Settings()))
    assert len(spent.clock) == len(spent.times) == len(recording.video)
    assert (spent.clock > 0).all()
    assert spent.p_world_joint.shape[1:] == (21, 3)
    rows = [{"case": "a"} | speed.row_of(spent)]
    assert sum(rows[0]["counts"]) == len(spent.clock)
    assert len(speed.tables(rows)) == 3
    figure.histogram(rows, tmp_path / "times.png")
    assert (tmp_path / "times.png").is_file()


def test_drift_is_that_after_the_first_minute() -> None:
    times = np.arange(10.0, 600.0, 10.0)
    memory = np.where(times < 60, 10 * times, 100.0 + times / 3600 * 7)
    assert drift_mb_per_hour(times, memory) == pytest.approx(7.0)
    assert np.isnan(drift_mb_per_hour(times[:3], memory[:3]))


def test_a_slow_frame_is_counted() -> None:
    clock = np.array([1.0] * 99 + [200.0])
    none = np.empty(0)
    found = speed.row_of(Spent(clock, clock, none, none, none, none))  # type: ignore[arg-type]
    assert found["ms"]["processor"]["max"] == 200.0
    assert found["above_10_ms"]["clock"] == pytest.approx(0.01)
    assert found["counts"][-1] == 1


@pytest.mark.usefixtures("stand_in")
def test_a_session_tells_of_a_sensor_that_dies(recording: Recording) -> None:
    start = float(recording.video.times[0]) + 0.5
    faults = Faults(dead=(("L_LowArm", start, start + 0.7),))
    found = soak.session(recording, faults, {})
    told = list(zip(found["told_at"].tolist(), found["told"].tolist(), strict=True))
    dies, over = soak.reports(recording, faults, told)
    assert (dies["planted"], dies["told"]) == (1, 1)
    assert 0.4 < dies["longest_s"] < 1.0
    assert over["fault"] == "sensor dies: over"


def test_errors_of_an_hour_are_by_segment_and_fault(recording: Recording) -> None:
    truth = recordings.truth_of(recording)
    long = replace(truth, times=truth.times * 100)
    video = replace(recording.video, times=recording.video.times * 100)
    slow = replace(recording, truth=long, keypoints=video, imus=None, calibration=None)
    bad = soak.faulty(slow, long.times)
    assert bad.mean() == pytest.approx(19 / 60, abs=0.12)
    p = long.p_world_joint + np.where(bad, 0.02, 0.01)[:, None, None] * np.array([0.0, 0.0, 1.0])
    rows = soak.segments(slow, long.times, p)
    for kind, size in (("with", 20.0), ("without", 10.0)):
        means = [one["abs_mm"] for one in rows if one["faults"] == kind and one["frames"]]
        np.testing.assert_allclose(means, size)
