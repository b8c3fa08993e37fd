"""Messages of ROS 2, read by the packages of MCAP and by rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from rtof_kin.formats.ros_log import RosLog

ARM = """<robot name="arm"><link name="base"/><link name="tool"/><joint name="turn" type="revolute">
<parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


def arm(path: Path, bag: bool = False) -> RosLog:
    return RosLog(path, ARM, ["turn"], [("world", "base"), ("base", "tool")], -1.0, bag)


def write(log: RosLog, frames: int = 3) -> None:
    """One radian in a second about z; the second frame is unknown."""
    times = np.arange(frames) / 2
    p, quat = np.zeros((frames, 2, 3)), np.zeros((frames, 2, 4))
    p[:, 0] = [1.0, 2.0, 3.0]
    quat[:, 0, 3], quat[:, 1, 2], quat[:, 1, 3] = 1.0, np.sin(times / 2), np.cos(times / 2)
    positions = times[:, None].copy()
    positions[1], p[1] = np.nan, np.nan
    log.write(times, positions, p, quat)


@pytest.mark.parametrize("bag", [False, True])
def test_a_robot_is_read_by_rosbags_and_by_mcap(tmp_path: Path, bag: bool) -> None:
    path = tmp_path / ("bag" if bag else "arm.mcap")
    with arm(path, bag) as log:
        write(log)
    file = path / "bag.mcap" if bag else path
    with file.open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [channel.topic for _, channel, _, _ in found].count("/tf") == 2  # the unknown frame has none
    states = [(raw.log_time, list(state.name)) for _, channel, raw, state in found if channel.topic == "/joint_states"]
    assert states == [(10**9, ["turn"]), (2 * 10**9, ["turn"])]
    latched = next(channel for _, channel, _, _ in found if channel.topic == "/robot_description")
    assert "durability: 1" in latched.metadata["offered_qos_profiles"]
    with AnyReader([path]) as reader:
        messages = [(t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages() if c.topic == "/tf"]
        text = next(reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages() if "robot" in c.topic)
    model = pin.buildModelFromXML(text)
    assert list(model.names) == ["universe", "turn"]
    stamp, last = messages[-1]
    base, tool = last.transforms
    assert stamp == 2 * 10**9
    assert (base.header.frame_id, base.child_frame_id, base.header.stamp.sec) == ("world", "base", 2)
    assert (base.transform.translation.x, base.transform.translation.z) == (1.0, 3.0)
    assert tool.transform.rotation.z == pytest.approx(np.sin(0.5), abs=1e-12)


def test_what_was_flushed_is_read_after_a_kill_and_no_file_is_replaced(tmp_path: Path) -> None:
    log = arm(tmp_path / "arm.mcap")
    write(log)
    log._mcap.flush()
    left = tmp_path / "left.mcap"
    left.write_bytes((tmp_path / "arm.mcap").read_bytes())  # as a killed process leaves it
    with left.open("rb") as stream, pytest.raises(EndOfFile):
        read = []
        for record in StreamReader(stream).records:
            read.append(type(record).__name__)
    assert read.count("Message") == 1 + 2 + 2
    log.close()
    with pytest.raises(FileExistsError):
        arm(tmp_path / "arm.mcap")
