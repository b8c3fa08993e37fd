"""`LiveClient`: estimates of ``rtof-kin live`` from its WebSocket on this machine, see `live.websocket_server`."""

from __future__ import annotations

import ipaddress
import json
import threading
from contextlib import ExitStack, suppress
from typing import Any, Final, Self
from urllib.parse import urlsplit

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError
from rtof_kin.core.packages import optional
from rtof_kin.data.poses import PoseSequence

_PATIENCE: Final = 2.0  # [s] for an answer
_AGAIN: Final = 1.0  # [s] between two attempts to connect
_LARGEST: Final = 1 << 20  # [bytes] of a message


def live_address(text: str) -> str:
    """Return the WebSocket address that a text names.

    `text`: the address of the live page, or that with ``ws:`` in place of ``http:``; with its token.

    Raises:
        InvalidInputError: not an address of this machine, or without a port or token.
    """
    parts = urlsplit(text if "//" in text else f"ws://{text}")
    try:
        host, port = parts.hostname or "", parts.port
    except ValueError:
        host, port = "", None
    token = parts.path.strip("/")
    if parts.scheme not in ("ws", "http") or port is None or not _loopback(host) or not token:
        raise InvalidInputError(
            f"{text}: not an address of this machine with its token; give the whole one that rtof-kin live "
            "printed, e.g. http://127.0.0.1:8765/kq0T.../"
        )
    return f"ws://[{host}]:{port}/{token}/" if ":" in host else f"ws://{host}:{port}/{token}/"


def _loopback(host: str) -> bool:
    if host == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


class LiveClient:
    """Reads in a thread and connects again after an interruption.

    Attributes:
        url: of the server. skeleton: of the person, of its height. floor: height of the floor, m, or None.
    """

    def __init__(self, url: str):
        """Connect, and wait for the description of the skeleton. `url`: of `live_address`.

        Raises:
            SourceError: nobody answers there, or something else than rtof-kin live.
        """
        self.url = url
        self._connect = optional("websockets.sync.client", "view").connect
        self._errors = optional("websockets.exceptions", "view").WebSocketException
        self._lock = threading.Lock()
        self._latest: PoseSequence | None = None
        self._lag: float | None = None
        self._sentences: list[str] = []
        self.received, self.connected = 0, True
        self._stop = threading.Event()
        try:
            with ExitStack() as failed:
                self._socket = failed.enter_context(self._open())
                first = self._message(self._socket.recv(timeout=_PATIENCE))
                self.skeleton, self.floor = _described(first)
                failed.pop_all()
        except (OSError, self._errors) as error:
            raise SourceError(
                f"{url}: no answer ({error or 'timeout'}); start rtof-kin live --send ws first"
            ) from error
        self._thread = threading.Thread(target=self._run, name=url, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> tuple[PoseSequence | None, float | None]:
        """Return the newest pose and its age when it was estimated, s; None before there is one."""
        with self._lock:
            return self._latest, self._lag

    @property
    def sentences(self) -> tuple[str, ...]:
        """What the server says about its streams, and about the connection."""
        with self._lock:
            lost = () if self.connected else (f"{self.url}: connection lost; trying again",)
            return (*lost, *self._sentences)

    def close(self) -> None:
        """Disconnect."""
        self._stop.set()
        self._socket.close()
        self._thread.join(5.0)

    # --- the thread ------------------------------------------------------------------------------

    def _open(self) -> Any:
        return self._connect(
            self.url, open_timeout=_PATIENCE, close_timeout=_PATIENCE, max_size=_LARGEST, proxy=None, compression=None
        )

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with self._socket:
                    for text in self._socket:
                        self._take(self._message(text))
            except (OSError, RtofError, self._errors) as error:
                with self._lock:
                    self._sentences = [str(error)]
            self.connected = False
            while not self._stop.wait(_AGAIN):
                with suppress(OSError, self._errors):
                    self._socket = self._open()
                    self.connected = True
                    break
        self._socket.close()

    def _message(self, text: Any) -> dict[str, Any]:
        try:
            data = json.loads(text)
        except (TypeError, ValueError) as error:
            raise SourceError(f"{self.url}: not a message of rtof-kin live ({str(error)[:80]})") from error
        if not isinstance(data, dict):
            raise SourceError(f"{self.url}: not a message of rtof-kin live")
        return data

    def _take(self, data: dict[str, Any]) -> None:
        if "joints" in data:
            poses = estimated_poses(data, self.skeleton)
            with self._lock:
                self._latest, self._lag = poses, float(data.get("lag_s", np.nan))
                self.received += 1
        elif isinstance(data.get("status"), dict):
            streams = [data["status"].get("camera") or {}, *(data["status"].get("sensors") or [])]
            with self._lock:
                self._sentences = [
                    f"{one.get('name')}: {one['sentence']}"
                    for one in streams
                    if isinstance(one, dict) and one.get("sentence")
                ]


def estimated_poses(data: dict[str, Any], skeleton: SkeletonModel) -> PoseSequence:
    """Return the pose of a message of `live.websocket_server`.

    Orientations follow from the configuration, else from the positions; which of them a sensor observed is
    not in the message, so that the segments of hands, feet and head count as unobserved.

    Raises:
        SourceError: not such a message.
    """
    J = len(skeleton.names)
    try:
        stamp, joints = data["header"]["stamp"], data["joints"]
        time = float(stamp["sec"]) + 1e-9 * float(stamp["nanosec"])
        p = np.array([[np.nan] * 3 if row is None else row for row in joints["position"]], dtype=float)
        R = np.full((1, J, 3, 3), np.nan)
        if data["position"]:
            R = skeleton.forward_kinematics(_configuration(data, skeleton)[None])[1]
        return PoseSequence(
            np.array([time]),
            p.reshape(1, J, 3),
            R,
            skeleton.names,
            np.array(joints["provenance"]).reshape(1, J),
            np.array(joints["valid"]).reshape(1, J),
        )
    except (KeyError, TypeError, ValueError, RtofError) as error:
        raise SourceError(f"not an estimate of rtof-kin live ({type(error).__name__}: {error})") from error


def _configuration(data: dict[str, Any], skeleton: SkeletonModel) -> Array:
    """Return q (nq,) of a message."""
    root = data["root"]["transform"]
    quat = [root["rotation"][axis] for axis in "xyzw"]
    angles = dict(zip(data["name"], data["position"], strict=True))
    place = [root["translation"][axis] for axis in "xyz"]
    return np.array([*place, *quat, *(angles[name] for name in skeleton.dof_names)], dtype=float)


def _described(data: dict[str, Any]) -> tuple[SkeletonModel, float | None]:
    try:
        found = data["skeleton"]
        skeleton = SkeletonModel.named(str(found["name"])).with_height(float(found["height_m"]))
        skeleton.check_joints(tuple(map(str, found["joints"])), "live skeleton")
        floor = data.get("floor_m")
        return skeleton, None if floor is None else float(floor)
    except (KeyError, TypeError, ValueError, RtofError) as error:
        raise SourceError(f"not the skeleton of rtof-kin live ({type(error).__name__}: {error})") from error
