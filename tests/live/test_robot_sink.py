"""A robot that follows a live person: its joints over LSL and WebSocket, and the command's line."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pylsl
import pytest
from clinical_support import walk
from lsl_support import DEADLINE_S, unique
from robots_support import GR1
from websockets.sync.client import connect

from rtof_kin.core.errors import SourceError
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS
from rtof_kin.live.open_sources import LslOutlet, RobotSink
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.live.websocket_server import WebSocketServer
from rtof_kin.robots.retarget import Retargeter


def test_robot_follows_and_its_joints_are_sent_beside_the_persons() -> None:
    motion, name = walk(), unique("robot")
    robot = Retargeter(motion.skeleton, GR1)
    outlet, server = LslOutlet(name, motion.skeleton), WebSocketServer(motion.skeleton)
    sink = RobotSink(robot, [outlet, server])
    begin = pylsl.local_clock() - 0.1
    with connect(server.url.replace("http", "ws"), compression=None, proxy=None) as client:
        assert "skeleton" in json.loads(client.recv(timeout=5))
        for frame in range(12):
            poses = replace(motion.poses[frame : frame + 1], times=motion.times[frame : frame + 1] + begin)
            for one in (outlet, sink):
                one.send(OnlineEstimate(poses, 0.05, 0.002))
            if frame == 0:
                (info,) = pylsl.resolve_byprop("name", f"{name}_robot", 1, DEADLINE_S)
                inlet = pylsl.StreamInlet(info)
                inlet.open_stream(DEADLINE_S)
                assert outlet._robot.wait_for_consumers(DEADLINE_S)
        state: dict[str, Any] = {}
        while (
            abs(state.get("header", {"stamp": {"sec": 0}})["stamp"]["sec"] + _part(state) - motion.times[11] - begin)
            > 1e-6
        ):
            state = json.loads(client.recv(timeout=5)).get("robot", state)
    assert state["name"] == list(robot.joints)
    np.testing.assert_allclose(state["position"], robot.q[7:])
    assert state["root"]["child_frame_id"] == "base_link"
    for _ in range(11):
        sample, stamp = inlet.pull_sample(DEADLINE_S)
    np.testing.assert_allclose(sample, robot.q, atol=1e-5)
    assert stamp == pytest.approx(motion.times[11] + begin, abs=1e-6)
    labels = inlet.info(DEADLINE_S).get_channel_labels()
    assert labels == [*BASE_COLUMNS, *robot.joints]
    sink.close()
    assert len(robot.track.slips) > 0
    outlet.close()
    server.close()


def _part(state: dict[str, Any]) -> float:
    return float(state.get("header", {"stamp": {"nanosec": 0}})["stamp"]["nanosec"]) / 1e9


def test_robot_without_an_output_is_refused() -> None:
    with pytest.raises(SourceError, match="--robot: nobody would get its joints; give --send lsl"):
        RobotSink(Retargeter(walk().skeleton, GR1), [])
