"""LSL streams as sources, over real LSL on this machine."""

from __future__ import annotations

import re
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pylsl
import pytest
from live_support import FakeEstimator, demo, frame_samples, imu_samples
from lsl_support import Sender, unique, until

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import MissingPackageError, SourceError
from rtof_kin.data.imu_stream import Declaration
from rtof_kin.live import lsl
from rtof_kin.live.lsl import LslClock, LslFrameSource, LslImuSource
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import Clock, FrameSample, ImuSample
from rtof_kin.live.session import LiveSession
from rtof_kin.recording.recording import Recording

ONE = ("qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z")
LABELS = [f"{sensor}_{label}" for sensor in ("pelvis", "head") for label in ONE]
UNITS = ["", "", "", "", "g", "g", "g"] * 2
REST = [1.0, 0, 0, 0, 0, 0, 1.0] * 2


@pytest.fixture
def _no_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the wait for another stream of the name."""
    monkeypatch.setattr(lsl, "_SETTLE_S", 0.0)


def planted(frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_inertial_sensor (T, 2, 3, 3), f_sensor (T, 2, 3) and the numbers (T, 14) that are sent."""
    rng = np.random.default_rng(3)
    R, f = so3.exp(rng.normal(size=(frames, 2, 3))), 9.8 * rng.normal(size=(frames, 2, 3))
    declaration = Declaration(acceleration_unit="g")
    quat = declaration.filed_quaternions(R.reshape(-1, 3, 3)).reshape(frames, 2, 4)
    return R, f, np.concatenate([quat, declaration.filed_acceleration(f)], axis=2).reshape(frames, 14)


@pytest.mark.usefixtures("_no_twin")
def test_planted_data_with_loss_and_jitter_arrive_with_their_stamps() -> None:
    name, frames = unique("imus"), 40
    R, f, values = planted(frames)
    rng = np.random.default_rng(0)
    kept = np.flatnonzero(rng.uniform(size=frames) > 0.1)
    sender = Sender(name, LABELS, UNITS)
    source = LslImuSource(name)
    source.start()
    assert (source.name, source.clock, source.sensors) == (f"lsl:{name}", Clock.COMMON, ("pelvis", "head"))
    assert (source.landmarks, source.finished) == ((), False)
    assert abs(source.clock_offset_s) < 0.01
    sender.wait()
    begin = pylsl.local_clock()
    stamps = begin + np.arange(frames) / 60

    def replay() -> None:
        arrivals = np.maximum.accumulate(stamps[kept] + rng.uniform(0, 0.05, len(kept)))
        for k, arrival in zip(kept, arrivals, strict=True):
            time.sleep(max(0.0, arrival - pylsl.local_clock()))
            sender.send(values[k], stamps[k])

    thread = threading.Thread(target=replay)
    thread.start()
    samples: list[ImuSample] = []

    def all_arrived() -> bool:
        samples.extend(one for one in source.poll() if isinstance(one, ImuSample))
        return len(samples) == 2 * len(kept)

    until(all_arrived)
    thread.join()
    assert source.notices() == []
    source.close()
    assert source.finished
    assert source.poll() == []
    for s, sensor in enumerate(source.sensors):
        own = [one for one in samples if one.sensor == sensor]
        np.testing.assert_allclose([one.time for one in own], stamps[kept], atol=1e-3)
        np.testing.assert_allclose([one.R_inertial_sensor for one in own], R[kept, s], atol=1e-9)
        np.testing.assert_allclose([one.f_sensor for one in own], f[kept, s], atol=1e-9)


@pytest.mark.usefixtures("_no_twin")
def test_frames_arrive() -> None:
    name = unique("points")
    sender = Sender(name, ["Nose_x", "Nose_y", "Nose_confidence"], rate_hz=0.0)
    source = LslFrameSource(name)
    source.start()
    assert (source.landmarks, source.sensors) == (("Nose",), ())
    sender.wait()
    sender.send([320.0, 240.0, 0.9], stamp := pylsl.local_clock())
    (sample,) = until(source.poll)
    source.close()
    assert isinstance(sample, FrameSample)
    assert (sample.uv_px.tolist(), sample.confidence.tolist()) == ([[320.0, 240.0]], [0.9])
    assert sample.time == pytest.approx(stamp, abs=1e-3)


def test_stream_that_never_starts_names_those_that_exist() -> None:
    other = Sender(unique("other"), LABELS)
    before = time.monotonic()
    with pytest.raises(SourceError) as caught:
        LslImuSource("no such stream", timeout_s=0.5).start()
    assert time.monotonic() - before < 3
    assert "no such stream" in str(caught.value)
    assert "other-" in str(caught.value)
    other.stop()


def test_two_streams_of_one_name_are_told_apart_in_the_error() -> None:
    name = unique("twin")
    senders = [Sender(name, LABELS, source_id=f"device {i}") for i in (1, 2)]
    with pytest.raises(SourceError) as caught:
        LslImuSource(name).start()
    for named in (name, "device 1", "device 2", pylsl.StreamInfo("x", source_id="x").hostname()):
        assert named in str(caught.value)
    for sender in senders:
        sender.stop()


@pytest.mark.usefixtures("_no_twin")
@pytest.mark.parametrize(("labels", "channels", "named"), [(LABELS[:13], 14, "13"), (ONE[4:], 3, "quaternion")])
def test_unusable_channels_name_the_stream(labels: list[str], channels: int, named: str) -> None:
    name = unique("odd")
    sender = Sender(name, labels, channels=channels)
    with pytest.raises(SourceError, match=named) as caught:
        LslImuSource(name).start()
    assert name in str(caught.value)
    sender.stop()


@pytest.mark.usefixtures("_no_twin")
@pytest.mark.parametrize("source_id", ["device 7", ""], ids=["recovered by LSL", "found again"])
def test_lost_connection_is_said_within_a_second_and_recovers(source_id: str) -> None:
    name = unique("lost")
    sender = Sender(name, LABELS, source_id=source_id)
    source = LslImuSource(name)
    source.start()
    sender.wait()
    sender.send(REST)
    until(source.poll)
    sender.stop()
    before = time.monotonic()
    notices: list[str] = []
    until(lambda: source.poll() or notices.extend(source.notices()) or notices)
    assert time.monotonic() - before < 1.0
    assert name in notices[0]
    again = Sender(name, LABELS, source_id=source_id)

    def back() -> bool:
        again.send(REST)
        return bool(source.poll())

    until(back)
    assert "back" in source.notices()[-1]
    assert not source.finished
    source.close()
    source.close()
    again.stop()


@pytest.mark.usefixtures("_no_twin")
def test_stream_that_comes_back_with_other_sensors_is_given_up() -> None:
    name = unique("changed")
    sender = Sender(name, LABELS, source_id="")
    source = LslImuSource(name)
    source.start()
    sender.wait()
    sender.stop()
    again = Sender(name, ONE, source_id="")
    until(lambda: source.poll() or source.finished)
    assert "cannot be used" in source.notices()[-1]
    again.stop()


@pytest.mark.usefixtures("_no_twin")
def test_jump_of_a_senders_clock_is_mended_and_said() -> None:
    name = unique("jump")
    sender = Sender(name, ONE)
    source = LslImuSource(name)
    source.start()
    sender.wait()
    times = []
    for jump in (0.0, 1000.0):
        sender.send(REST[:7], pylsl.local_clock() + jump)
        times.append(until(source.poll)[0].time)
    assert 0 < times[1] - times[0] < 1
    assert "jumped" in source.notices()[0]
    assert source.clock_offset_s == pytest.approx(-1000, abs=1)
    source.close()


def test_without_pylsl_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(MissingPackageError, match=r"rtof-kin\[live\]"):
        LslImuSource("any").start()


@pytest.mark.usefixtures("_no_twin")
def test_a_session_over_lsl_estimates_and_records_what_is_sent(tmp_path: Path) -> None:
    imus, video = demo().imus, demo().video
    assert imus is not None
    senders = {name: Sender(unique(name), [f"{name}_{label}" for label in ONE]) for name in imus.names}
    points = [f"{name}_{what}" for name in video.names for what in ("x", "y", "confidence")]
    senders["video"] = Sender(unique("points"), points)
    names = {who: sender._outlet.get_info().name() for who, sender in senders.items()}
    sources = [LslFrameSource(names["video"]), *(LslImuSource(names[name]) for name in imus.names)]
    starts = [threading.Thread(target=source.start) for source in sources]
    for thread in starts:
        thread.start()
    for thread in starts:
        thread.join()
    samples = sorted([*imu_samples(1.5), *frame_samples(1.5)], key=lambda sample: sample.time)
    begun = pylsl.local_clock() - samples[0].time

    def send() -> None:
        for sample in samples:
            time.sleep(max(0.0, begun + sample.time - pylsl.local_clock()))
            if isinstance(sample, FrameSample):
                uv = np.where(np.isfinite(sample.uv_px), sample.uv_px, 0.0)
                senders["video"].send(np.column_stack([uv, sample.confidence]).ravel(), begun + sample.time)
            else:
                quat = so3.to_quat_wxyz(sample.R_inertial_sensor)
                senders[sample.sensor].send([*quat, *sample.f_sensor], begun + sample.time)

    sender = threading.Thread(target=send)
    session = LiveSession(demo(), sources, FakeEstimator(), recorder=Recorder(tmp_path / "take", demo()))
    sender.start()
    deadline = time.monotonic() + 60.0
    summary = session.run(lambda: time.monotonic() > deadline or not sender.is_alive(), clock=pylsl.local_clock)
    sender.join()
    assert summary.frames > 60
    recorded = Recording.load(tmp_path / "take")
    assert recorded.imus is not None
    assert set(recorded.imus.names) == set(imus.names)
    assert min(len(recorded.video), len(recorded.imus)) > 70


RATE_HZ = 50.0


def replay(clock: LslClock, stamps: np.ndarray, arrivals: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times of stamps that arrive in chunks of two, and the sentences."""
    times, sentences = [], []
    for i in range(0, len(stamps), 2):
        some, sentence = clock.times(stamps[i : i + 2], float(arrivals[i : i + 2].max()))
        times.append(some)
        sentences += [sentence] if sentence else []
    return np.concatenate(times), sentences


def test_measured_offset_is_added_and_small_changes_are_no_jump() -> None:
    clock = LslClock()
    assert clock.offset_s == 0.0
    assert clock.corrected_by(None) is None
    assert clock.corrected_by(-120.0) is None
    assert clock.corrected_by(-120.0004) is None
    times, sentence = clock.times(np.array([1120.0, 1120.02]), 1000.03)
    np.testing.assert_allclose(times, [999.9996, 1000.0196])
    assert (sentence, clock.offset_s) == (None, -120.0004)


def test_loss_gaps_jitter_and_late_samples_are_no_jumps() -> None:
    rng = np.random.default_rng(0)
    true = 1000 + np.arange(500) / RATE_HZ
    true = true[(rng.uniform(size=500) > 0.1) & ~((true > 1003) & (true < 1006))]
    arrivals = np.maximum.accumulate(true + rng.uniform(0, 0.05, len(true)))
    stamps = true.copy()
    stamps[[100, 101]] = stamps[[101, 100]]
    times, sentences = replay(LslClock(), stamps, arrivals)
    np.testing.assert_array_equal(times, stamps)
    assert sentences == []


@pytest.mark.parametrize("jump", [3600.0, -3600.0, 1.7e9, 2.0])
def test_jump_of_stamps_is_said_once_and_times_go_on(jump: float) -> None:
    rng = np.random.default_rng(1)
    true = 1000 + np.arange(400) / RATE_HZ
    arrivals = np.maximum.accumulate(true + rng.uniform(0.005, 0.05, len(true)))
    stamps = true + np.where(np.arange(400) >= 201, jump, 0.0)
    times, sentences = replay(LslClock(), stamps, arrivals)
    np.testing.assert_allclose(times, true, atol=0.06)
    np.testing.assert_allclose(np.diff(times[202:]), 1 / RATE_HZ, atol=1e-6)
    (sentence,) = sentences
    said = re.search(r"[+-][\d.]+", sentence)
    assert said is not None
    assert float(said[0]) == pytest.approx(jump, abs=0.06)


def test_stamps_of_another_clock_from_the_start_are_mapped_by_arrival() -> None:
    clock = LslClock()
    true = 1000 + np.arange(100) / RATE_HZ
    times, sentences = replay(clock, true + 1.7e9, true + 0.01)
    np.testing.assert_allclose(times, true, atol=0.05)
    assert len(sentences) == 1
    assert clock.offset_s == pytest.approx(-1.7e9, abs=0.1)
    assert clock.corrected_by(-1.7e9) is None  # the first measurement came late
    assert clock.offset_s == -1.7e9


def test_jump_of_the_offset_is_said_and_replaces_that_of_the_stamps() -> None:
    clock = LslClock()
    clock.corrected_by(5.0)
    clock.times(np.array([995.0]), 1000.0)
    _, said = clock.times(np.array([1995.02]), 1000.02)  # the sender's clock is 1000 s ahead from here on
    assert said is not None
    sentence = clock.corrected_by(-995.0)
    assert sentence is not None
    assert "+1000.000 s" in sentence
    times, again = clock.times(np.array([1995.04]), 1000.04)
    np.testing.assert_allclose(times, 1000.04)
    assert again is None
    assert clock.corrected_by(-994.0) is not None


def test_jumps_without_end_are_said_five_times_and_missing_stamps_stay_missing() -> None:
    clock = LslClock()
    said = [clock.times(np.array([1000.0 + i + 100 * (i % 2)]), 1000.0 + i)[1] for i in range(40)]
    assert sum(sentence is not None for sentence in said) == 5
    times, sentence = clock.times(np.array([np.nan, np.inf]), 1040.0)
    assert not np.isfinite(times).any()
    assert sentence is None
    assert clock.times(np.zeros(0), 1041.0) == (pytest.approx([]), None)
