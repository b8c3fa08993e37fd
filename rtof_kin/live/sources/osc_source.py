"""`OscSource`: inertial sensors and detected points that arrive as UDP datagrams (OSC, JSON, CSV)."""

from __future__ import annotations

import ipaddress
import math
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from rtof_kin.core.array_types import Mask
from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample
from rtof_kin.live.sources.datagrams import Landmarks, Points, Reading, Remark, contents
from rtof_kin.live.sources.udp_sensor import UdpSensor

LOOPBACK: Final = "127.0.0.1"
_WAITING: Final = 20_000
"""Samples that wait for `poll`; older ones are dropped."""
_BUFFER_BYTES: Final = 1 << 20
"""Asked of the system, so that a pause of the interpreter loses nothing."""
_MOST_SENSORS: Final = 64
_MOST_PROBLEMS: Final = 500
"""Different problems that are told; beyond them they are counted together."""
_LOSS_TOLD_EVERY_S: Final = 1.0
_NORM_ERROR: Final = 0.1
"""Largest deviation of a quaternion's norm from 1."""


@dataclass(frozen=True)
class _Raw:
    """A reading with its time, before units and conventions are applied."""

    sensor: str
    time: float
    quaternion: tuple[float, ...]
    acceleration: tuple[float, ...]


class OscSource:
    """Samples that devices and programs send to a UDP port; the datagrams are those of `datagrams`.

    Times are the sender's, on a clock of its own unless told otherwise. Where it gives none, they are those
    of arrival, and a notice says so. A reading that cannot be right is left out; of each sensor and kind of
    problem there is one notice, and `left_out` counts them.
    """

    def __init__(
        self,
        port: int,
        host: str = LOOPBACK,
        declaration: Declaration | None = None,
        landmarks: Sequence[str] = (),
        clock: Clock = Clock.OWN,
    ):
        """Prepare; nothing is opened before `start`.

        Args:
            port: UDP port; 0: a free one, see `port`. host: address to listen at, this machine's alone by
                default. declaration: units and conventions of all readings. landmarks: names of the points of
                frames, unless the sender tells them. clock: `Clock.COMMON` if the sender's clock is that of
                the other sources.

        Raises:
            InvalidInputError: no such port; a landmark twice.
        """
        if not 0 <= port < 1 << 16:
            raise InvalidInputError(f"UDP port {port}: give a number from 1 to 65535")
        self._host, self._port, self._clock = host, port, clock
        self._declaration = declaration or Declaration()
        self._landmarks = checked_names("landmarks", landmarks)
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()
        self._waiting: deque[_Raw | FrameSample] = deque()
        self._sensors: dict[str, UdpSensor] = {}
        self._left_out: Counter[tuple[str, str]] = Counter()
        self._told: set[tuple[str, str]] = set()
        self._notices: list[str] = []
        self._lost, self._lost_told, self._lost_told_at = 0, 0, -math.inf
        self._last_frame: tuple[int | None, float] = (None, -math.inf)
        self._wall = time.time() - time.monotonic()

    @classmethod
    def of(cls, text: str, **options: Any) -> Self:
        """Return the source of ``udp:PORT`` or ``udp:HOST:PORT``.

        Args:
            text: as on the command line. options: further arguments of the constructor.

        Raises:
            InvalidInputError: another form.
        """
        kind, _, rest = text.partition(":")
        host, _, port = rest.rpartition(":")
        if kind != "udp" or not port.isdecimal():
            raise InvalidInputError(f"{text!r}: give udp:PORT or udp:HOST:PORT, such as udp:9000")
        return cls(int(port), host.strip("[]") or LOOPBACK, **options)

    @property
    def port(self) -> int:
        """Port that is listened to."""
        return self._port

    @property
    def name(self) -> str:
        """``udp:PORT``, or ``udp:HOST:PORT`` for another host than this machine's own address."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"udp:{self._port}" if host == LOOPBACK else f"udp:{host}:{self._port}"

    @property
    def clock(self) -> Clock:
        """Clock of the time stamps."""
        return self._clock

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the inertial sensors seen so far."""
        with self._lock:
            return tuple(self._sensors)

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points of a frame; empty until they are known."""
        return self._landmarks

    @property
    def finished(self) -> bool:
        """Whether the source was closed: a port does not end by itself."""
        return self._closed.is_set()

    @property
    def left_out(self) -> dict[tuple[str, str], int]:
        """Number of readings left out, by sensor (or address) and kind of problem."""
        with self._lock:
            return dict(self._left_out)

    @property
    def lost(self) -> int:
        """Number of samples dropped because `poll` was not called for too long."""
        return self._lost

    def start(self) -> None:
        """Open the port and begin to collect.

        Raises:
            SourceError: the port is taken, or the host is not an address of this machine.
        """
        if self._socket is not None or self.finished:
            return
        self._socket = self._opened()
        self._port = int(self._socket.getsockname()[1])
        if not ipaddress.ip_address(self._socket.getsockname()[0].partition("%")[0]).is_loopback:
            self._notices.append(f"{self.name}: takes samples from every machine that reaches this one")
        self._thread = threading.Thread(target=self._receive, name=self.name, daemon=True)
        self._thread.start()

    def _opened(self) -> socket.socket:
        remedy = "end the other program, or send to and listen at another port"
        try:
            family, kind, _, _, address = socket.getaddrinfo(
                self._host, self._port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
            )[0]
            opened = socket.socket(family, kind)
        except OSError as error:
            raise SourceError(f"{self.name}: no such host ({error}); give udp:PORT") from error
        try:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            opened.settimeout(0.1)
            opened.bind(address)
        except OSError as error:
            opened.close()
            raise SourceError(f"{self.name}: cannot listen there ({error.strerror}); {remedy}") from error
        return opened

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, without waiting."""
        now = time.monotonic()
        with self._lock:
            for sensor in self._sensors.values():
                self._take(sensor.overdue(now))
            waiting, self._waiting = self._waiting, deque()
        raw = [one for one in waiting if isinstance(one, _Raw)]
        converted = iter(self._converted(raw))
        samples = [next(converted) if isinstance(one, _Raw) else one for one in waiting]
        return [sample for sample in samples if sample is not None]

    def notices(self) -> list[str]:
        """Return sentences since the last call about what was left out or mended, and why."""
        now = time.monotonic()
        with self._lock:
            if self._lost > self._lost_told and now - self._lost_told_at > _LOSS_TOLD_EVERY_S:
                new = self._lost - self._lost_told
                self._notices.append(f"{self.name}: {new} samples lost, they were not fetched in time")
                self._lost_told, self._lost_told_at = self._lost, now
            told, self._notices = self._notices, []
        return told

    def close(self) -> None:
        """Stop; may be called twice."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(2.0)
        if self._socket is not None:
            self._socket.close()

    # --- thread ----------------------------------------------------------------------------------

    def _receive(self) -> None:
        assert self._socket is not None
        while not self._closed.is_set():
            try:
                datagram, sender = self._socket.recvfrom(1 << 16)
            except TimeoutError:
                continue
            except OSError as error:  # such as a network that goes away
                with self._lock:
                    self._remark(Remark("", "network", f"cannot receive ({error.strerror})", left_out=False))
                self._closed.wait(0.1)
                continue
            self._datagram(datagram, sender)

    def _datagram(self, datagram: bytes, sender: Any) -> None:
        """Take one datagram; nothing that it holds ends the thread."""
        now = time.monotonic()
        with self._lock:
            try:
                for content in contents(datagram):
                    match content:
                        case Reading():
                            self._reading(content, now, sender)
                        case Points():
                            self._points(content, now)
                        case Landmarks():
                            self._names(content.names)
                        case Remark():
                            self._remark(content)
            except RtofError as error:
                self._remark(Remark("", "not installed", str(error)))

    def _reading(self, reading: Reading, now: float, sender: Any) -> None:
        name = reading.sensor
        sensor = self._sensors.get(name)
        if sensor is None:
            if not 0 < len(name) <= 64 or not name.isprintable():
                self._remark(Remark("", "name", "a sensor has no printable name of up to 64 characters"))
                return
            if len(self._sensors) == _MOST_SENSORS:
                self._remark(Remark("", "sensors", f"more than {_MOST_SENSORS} names of sensors"))
                return
        problem = _problem(reading) or self._undated(name, reading.time)
        if problem is not None:
            self._remark(problem)
            return
        sensor = self._sensors.setdefault(name, UdpSensor(name))
        if problem := sensor.of_another(sender, now):
            self._remark(problem)
            return
        self._take(sensor.paired(reading, now))

    def _take(self, readings: list[tuple[Reading, float]]) -> None:
        """Queue whole readings and their times of arrival."""
        for reading, arrival in readings:
            sensor = self._sensors[reading.sensor]
            stamp, remarks = sensor.stamped(reading, arrival + self._wall)
            for remark in (*remarks, *self._clock_remarks(sensor)):
                self._remark(remark)
            if stamp is not None:
                missing = (math.nan,) * 4
                self._queue(
                    _Raw(reading.sensor, stamp, reading.quaternion or missing,
                         reading.acceleration or missing[:3])
                )  # fmt: skip

    def _clock_remarks(self, sensor: UdpSensor) -> list[Remark]:
        """Compare a sensor's clock, once, with that of the first one whose clock is known."""
        first = next((one for one in self._sensors.values() if one.clock_known), None)
        if first is None:
            return []
        return sensor.compared(first)

    def _points(self, points: Points, now: float) -> None:
        problem = self._problem_of(points) or self._undated("frames", points.time)
        stamp = now + self._wall if points.time is None else points.time
        number, before = self._last_frame
        if problem is None and stamp == before:
            problem = Remark("frames", "repeated time", "two frames have one time; send each frame once")
        if problem is not None:
            self._remark(problem)
            return
        self._last_frame = (points.number, stamp)
        if number is not None and points.number is not None and points.number > number + 1:
            gap = points.number - number - 1
            self._left_out["frames", "lost"] += gap
            self._tell("frames", "lost", f"by their numbers {gap} did not arrive; they are counted")
        if points.time is None:
            self._tell("frames", "no time", "come without times; times of arrival are used")
        confidence = np.array(points.confidence)
        uv = np.array(points.uv_px).reshape(-1, 2)
        seen = np.isfinite(uv).all(axis=1) & (confidence > 0)
        uv[~seen], confidence[~seen] = np.nan, 0.0
        self._queue(FrameSample(stamp, uv, confidence))

    def _problem_of(self, points: Points) -> Remark | None:
        count = len(points.confidence)
        if not self._landmarks:
            return Remark("frames", "landmarks", 'come before their names; send {"landmarks": [...]} first')
        if count != len(self._landmarks):
            return Remark("frames", "count", f"have {count} points; {len(self._landmarks)} were named")
        if points.time is not None and not math.isfinite(points.time):
            return Remark("frames", "not finite", "have a time that is no number")
        if not all(0 <= c <= 1 for c in points.confidence):
            return Remark("frames", "confidence", "have a confidence outside 0 to 1; send it on that scale")
        if any(math.isinf(value) for row in points.uv_px for value in row):
            return Remark("frames", "infinite", "have an infinite coordinate; send null for unseen points")
        return None

    def _undated(self, subject: str, stamp: float | None) -> Remark | None:
        if stamp is not None or self._clock is Clock.OWN:
            return None
        return Remark(subject, "no time", "no time is sent, though the clock is declared common; send it")

    def _names(self, names: tuple[str, ...]) -> None:
        if not self._landmarks:
            self._landmarks = names
        elif names != self._landmarks:
            self._remark(Remark("landmarks", "changed", "changed; start again to use other points"))

    # --- queue and messages; all under the lock --------------------------------------------------

    def _queue(self, sample: _Raw | FrameSample) -> None:
        if len(self._waiting) == _WAITING:
            self._waiting.popleft()
            self._lost += 1
        self._waiting.append(sample)

    def _remark(self, remark: Remark) -> None:
        key = remark.subject, remark.kind
        if len(self._left_out) >= _MOST_PROBLEMS and key not in self._left_out:
            key = "", remark.kind
        if remark.left_out:
            self._left_out[key] += 1
        self._tell(*key, remark.problem + ("; left out" if remark.left_out else ""))

    def _tell(self, subject: str, kind: str, problem: str) -> None:
        """Queue a notice, once of each subject and kind."""
        if (subject, kind) not in self._told and len(self._told) < _MOST_PROBLEMS:
            self._told.add((subject, kind))
            self._notices.append(": ".join(filter(None, (self.name, subject, problem))))

    def _converted(self, raw: list[_Raw]) -> list[ImuSample | None]:
        """Return samples in the package's units and axes; None without anything known."""
        if not raw:
            return []
        R = self._declaration.rotations(np.array([one.quaternion for one in raw]))
        f = self._declaration.specific_force(np.array([one.acceleration for one in raw]), R)
        known: Mask = np.asarray(np.isfinite(R).all(axis=(1, 2)) | np.isfinite(f).all(axis=1))
        if not known.all():
            problem = "its accelerations, as declared, need an orientation beside them; send both"
            with self._lock:
                for i in np.flatnonzero(~known):
                    self._remark(Remark(raw[i].sensor, "no orientation", problem))
        return [
            ImuSample(one.sensor, one.time, R[i], f[i]) if known[i] else None for i, one in enumerate(raw)
        ]


def _problem(reading: Reading) -> Remark | None:
    """Return why a reading cannot be right, if so."""
    parts = (reading.quaternion or (), reading.acceleration or (), (reading.time or 0.0,))
    if not all(math.isfinite(value) for part in parts for value in part):
        return Remark(reading.sensor, "not finite", "sends NaN or infinite numbers")
    if reading.quaternion is not None and abs(math.hypot(*reading.quaternion) - 1) > _NORM_ERROR:
        norm = math.hypot(*reading.quaternion)
        return Remark(reading.sensor, "norm", f"its quaternion has norm {norm:.3g}; send unit quaternions")
    return None
