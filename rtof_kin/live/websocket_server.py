"""`WebSocketServer`: estimates, states and messages as JSON for programs, and the live page for a browser.

Each WebSocket message is one JSON text, told apart by its keys:

============ ========================================================================================
``skeleton`` first, once: `JointStates.description`, and ``floor_m``, height of the floor or null
``header``   an estimate, see `JointStates`
``robot``    JointState of a robot that follows, and ``root``, its base link in its world, as those of an estimate
``status``   states of the streams, see `Monitor.status`
``message``  a sentence
============ ========================================================================================

A client that connects gets the last state and the last messages. One that reads too slowly misses estimates,
never delays them. Only who knows the token in the address may read, see `rtof_kin.core.local_door`.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.local_door import LOOPBACK, Door, listening, response
from rtof_kin.core.packages import optional
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.joint_trajectory import ros_header, ros_transform
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.reporting.html import asset, source_hash

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response


Data = dict[str, Any]
_LONGEST_STEP_S: Final = 0.25  # Time between two poses above which their difference says nothing about the velocity
_DIGITS: Final = 5  # Digits after the point of joint positions, m
_ASSETS: Final = Path(__file__).parent / "assets"
_SCRIPTS: Final = ("unpack.js", "charts.js", "scene.js")  # Shared with the report
_MESSAGES: Final = 100  # Messages kept for a client that connects or is slow
_SEND_BUFFER_BYTES: Final = 1 << 16  # Asked of the system for each client: more would make a slow client see old poses
_LONGEST_REQUEST: Final = 4096  # [bytes] of what a client says
_PATIENCE_S: Final = 1.0
"""For a request, which a browser's spare connection never sends, and for a farewell; `close` may take it."""
_LOG: Final = logging.getLogger("rtof_kin.live.websocket_server")
_LOG.propagate = False  # else a broken request, as of a browser's spare connection, is printed


class JointStates:
    """Messages of successive estimates of one skeleton, in the shape of ROS messages, for JSON.

    A message is a ``sensor_msgs/JointState`` with more keys, so that a reader of joint states needs no other:

    ========== ==========================================================================================
    header     time of the pose on the clock of the sensors, and the frame, ``world``
    name       revolutes of the URDF
    position   their angles, rad, each on the turn nearest to the middle of its limits
    velocity   rad/s, from the message before; empty for the first one and after an interruption
    effort     empty
    root       ``geometry_msgs/TransformStamped`` of the root link in world; its transform is null if unknown
    joints     ``position`` in world, m (null if missing), ``valid`` and ``provenance``, of each joint
    lag_s      age of the pose when it was estimated
    frame_s    time that the estimate took
    ========== ==========================================================================================

    As ROS asks, `position` is empty where the configuration is unknown.
    """

    def __init__(self, skeleton: SkeletonModel):
        self._skeleton = skeleton
        joints = skeleton.table.joints[1:]
        index = [[skeleton.dof_names.index(dof.urdf) for dof in joint.dofs] for joint in joints]
        self._index = np.array(index).reshape(-1, 3)
        self._middle = skeleton.limits.mean(axis=1)
        self._last: tuple[float, Array] | None = None

    def description(self) -> Data:
        """Return what the messages refer to: joints and their parents; revolutes with the joint they are of,
        clinical name and its sign relative to the revolute; the meaning of the numbers of `provenance`.
        """
        skeleton = self._skeleton
        dofs = {dof.urdf: (joint.name, dof) for joint in skeleton.table.joints for dof in joint.dofs}
        return {
            "name": skeleton.name,
            "height_m": skeleton.height,
            "joints": list(skeleton.names),
            "parents": [int(parent) for parent in skeleton.parents],
            "angles": [
                {
                    "name": name,
                    "joint": joint,
                    "clinical": dof.clinical.lstrip("-"),
                    "sign": -1 if dof.clinical.startswith("-") else 1,
                }
                for name, (joint, dof) in ((name, dofs[name]) for name in skeleton.dof_names)
            ],
            "provenance": [member.name.lower().replace("_", " ") for member in Provenance],
        }

    def message(self, estimate: OnlineEstimate) -> Data:
        """Return the message of an estimate. `UnknownNameError`, `InvalidInputError`: its joints are not those of the
        skeleton.
        """
        poses, skeleton = estimate.poses, self._skeleton
        skeleton.check_joints(poses.names)
        time = float(poses.times[-1])
        p = poses.p_world_joint[-1]
        q = skeleton.inverse_kinematics(p[None], poses.R_world_bone[-1:])[0]
        known = bool(np.isfinite(q).all())
        header = ros_header(time)
        return {
            "header": header,
            "name": list(skeleton.dof_names),
            "position": self._near(q[7:], self._middle).tolist() if known else [],
            "velocity": self._velocity(time, q[7:]) if known else [],
            "effort": [],
            "root": {
                "header": header,
                "child_frame_id": skeleton.root,
                "transform": ros_transform(q.tolist()) if known else None,
            },
            "joints": {
                "position": [
                    row if finite else None
                    for row, finite in zip(p.round(_DIGITS).tolist(), np.isfinite(p).all(axis=1).tolist(), strict=True)
                ],
                "valid": poses.valid[-1].tolist(),
                "provenance": poses.provenance[-1].tolist(),
            },
            "lag_s": float(estimate.lag_s),
            "frame_s": float(estimate.seconds),
        }

    def _near(self, angles: Array, reference: Array) -> Array:
        """Return the equivalent angles (D,) nearest to others, rad."""
        out = np.empty_like(angles)
        out[self._index] = so3.euler_near(angles[self._index], reference[self._index])
        return out

    def _velocity(self, time: float, angles: Array) -> list[float]:
        last, self._last = self._last, (time, angles)
        if last is None or not 0 < time - last[0] <= _LONGEST_STEP_S:
            return []
        rates: list[float] = ((self._near(angles, last[1]) - last[1]) / (time - last[0])).tolist()
        return rates


@cache
def _sources() -> tuple[str, str, str]:
    """Return style, script and frame of the page."""
    own = {name: (_ASSETS / f"live.{name}").read_text(encoding="utf-8") for name in ("css", "js", "html")}
    return asset("page.css") + own["css"], "".join(map(asset, _SCRIPTS)) + own["js"], own["html"]


def live_page() -> str:
    """Return the page; it holds no data, which come over a WebSocket of the same host and port."""
    style, script, frame = _sources()
    return frame.replace("{{style}}", style).replace("{{script}}", script)


def page_headers(host: str, ancestors: str = "'none'") -> dict[str, str]:
    """Return HTTP headers of the page: it may run its own script, and connect to its own server only.

    `host`: of the server, ``HOST:PORT`` as the browser names it; checked by the caller. `ancestors`: pages that may
    frame it, as a content security policy says it.
    """
    style, script = map(source_hash, _sources()[:2])
    policy = (
        f"default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data:; "
        f"connect-src ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; frame-ancestors {ancestors}"
    )
    return {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Security-Policy": policy,
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }


_LOG.addHandler(logging.NullHandler())


@dataclass(eq=False)
class _Client:
    """One client; used in the server's thread only."""

    pending: dict[str, str]  #: What it has yet to get, by kind; a text replaces one of its kind
    filled: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, kind: str, text: str) -> bool:
        """Add a text; return whether it replaces one."""
        replaced = self.pending.pop(kind, None) is not None
        self.pending[kind] = text
        self.filled.set()
        return replaced

    async def deliver(self, connection: ServerConnection, closed: type[Exception]) -> None:
        """Send what is pending, the oldest first, until the connection is closed."""
        with suppress(closed):
            while True:
                while self.pending:
                    await connection.send(self.pending.pop(next(iter(self.pending))))
                self.filled.clear()
                await self.filled.wait()


class WebSocketServer:
    """Serves the page at `url`, and estimates over WebSocket at the same port; a `Sink`."""

    def __init__(self, skeleton: SkeletonModel, port: int = 0, floor_height: float | None = None):
        """Open the port at the loopback address and begin to serve.

        `port`: TCP port; 0: a free one, see `url`. `floor_height`: for the page, m. `SourceError`: the port is taken.
        `RtofError`: the extra is not installed.
        """
        self._websockets = optional("websockets.asyncio.server", "live")
        self._closed = optional("websockets.exceptions", "live").ConnectionClosed
        self._skeleton, self._states = skeleton, JointStates(skeleton)
        self._hello = _text({"skeleton": self._states.description(), "floor_m": floor_height})
        self._clients: set[_Client] = set()
        self._kept: dict[str, str] = {}  # for clients that connect later: the last state and messages
        self._told = 0
        self._lock = threading.Lock()
        self._waiting: OnlineEstimate | None = None
        self.dropped = 0
        """Number of estimates not sent because a client read too slowly, summed over clients."""
        self._door, self._socket = Door(), listening(port)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self._root = f"http://{LOOPBACK}:{self._socket.getsockname()[1]}"
        self._loop, self._stop = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="live page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page, with a secret token; for WebSocket clients it begins with ``ws:``."""
        return f"{self._root}{self._door.path}"

    @property
    def url_once(self) -> str:
        """Address that leads to the page once, to start a browser with."""
        return f"{self._root}{self._door.ticket}"

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def send(self, estimate: OnlineEstimate) -> None:
        """Send an estimate to all clients; without clients nothing is done. `UnknownNameError`, `InvalidInputError`:
        its joints are not those of the skeleton.
        """
        self._skeleton.check_joints(estimate.poses.names)
        if not self._clients:
            return
        with self._lock:
            replaced, self._waiting = self._waiting, estimate
        if replaced is None:
            self._call(self._put_estimate)
        else:
            self.dropped += self.clients

    def tell(self, sentence: str) -> None:
        """Send a message to all clients, and to those that connect later."""
        self._told += 1
        self._call(self._put, f"message {self._told % _MESSAGES}", _text({"message": sentence}))

    def send_status(self, status: Mapping[str, Any]) -> None:
        """Send the states of the streams to all clients; the last ones also to those that connect later.

        `status`: `Monitor.status`: plain values; ``sensors`` is a list, ``camera`` one, with ``name``, ``state`` and
        ``sentence``. `InvalidInputError`: it is not plain, or has NaN.
        """
        self._call(self._put, "status", _text({"status": dict(status)}))

    def send_robot(self, time: float, joints: Sequence[str], root: str, q: Array) -> None:
        """Send base position, m, quaternion x y z w and angles, rad, of a robot; time: s."""
        header, row = ros_header(time), q.tolist()
        base = {"header": header, "child_frame_id": root, "transform": ros_transform(row)}
        state = {"header": header, "name": list(joints), "position": row[7:], "velocity": [], "effort": []}
        self._call(self._put, "robot", _text({"robot": state | {"root": base}}))

    def close(self) -> None:
        """Stop; may be called twice."""
        self._call(self._stop.set)
        self._thread.join(5.0)

    def _call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Have the server's thread call a function; nothing if it has ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    # --- the server's thread ---------------------------------------------------------------------

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        patience = {"open_timeout": _PATIENCE_S, "close_timeout": _PATIENCE_S}
        async with self._websockets.serve(
            self._attend,
            sock=self._socket,
            process_request=self._answer,
            compression=None,
            logger=_LOG,
            server_header=None,
            max_size=_LONGEST_REQUEST,
            **patience,
        ):
            await self._stop.wait()

    async def _attend(self, connection: ServerConnection) -> None:
        """Serve one client until it leaves; what it says is not used."""
        client = _Client({"hello": self._hello, **self._kept})
        self._clients.add(client)
        sender = asyncio.create_task(client.deliver(connection, self._closed))
        try:
            with suppress(self._closed):
                async for _ in connection:
                    pass
        finally:
            self._clients.discard(client)
            sender.cancel()

    def _put_estimate(self) -> None:
        with self._lock:
            estimate, self._waiting = self._waiting, None
        if estimate is not None:
            text = _text(self._states.message(estimate))
            self.dropped += sum(client.put("estimate", text) for client in self._clients)

    def _put(self, kind: str, text: str) -> None:
        self._kept.pop(kind, None)
        self._kept[kind] = text
        for client in self._clients:
            client.put(kind, text)

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        """Return the page or a refusal; None lets a WebSocket client in."""
        if (refused := self._door.answer(request)) is not None:
            return refused
        if request.headers.get_all("Upgrade"):
            return None
        if request.path != "/":
            return response(HTTPStatus.NOT_FOUND, "there is only the page")
        return response(HTTPStatus.OK, live_page(), page_headers(request.headers["Host"]))


def _text(data: Mapping[str, Any]) -> str:
    try:
        return json.dumps(data, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"cannot be sent as JSON ({error}); give plain values, None for NaN") from error
