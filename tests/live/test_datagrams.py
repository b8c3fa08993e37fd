"""Datagrams: OSC, JSON and CSV, and what is none of them."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from osc_support import bundle, message

from rtof_kin.live.sources.datagrams import Landmarks, Points, Reading, Remark, contents

QUATERNION, ACCELERATION = (0.5, -0.5, 0.5, 0.5), (0.1, -9.5, 2.0)
WHOLE = Reading("S1", 1.25, QUATERNION, ACCELERATION)


def one(datagram: bytes | str | dict[str, Any]) -> Any:
    if isinstance(datagram, dict):
        datagram = json.dumps(datagram)
    (found,) = contents(datagram.encode() if isinstance(datagram, str) else datagram)
    return found


@pytest.mark.parametrize(
    "datagram",
    [
        message("/imu/S1", 1.25, *QUATERNION, *ACCELERATION).dgram,
        bundle(5.0, message("/imu/S1", 1.25, *QUATERNION, *ACCELERATION)).dgram,
        {"sensor": "S1", "time": 1.25, "quat": QUATERNION, "acc": ACCELERATION},
        "S1,1.25,0.5,-0.5,0.5,0.5,0.1,-9.5,2.0\n",
        " S1 , 1.25, 0.5, -0.5, 0.5, 0.5, 0.1, -9.5, 2.0",
    ],
)
def test_whole_readings(datagram: Any) -> None:
    assert one(datagram) == WHOLE


def test_parts_have_the_time_tag_of_their_bundle_though_it_is_past() -> None:
    parts = message("/phone/S1/quaternion", *QUATERNION), message("/imu/S1/accel", *ACCELERATION)
    inner = bundle(0, parts[1])  # immediately: the time of the outer bundle
    turned, pushed = contents(bundle(1e9 + 0.25, parts[0], inner).dgram)
    assert (turned.sensor, turned.quaternion, turned.acceleration) == ("S1", QUATERNION, None)
    assert (pushed.sensor, pushed.quaternion, pushed.acceleration) == ("S1", None, ACCELERATION)
    assert turned.time == pushed.time == pytest.approx(1e9 + 0.25, abs=1e-5)
    assert one(parts[0].dgram).time is None


def test_lists_and_lines_hold_several_readings() -> None:
    values = {"sensor": "S1", "time": 1.25, "quat": QUATERNION, "acc": ACCELERATION}
    text = json.dumps(values)
    for datagram in (json.dumps([values, values]), f"{text}\n{text}", json.dumps(values, indent=1)):
        assert set(contents(datagram.encode())) == {WHOLE}
    assert len(list(contents(f"{text}\n{text}".encode()))) == 2


def test_what_is_not_given_is_none() -> None:
    assert one({"sensor": "S1", "quat": QUATERNION}) == Reading("S1", None, QUATERNION, None)
    assert one({"sensor": "S1", "time": 2, "acc": ACCELERATION}) == Reading("S1", 2.0, None, ACCELERATION)
    assert one("S1,,0.5,-0.5,0.5,0.5,,,") == Reading("S1", None, QUATERNION, None)


def test_frames_by_osc_and_json_are_equal() -> None:
    expected = Points(7, 1.25, ((3.0, 4.0), (5.0, 6.0)), (0.5, 0.25))
    assert one(message("/frame", 7, 1.25, 3, 4, 0.5, 5, 6, 0.25).dgram) == expected
    uv = [[3, 4], [5, 6]]
    assert one({"frame": 7, "time": 1.25, "uv": uv, "confidence": [0.5, 0.25]}) == expected
    bare = one({"uv": [[3, 4], [None, None]]})
    assert (bare.number, bare.time, bare.confidence) == (None, None, (1.0, 1.0))
    assert math.isnan(bare.uv_px[1][0])
    assert one(message("/landmarks", "Nose", "LeftEye").dgram) == Landmarks(("Nose", "LeftEye"))
    assert one({"landmarks": ["Nose", "LeftEye"]}) == Landmarks(("Nose", "LeftEye"))


@pytest.mark.parametrize(
    "datagram, subject, kind",
    [
        (message("/imu/S1", 1.0, *QUATERNION).dgram, "S1", "arguments"),
        (message("/imu/S1", *"12345678").dgram, "S1", "arguments"),
        (message("/S1/quat", 1.0).dgram, "/S1/quat", "arguments"),
        (message("/S1/acc", *QUATERNION).dgram, "/S1/acc", "arguments"),
        (message("/frame", 1.0, 2.0, 3.0).dgram, "frames", "arguments"),
        (message("/landmarks", 1.0).dgram, "landmarks", "arguments"),
        (message("/mixer/volume", 1.0).dgram, "/mixer/volume", "address"),
        ({"sensor": "S1", "quat": [1, 0, 0]}, "S1", "arguments"),
        ({"sensor": "S1", "quat": QUATERNION, "acc": ["1", 2, 3]}, "S1", "arguments"),
        ({"sensor": "S1", "time": "now", "quat": QUATERNION}, "S1", "arguments"),
        ({"sensor": "S1", "time": True, "quat": QUATERNION}, "S1", "arguments"),
        ({"sensor": "S1", "time": 10**400, "quat": QUATERNION}, "S1", "arguments"),
        ({"sensor": "S1"}, "S1", "arguments"),
        ({"sensor": 1}, "", "unreadable"),
        ({"uv": [[1, 2], [3]], "confidence": [1, 1]}, "frames", "arguments"),
        ({"uv": [[1, 2]], "confidence": [1, 1]}, "frames", "arguments"),
        ({"uv": 3}, "frames", "arguments"),
        ({"landmarks": []}, "landmarks", "arguments"),
        ({"landmarks": ["Nose", "Nose"]}, "landmarks", "double"),
        ("[1]", "", "unreadable"),
        ("[" * 60_000, "", "unreadable"),
        ("S1,1,2,3", "", "unreadable"),
        ("S1,1,a,b,c,d,1,2,3", "S1", "arguments"),
        (b"\xff\xfe\x00", "", "unreadable"),
        (b"/imu/S1\x00,ddd\x00\x00\x00", "", "unreadable"),
        (b"#bundle\x00" + bytes(8) + struct.pack(">i", -4), "", "unreadable"),
        (b"#bundle\x00" + bytes(8) + struct.pack(">i", 400), "", "unreadable"),
        (b"#bundle\x00" + bytes(3), "", "unreadable"),
        (b"/imu/S1\x00,dI\x00" + bytes(8), "", "unreadable"),
    ],
)
def test_what_cannot_be_read_is_a_remark(datagram: Any, subject: str, kind: str) -> None:
    found = one(datagram)
    assert (found.subject, found.kind, found.left_out) == (subject, kind, True)


def test_bundles_in_bundles_in_bundles_end() -> None:
    data = b"#bundle\x00" + bytes(8)
    for _ in range(2000):
        data = b"#bundle\x00" + bytes(8) + struct.pack(">i", len(data)) + data
    assert one(data).kind == "unreadable"


def test_large_times_as_32_bit_floats_are_remarked() -> None:
    remark, reading = contents(message("/imu/S1", 1.7e9, *QUATERNION, *ACCELERATION, kind="f").dgram)
    assert (remark.subject, remark.kind, remark.left_out) == ("S1", "coarse time", False)
    assert reading.quaternion == QUATERNION
    assert isinstance(one(message("/imu/S1", 1.25, *QUATERNION, *ACCELERATION, kind="f").dgram), Reading)


@given(st.binary(max_size=200), st.sampled_from([b"", b"/imu/a\x00\x00,", b"#bundle\x00" + bytes(8), b"{"]))
def test_no_datagram_raises(data: bytes, start: bytes) -> None:
    for found in contents(start + data):
        assert isinstance(found, Reading | Points | Landmarks | Remark)
