"""LSL streams as sources, over real LSL on this machine."""

from __future__ import annotations

import sys
import threading
import time

import numpy as np
import pylsl
import pytest
from lsl_support import Sender, unique, until

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import MissingPackageError, SourceError
from rtof_kin.data.imu_stream import Declaration
from rtof_kin.live import lsl
from rtof_kin.live.lsl import LslFrameSource, LslImuSource
from rtof_kin.live.samples import Clock, FrameSample, ImuSample

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
