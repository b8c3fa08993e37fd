"""A recording comes back sample by sample, with the faults that were asked for and no others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from weakref import ref

import numpy as np
import pytest

from rtof_kin.core.errors import InvalidInputError, SourceError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.replay import Faults, RecordingReplay, ReplayClock
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample, Source
from rtof_kin.recording.recording import Recording, RecordingReader, RecordingSource

INF = float("inf")


@cache
def recording() -> Recording:
    """The first five seconds of the demo."""
    demo = Recording.load(model_path("demo"))
    imus = demo.imus
    assert imus is not None
    first = imus.times < 5
    cut = replace(
        imus, times=imus.times[first], f_sensor=imus.f_sensor[first], R_inertial_sensor=imus.R_inertial_sensor[first]
    )
    return replace(demo, keypoints=demo.video[:290], imus=cut, truth=None)


class Hands:
    """A system clock that is moved by hand."""

    def __init__(self) -> None:
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


def drained(*sources: Source) -> list[list[Sample]]:
    """All samples of each source, polled in turn."""
    found: list[list[Sample]] = [[] for _ in sources]
    for _ in range(10_000):
        for samples, source in zip(found, sources, strict=True):
            samples += source.poll()
        if all(source.finished for source in sources):
            return found
    raise AssertionError("a replay does not end")


def replayed(faults: Faults | None = None) -> list[Sample]:
    replay = RecordingReplay.of_recording(recording(), ReplayClock(INF), faults=faults or Faults())
    replay.start()
    return drained(replay)[0]


def of_sensor(samples: list[Sample], name: str) -> list[ImuSample]:
    return [s for s in samples if isinstance(s, ImuSample) and s.sensor == name]


def frames(samples: list[Sample]) -> list[FrameSample]:
    return [s for s in samples if isinstance(s, FrameSample)]


def test_every_sample_of_a_recording_comes_once_and_in_order() -> None:
    own = recording()
    imus, video = own.imus, own.video
    assert imus is not None
    samples = replayed()
    assert np.all(np.diff([s.time for s in samples]) >= 0)
    seen = frames(samples)
    np.testing.assert_array_equal([s.time for s in seen], video.times)
    np.testing.assert_array_equal([s.uv_px for s in seen], video.uv_px)
    for i, name in enumerate(imus.names):
        there = np.isfinite(imus.f_sensor[:, i]).all(axis=-1)
        there |= np.isfinite(imus.R_inertial_sensor[:, i]).all(axis=(-2, -1))
        mine = of_sensor(samples, name)
        np.testing.assert_array_equal([s.time for s in mine], imus.times[there])
        np.testing.assert_array_equal([s.f_sensor for s in mine], imus.f_sensor[there, i])
        np.testing.assert_array_equal([s.R_inertial_sensor for s in mine], imus.R_inertial_sensor[there, i])


def test_missing_samples_are_left_out() -> None:
    own = recording()
    assert own.imus is not None
    f, R = own.imus.f_sensor.copy(), own.imus.R_inertial_sensor.copy()
    f[10:20, 0] = R[10:20, 0] = np.nan
    gap = replace(own, imus=replace(own.imus, f_sensor=f, R_inertial_sensor=R))
    replay = RecordingReplay.of_recording(gap, ReplayClock(INF), video=False)
    replay.start()
    (samples,) = drained(replay)
    missing = set(own.imus.times[10:20])
    assert not missing & {s.time for s in of_sensor(samples, own.imus.names[0])}
    assert missing <= {s.time for s in of_sensor(samples, own.imus.names[1])}


def test_a_folder_is_replayed_by_blocks_as_if_it_were_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def told(samples: list[Sample]) -> list[object]:
        return [
            (s.time, s.uv_px.tobytes(), s.confidence.tobytes())
            if isinstance(s, FrameSample)
            else (s.sensor, s.time, s.R_inertial_sensor.tobytes(), s.f_sensor.tobytes())
            for s in samples
        ]

    def replayed_of(source: RecordingSource) -> list[object]:
        faults = Faults(loss=0.1, jitter_s=0.1, frozen=(4.0, 9.0), seed=2)
        replay = RecordingReplay.of_recording(source, ReplayClock(INF), faults=faults)
        replay.start()
        return told(drained(replay)[0])

    whole = replayed_of(Recording.load(model_path("demo")))
    monkeypatch.setattr("rtof_kin.live.replay.BLOCK", 100)
    with RecordingReader.open(model_path("demo")) as reader:
        assert replayed_of(reader) == whole


def test_a_replay_holds_two_blocks_of_each_stream_however_long_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read whole, an hour takes 2.8 GB."""
    monkeypatch.setattr("rtof_kin.live.replay.BLOCK", 100)
    monkeypatch.setattr("rtof_kin.core.over_time.BLOCK", 100)
    parts, longest = list[ref[object]](), 0

    def counted(stream: Any) -> Any:
        def part(rows: slice) -> object:
            parts.append(ref(found := stream.part(rows)))
            assert len(found) <= 100
            return found

        return replace(stream, part=part)

    with RecordingReader.open(model_path("demo")) as reader:
        streams = reader.streams
        reader._streams = replace(streams, keypoints=counted(streams.keypoints), imus=counted(streams.imus))
        replay = RecordingReplay.of_recording(reader, ReplayClock(INF))
        replay.start()
        while not replay.finished:
            replay.poll()
            longest = max(longest, sum(part() is not None for part in parts))
    assert longest == 4
    assert len(parts) > 40


def test_two_replays_stay_together_however_fast_they_are_read() -> None:
    clock = ReplayClock(INF)
    video = RecordingReplay.of_recording(recording(), clock, sensors=False)
    sensors = RecordingReplay.of_recording(recording(), clock, video=False)
    assert (video.sensors, sensors.landmarks) == ((), ())
    assert video.landmarks == recording().video.names
    for source in (video, sensors):
        source.start()
    newest = [0.0, 0.0]
    while not (video.finished and sensors.finished):
        for i, source in enumerate((video, sensors)):
            newest[i] = max([newest[i], *(s.time for s in source.poll())])
        if not (video.finished or sensors.finished) and min(newest) > 0:
            assert abs(newest[0] - newest[1]) < 2 / 60 + 1e-9


def test_a_paced_replay_follows_the_system_times_its_speed() -> None:
    hands = Hands()
    clock = ReplayClock(2.0, now=hands)
    replay = RecordingReplay.of_recording(recording(), clock)
    replay.start()
    hands.time += 100.0  # what passes before the first poll does not count
    replay.poll()
    hands.time += 1.0
    newest = replay.poll()[-1].time
    assert newest == pytest.approx(clock.first + 2.0, abs=0.02)
    assert clock.age(clock.first + 1.0) == pytest.approx(0.5)
    hands.time += 10.0
    replay.poll()
    assert replay.finished
    assert replay.poll() == []


def test_a_seed_gives_the_same_losses_and_delays() -> None:
    def keys(samples: list[Sample]) -> list[tuple[str, float]]:
        return [(s.sensor if isinstance(s, ImuSample) else VIDEO, s.time) for s in samples]

    every = keys(replayed())
    faulty = Faults(loss=0.1, jitter_s=0.05, seed=3)
    found = keys(replayed(faulty))
    assert found == keys(replayed(faulty))
    assert found != keys(replayed(replace(faulty, seed=4)))
    assert set(found) <= set(every)
    assert len(found) / len(every) == pytest.approx(0.9, abs=0.02)
    times = np.array([time for _, time in found])
    late = np.maximum.accumulate(times) - times
    assert 0.03 < late.max() <= 0.05 + 1e-9


def test_faults_are_where_they_were_asked_for() -> None:
    name = recording().calibration.sensors[2]  # type: ignore[union-attr]
    dead = ((name, 1.0, 2.0), (VIDEO, 3.0, 3.5))
    samples = replayed(Faults(dead=dead, frozen=(1.5, 2.5), video_delay_s=0.2))
    assert not [s for s in of_sensor(samples, name) if 1.0 <= s.time < 2.0]
    assert [s for s in of_sensor(samples, name) if s.time >= 2.0]
    seen = frames(samples)
    assert not [s for s in seen if 3.2 <= s.time < 3.7]
    still = [s.uv_px for s in seen if 1.7 <= s.time < 2.7]
    assert len(still) > 50
    assert all(np.array_equal(uv, still[0], equal_nan=True) for uv in still)
    assert seen[0].time == pytest.approx(recording().video.times[0] + 0.2)
    arrived = [s.time for s in samples]
    assert np.all(np.diff(arrived) >= 0)  # late frames also arrive late


@pytest.mark.parametrize("bad", [{"loss": 1.5}, {"jitter_s": -1.0}, {"video_delay_s": float("nan")}])
def test_faults_must_be_possible(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError):
        Faults(**bad)  # type: ignore[arg-type]


def test_faults_of_unknown_sensors_and_empty_replays_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="nose"):
        RecordingReplay.of_recording(recording(), faults=Faults(dead=(("nose", 0, 1),)))
    with pytest.raises(SourceError, match="keypoints"):
        RecordingReplay.of_recording(replace(recording(), keypoints=None), sensors=False)
    with pytest.raises(InvalidInputError):
        ReplayClock(0.0)


def test_a_sensor_file_is_replayed_with_estimated_orientations(tmp_path: Path) -> None:
    times = np.arange(300) / 100
    rows = [f"{t:.3f},0,0,9.81,0,0,0.1,0,0,9.81,0,0,0.1" for t in times]
    names = [f"{sensor}_{what}{axis}" for sensor in ("chest", "hip") for what in "fw" for axis in "xyz"]
    file = tmp_path / "walk.csv"
    file.write_text("\n".join([",".join(["time", *names]), *rows]))
    replay = RecordingReplay.of_sensor_file(file, ReplayClock(INF), clock=Clock.OWN)
    replay.start()
    (samples,) = drained(replay)
    assert set(replay.sensors) == {"chest", "hip"}
    assert replay.clock is Clock.OWN
    assert len(of_sensor(samples, "hip")) == 300
    last = of_sensor(samples, "hip")[-1]
    np.testing.assert_allclose(last.R_inertial_sensor[2], [0, 0, 1], atol=0.01)
    assert any("VQF" in sentence or "orientation" in sentence for sentence in replay.notices())
    assert replay.notices() == []


def test_clocks_without_a_common_time_are_not_replayed_together(tmp_path: Path) -> None:
    file = tmp_path / "walk.csv"
    names = ",".join(f"chest_{what}" for what in ("fx", "fy", "fz", "wx", "wy", "wz"))
    rows = [f"{5000 + i / 100:.2f},0,0,9.81,0,0,0" for i in range(300)]
    file.write_text("\n".join([f"time,{names}", *rows]))
    clock = ReplayClock(INF)
    RecordingReplay.of_recording(recording(), clock).start()
    with pytest.raises(SourceError, match=r"5000.*4\.9|walk.*demo"):
        RecordingReplay.of_sensor_file(file, clock).start()
    with pytest.raises(SourceError, match="nothing"):
        RecordingReplay.of_sensor_file(tmp_path / "nothing.csv")
