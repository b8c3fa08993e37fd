"""The live estimator in the viewer: real messages over a real WebSocket of this machine."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scene_support import walking

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.data.poses import Provenance
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.live.websocket_server import JointStates, WebSocketServer
from rtof_kin.view.layers import solid_colours
from rtof_kin.view.legend import COLOURS
from rtof_kin.view.live_client import LiveClient, live_address
from rtof_kin.view.local_server import local_server
from rtof_kin.view.viewer import LiveViewer

pytest.importorskip("viser")
FRAMES = 30


def until(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("ws://127.0.0.1:8765/k-y", "ws://127.0.0.1:8765/k-y/"),
        ("http://127.0.0.1:80/k-y/", "ws://127.0.0.1:80/k-y/"),
        ("localhost:9/k-y", "ws://localhost:9/k-y/"),
        ("ws://[::1]:9/k-y/", "ws://[::1]:9/k-y/"),
    ],
)
def test_addresses_of_this_machine(text: str, url: str) -> None:
    assert live_address(text) == url


@pytest.mark.parametrize(
    "text",
    [
        "ws://10.0.0.1:80/k",
        "ws://example.org:80/k",
        "ws://127.0.0.1/k",
        "https://127.0.0.1:1/k",
        "",
        "ws://:x/k",
        "ws://127.0.0.1.evil.org:80/k",
        "ws://2130706433:80/k",
        "ws://127.0.0.1:87",
        "87",
    ],
)
def test_addresses_of_other_machines_are_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match="not an address of this machine"):
        live_address(text)


def test_nobody_there_and_somebody_else_are_told() -> None:
    with pytest.raises(SourceError, match="no answer"):
        LiveClient("ws://127.0.0.1:9/")


def test_unknown_messages_are_told_and_do_not_pile_up_connections() -> None:
    server_of = pytest.importorskip("websockets.sync.server")
    hello = json.dumps({"skeleton": JointStates(walking(1).skeleton).description(), "floor_m": None})
    open_now: set[object] = set()
    seen: list[int] = []

    def attend(connection: Any) -> None:
        open_now.add(connection)
        seen.append(len(open_now))
        connection.send(hello)
        connection.send("no JSON")
        with suppress(Exception):
            connection.recv(timeout=20.0)
        open_now.discard(connection)

    with server_of.serve(attend, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with LiveClient(f"ws://127.0.0.1:{server.socket.getsockname()[1]}/") as client:
            until(lambda: len(seen) >= 3)
            assert "not a message of rtof-kin live" in client.sentences[-1]
        server.shutdown()
    assert max(seen) == 1


def test_estimates_are_shown_where_they_are() -> None:
    motion = walking(FRAMES)
    skeleton = motion.skeleton
    provenance = np.array(motion.poses.provenance)
    provenance[-1, skeleton.index("LeftForeArm")] = Provenance.BRIDGED
    poses = replace(motion.poses, provenance=provenance)
    source = WebSocketServer(skeleton, floor_height=0.3)
    try:
        with LiveClient(live_address(source.url)) as client, local_server() as server:
            viewer = LiveViewer(server, client)
            assert viewer.stage.height == 0.3
            stop = threading.Event()
            thread = threading.Thread(target=viewer.run, args=(stop,))
            thread.start()
            until(lambda: source.clients == 1)
            source.send_status({"sensors": [{"name": "thigh", "sentence": "gone <b>"}], "camera": {}})
            for frame in range(FRAMES):
                source.send(OnlineEstimate(poses[frame : frame + 1], 0.25, 0.001))
                until(lambda frame=frame: client.received == frame + 1)
            until(lambda: viewer._last == pytest.approx(motion.times[-1]))
            until(lambda: "gone &lt;b&gt;" in viewer.status.content and "250 ms" in viewer.status.content)
            stop.set()
            thread.join(10.0)
            axes = viewer.person.axes
            np.testing.assert_allclose(axes.batched_positions, poses.p_world_joint[-1], atol=2e-5)
            R = so3.from_quat_wxyz(axes.batched_wxyzs)
            np.testing.assert_allclose(R, poses.R_world_bone[-1], atol=1e-5)
            body = viewer.person.body.handle
            arm, leg = skeleton.index("LeftArm", "LeftLeg")
            kinds = (Provenance.BRIDGED, Provenance.CAMERA_AND_IMU)
            wanted = solid_colours(np.array([COLOURS[kind] for kind in kinds], dtype=np.uint8))
            np.testing.assert_array_equal(body.batched_colors[[arm, leg]], wanted)
            assert viewer.shown > 1
            source.close()
            viewer.update(time.monotonic() + 5.0)
            assert "what is shown is old" in viewer.status.content
            until(lambda: not client.connected)
            viewer.update(time.monotonic())
            assert "connection lost" in viewer.status.content
    finally:
        source.close()
