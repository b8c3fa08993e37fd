"""LSL streams as sources, over real LSL on this machine."""

from __future__ import annotations

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
from rtof_kin.live.lsl import LslFrameSource, LslImuSource
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.samples import Clock, FrameSample, ImuSample
from rtof_kin.live.session import Feed, LiveSession
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
    source = LslImuSource(name, renamed={"pelvis": "Hips", "head": "Head"}.__getitem__)
    source.start()
    assert (source.name, source.clock, source.sensors) == (f"lsl:{name}", Clock.COMMON, ("Hips", "Head"))
    assert (source.landmarks, source.finished) == ((), False)
    assert abs(source._offset_s + source._shift_s) < 0.01
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
    (unseen,) = source.samples(np.zeros(1), np.array([[3.0, 4.0, 0.0]]))
    source.close()
    assert isinstance(sample, FrameSample)
    assert isinstance(unseen, FrameSample)
    assert (np.isnan(unseen.uv_px).all(), unseen.confidence.tolist()) == (True, [0.0])
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
def test_lost_connection_is_said_and_recovers(source_id: str) -> None:
    name = unique("lost")
    sender = Sender(name, LABELS, source_id=source_id)
    feed = Feed(LslImuSource(name), in_background=True)
    until(lambda: feed.poll(time.monotonic()) is not None and feed.source.sensors)
    sender.wait()
    sender.send(REST)
    until(lambda: feed.poll(time.monotonic()))
    sender.stop()
    if not source_id:
        until(lambda: feed.poll(time.monotonic()) or any("is lost" in one for one in feed.sentences()))
    again = Sender(name, LABELS, source_id=source_id)

    def back() -> bool:
        again.send(REST)
        return bool(feed.poll(time.monotonic()))

    until(back)
    assert feed.sentences()[-1:] == ([] if source_id else [f"{feed.name}: goes on"])
    feed.close()
    feed.close()
    again.stop()


@pytest.mark.usefixtures("_no_twin")
def test_stream_that_comes_back_with_other_sensors_is_refused() -> None:
    name = unique("changed")
    sender = Sender(name, LABELS, source_id="")
    source = LslImuSource(name)
    source.start()
    sender.wait()
    sender.stop()
    again = Sender(name, ONE, source_id="")
    with pytest.raises(SourceError, match="is lost"):
        until(source.poll)
    with pytest.raises(SourceError, match="had pelvis, head"):
        source.start()
    again.stop()


@pytest.mark.usefixtures("_no_twin")
@pytest.mark.parametrize("off", [1000.0, -1.7e9])
def test_stamps_of_another_clock_are_shifted_to_their_arrival(off: float) -> None:
    name = unique("off")
    sender = Sender(name, ONE)
    source = LslImuSource(name)
    source.start()
    sender.wait()
    sent = pylsl.local_clock()
    sender.send(REST[:7], sent + off)
    sender.send(REST[:7], sent + off + 0.5)
    times: list[float] = []
    until(lambda: times.extend(one.time for one in source.poll()) or len(times) == 2)
    assert times[0] == pytest.approx(sent, abs=1.0)
    assert times[1] - times[0] == pytest.approx(0.5, abs=1e-3)
    assert "off the LSL clock" in source.notices()[0]
    assert source._offset_s + source._shift_s == pytest.approx(-off, abs=1.0)
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
    # Nine streams at once answer late on a busy machine.
    sources = [LslFrameSource(names["video"], 60.0), *(LslImuSource(names[name], 60.0) for name in imus.names)]
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
        time.sleep(3.0)  # until the last samples have come

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


# --- channels without a stream -------------------------------------------------------------------


def test_missing_numbers_are_nan() -> None:
    source = LslImuSource("s")
    source.read_channels(ONE[:4])
    assert "no acceleration of s" in source.notices()[0]
    unknown, zero = source.samples(np.array([0.0, 1.0]), np.array([[np.nan] * 4, [0.0] * 4]))
    assert np.isnan([unknown.R_inertial_sensor, zero.R_inertial_sensor]).all()
    assert np.isnan(unknown.f_sensor).all()
    assert source.samples(np.zeros(0), np.zeros((0, 4))) == []
