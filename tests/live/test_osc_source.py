"""A UDP port: samples, units, pairs, clocks, and what is left out."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from osc_support import bundle, message
from pythonosc.udp_client import SimpleUDPClient

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample, Source
from rtof_kin.live.sources import osc_source
from rtof_kin.live.sources.osc_source import OscSource

IDENTITY, REST = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 9.81]


class Port:
    """A started source and a sender."""

    def __init__(self, source: OscSource):
        self.source = source
        source.start()
        self.sender = self.another()
        self.notices: list[str] = []

    @staticmethod
    def another() -> socket.socket:
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, *datagrams: Any, sender: socket.socket | None = None) -> None:
        for datagram in datagrams:
            data = datagram if isinstance(datagram, bytes) else json.dumps(datagram).encode()
            (sender or self.sender).sendto(data, ("127.0.0.1", self.source.port))

    def samples(self, count: int) -> list[Any]:
        """The next samples; fails if they do not come."""
        out: list[Sample] = []
        deadline = time.monotonic() + 5
        while len(out) < count:
            assert time.monotonic() < deadline, (out, self.source.notices())
            out += self.source.poll()
            time.sleep(0.002)
        assert len(out) == count
        return out

    def told(self, *words: str) -> str:
        """The notice that has these words; fails if it does not come."""
        deadline = time.monotonic() + 5
        while time.monotonic() < deadline:
            self.notices += self.source.notices()
            for notice in self.notices:
                if all(word in notice for word in words):
                    return notice
            time.sleep(0.002)
        raise AssertionError(f"{words} not in {self.notices}")

    def flush(self) -> list[Any]:
        """All samples before one that is sent now."""
        self.send({"sensor": "last", "time": time.monotonic(), "quat": IDENTITY, "acc": REST})
        out: list[Any] = []
        deadline = time.monotonic() + 5
        while not any(getattr(sample, "sensor", "") == "last" for sample in out):
            assert time.monotonic() < deadline
            out += self.source.poll()
            time.sleep(0.002)
        return [sample for sample in out if getattr(sample, "sensor", "") != "last"]

    def close(self) -> None:
        self.sender.close()
        self.source.close()


@pytest.fixture
def port() -> Iterator[Port]:
    port = Port(OscSource(0, landmarks=["Nose", "LeftEye"]))
    yield port
    port.close()


def reading(sensor: str, stamp: float | None, quat: Any = IDENTITY, acc: Any = REST) -> dict[str, Any]:
    return {"sensor": sensor, "time": stamp, "quat": quat, "acc": acc}


def test_readings_of_all_forms_become_samples(port: Port) -> None:
    source: Source = port.source
    assert (source.name, source.clock, source.finished) == (f"udp:{port.source.port}", Clock.OWN, False)
    client = SimpleUDPClient("127.0.0.1", port.source.port)
    client.send_message("/imu/S1", [1.25, *IDENTITY, *REST])
    client._sock.close()
    port.send(b"S2,1.5,1,0,0,0,0,0,9.81", reading("S3", 1.75))
    first, second, third = port.samples(3)
    assert [one.sensor for one in (first, second, third)] == list(source.sensors) == ["S1", "S2", "S3"]
    assert [one.time for one in (first, second, third)] == [1.25, 1.5, 1.75]
    np.testing.assert_allclose(second.R_inertial_sensor, np.eye(3))
    np.testing.assert_allclose(third.f_sensor, REST)
    assert source.landmarks == ("Nose", "LeftEye")
    assert source.notices() == []


def test_units_and_conventions_are_those_declared() -> None:
    declared = Declaration(
        acceleration_unit="g", gravity="removed", quaternion_order="xyzw", inertial_axes="z down"
    )
    port = Port(OscSource(0, declaration=declared))
    rng = np.random.default_rng(2)
    R, f = so3.exp(rng.normal(size=(5, 3))), 9.8 * rng.normal(size=(5, 3))
    quat, acc = declared.filed_quaternions(R), declared.filed_acceleration(f, R)
    port.send(*(reading("S1", 0.1 * i, quat[i].tolist(), acc[i].tolist()) for i in range(5)))
    samples = port.samples(5)
    np.testing.assert_allclose([one.R_inertial_sensor for one in samples], R, atol=1e-12)
    np.testing.assert_allclose([one.f_sensor for one in samples], f, atol=1e-12)
    port.send({"sensor": "S2", "time": 0.1, "acc": REST}, {"sensor": "S2", "time": 0.2, "acc": REST})
    assert port.flush() == []
    port.told("S2", "orientation")
    port.close()


def test_parts_of_one_time_tag_are_one_sample(port: Port) -> None:
    for i in range(3):
        quat, acc = message("/S1/quat", *IDENTITY), message("/S1/acc", *REST)
        port.send(bundle(1e9 + i, quat, acc).dgram if i else bundle(1e9, quat).dgram)
        if i == 0:
            port.send(bundle(1e9, acc).dgram)
    samples = port.samples(3)
    np.testing.assert_allclose([one.time for one in samples], 1e9 + np.arange(3), atol=1e-5)
    assert np.isfinite([one.f_sensor for one in samples]).all()
    assert np.isfinite([one.R_inertial_sensor for one in samples]).all()
    assert port.source.notices() == []


def test_parts_without_time_are_paired_and_stamped_at_arrival(port: Port) -> None:
    before = time.time()
    port.send(message("/S1/quat", *IDENTITY).dgram, message("/S1/acc", *REST).dgram)
    (sample,) = port.samples(1)
    assert before - 1 < sample.time < time.time() + 1
    assert np.isfinite(sample.f_sensor).all()
    port.told("S1", "no time", "arrival")


def test_common_clock_needs_times() -> None:
    port = Port(OscSource(0, landmarks=["Nose"], clock=Clock.COMMON))
    assert port.source.clock is Clock.COMMON
    port.send(reading("S1", None), {"uv": [[1, 2]]}, reading("S2", 1.0))
    assert [one.sensor for one in port.flush()] == ["S2"]
    port.told("S1", "no time", "common")
    port.told("frames", "no time")
    port.close()


def test_a_part_whose_other_part_does_not_come_is_a_sample(port: Port) -> None:
    stamp = 100.0
    for _ in range(11):
        port.send(bundle(stamp := stamp + 1, message("/S1/quat", *IDENTITY)).dgram)
    samples = port.samples(11)
    assert all(np.isnan(one.f_sensor).all() for one in samples)
    port.send(bundle(stamp + 1, message("/S1/quat", *IDENTITY)).dgram)
    began = time.monotonic()
    port.samples(1)
    assert time.monotonic() - began < 0.04  # no longer waited for
    port.send({"sensor": "S2", "time": 1.0, "acc": REST})
    (sample,) = port.samples(1)
    assert np.isnan(sample.R_inertial_sensor).all()


@pytest.mark.parametrize(
    "wrong, words",
    [
        (reading("S1", 1.0, [10, 0, 0, 0]), ["S1", "norm 10"]),
        (reading("S1", 1.0, [0, 0, 0, 0]), ["S1", "norm 0"]),
        (reading("S1", 1.0, acc=[None, 0, 0]), ["S1", "NaN"]),
        (b"S1,nan,1,0,0,0,0,0,9", ["S1", "NaN"]),
        (reading("S1", 1.0, acc=[1, 2]), ["S1", "acc (3 numbers)"]),
        (reading("", 1.0), ["name"]),
        (reading("\n", 1.0), ["name"]),
        (b"\xff garbage", ["datagram"]),
        (b"/mixer/volume\x00\x00\x00,\x00\x00\x00", ["/mixer/volume", "/imu/SENSOR"]),
        ({"uv": [[1, 2]], "time": 1.0}, ["frames", "1 points", "2 were named"]),
        ({"uv": [[1, 2], [3, 4]], "confidence": [90, 80]}, ["frames", "0 to 1"]),
        ({"landmarks": ["Nose", "RightEye"]}, ["landmarks", "changed"]),
    ],
)
def test_wrong_input_is_left_out_with_one_notice(port: Port, wrong: Any, words: list[str]) -> None:
    port.send(wrong, wrong, wrong)
    assert port.flush() == []
    port.told(*words)
    assert len(port.notices + port.source.notices()) == 1
    assert list(port.source.left_out.values()) == [3]
    port.send(reading("S1", 2.0))
    port.samples(1)


def test_frames_and_their_landmarks() -> None:
    port = Port(OscSource(0))
    frame = {"frame": 1, "time": 0.5, "uv": [[3, 4], [None, 5], [6, 7]], "confidence": [0.9, 0.9, 0]}
    port.send(frame)
    port.told("frames", "names")
    port.send({"landmarks": ["Nose", "LeftEye", "RightEye"]}, frame)
    (sample,) = port.samples(1)
    assert isinstance(sample, FrameSample)
    assert port.source.landmarks == ("Nose", "LeftEye", "RightEye")
    assert (sample.time, sample.confidence.tolist()) == (0.5, [0.9, 0, 0])
    np.testing.assert_array_equal(sample.uv_px, [[3, 4], [np.nan] * 2, [np.nan] * 2])
    port.send(frame, frame | {"frame": 5, "time": 0.7})
    (later,) = port.samples(1)
    assert later.time == 0.7
    port.told("frames", "one time")
    port.told("frames", "3 did not arrive")
    port.close()


def test_repeated_stamps_are_left_out_with_the_remedy(port: Port) -> None:
    port.send(reading("S1", 1.0), reading("S1", 1.0), reading("S1", 2.0))
    assert [one.time for one in port.flush()] == [1.0, 2.0]
    port.told("S1", "64-bit")


def test_second_sender_of_a_name_is_named_and_left_out(port: Port) -> None:
    other = port.another()
    for i in range(6):
        port.send(reading("S1", float(i)))
        assert any(one.time == i for one in port.flush())
        port.send(reading("S1", 100.0 + i), sender=other)
    assert sum(one.time >= 100 for one in port.flush()) <= 1
    port.told("S1", "two senders")
    other.close()


def test_sender_that_changes_its_port_is_one_sender(port: Port) -> None:
    for i in range(5):
        sender = port.another()
        port.send(reading("S1", float(i)), sender=sender)
        sender.close()
    port.samples(5)
    assert not port.source.left_out


def test_other_and_jumping_clocks_are_told(port: Port) -> None:
    for i in range(25):
        port.send(reading("S1", i / 100), reading("S2", 1000 + i / 100))
    port.samples(50)
    port.told("S2", "S1", "+1e+03 s")
    port.send(reading("S1", 60.0))
    port.samples(1)
    port.told("S1", "jumped")


def test_what_is_not_fetched_is_counted_and_told(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(osc_source, "_WAITING", 10)
    port.send(*(reading("S1", float(i)) for i in range(25)))
    port.told("lost")
    deadline = time.monotonic() + 5
    while port.source.lost < 15 and time.monotonic() < deadline:
        time.sleep(0.002)
    assert [one.time for one in port.source.poll()] == [float(i) for i in range(15, 25)]
    assert port.source.lost == 15


def test_names_are_limited(port: Port) -> None:
    for i in range(80):
        port.send(reading(f"S{i}", 1.0))
    port.told("64 names")
    assert len(port.source.sensors) == 64


def test_taken_port_and_foreign_host_name_the_remedy() -> None:
    first = OscSource(0)
    first.start()
    second = OscSource(first.port)
    with pytest.raises(SourceError, match=f"udp:{first.port}.*another port"):
        second.start()
    first.close()
    second.start()
    second.close()
    for host in ("192.0.2.1", "no such host"):
        with pytest.raises(SourceError, match="udp:"):
            OscSource(0, host).start()


def test_loopback_is_the_default_and_other_hosts_are_told() -> None:
    source = OscSource.of("udp:0", landmarks=["Nose"])
    source.start()
    with pytest.raises(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", source.port))
    assert source.notices() == []
    source.close()
    source.close()
    assert source.finished
    everywhere = OscSource.of("udp:0.0.0.0:0")
    everywhere.start()
    assert "every machine" in everywhere.notices()[0]
    everywhere.close()


@pytest.mark.parametrize("text", ["udp", "udp:", "udp:x", "lsl:9000", "udp:::1:", "udp:-1", "udp:70000"])
def test_other_forms_of_a_source_are_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match="udp|UDP"):
        OscSource.of(text)


def test_samples_are_of_the_shared_types(port: Port) -> None:
    port.send(reading("S1", 1.0))
    (sample,) = port.samples(1)
    assert isinstance(sample, ImuSample)
    assert sample.R_inertial_sensor.shape == (3, 3)
