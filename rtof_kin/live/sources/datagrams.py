"""Readings of sensors and detected points in UDP datagrams: OSC, JSON or CSV.

OSC addresses and arguments, alone or in bundles (numbers of any OSC type; send times as 64-bit floats):

============================== =====================================================================
``/imu/SENSOR``                time, quaternion (4), acceleration (3)
``/SENSOR/quat``               quaternion (4); time from the bundle's time tag
``/SENSOR/acc``                acceleration (3), likewise
``/landmarks``                 names of the points of all frames to come
``/frame``                     number, time, then x, y, confidence of each point
============================== =====================================================================

More parts may come before SENSOR; ``quaternion``, ``orientation``, ``accel``, ``accelerometer`` and
``acceleration`` are known too. JSON, an object or a list of objects::

    {"sensor": "S1", "time": 1.25, "quat": [w, x, y, z], "acc": [x, y, z]}
    {"landmarks": ["Nose", "LeftEye"]}
    {"frame": 7, "time": 1.25, "uv": [[x, y], [x, y]], "confidence": [0.9, 0.8]}

CSV, a reading a line: ``sensor,time,qw,qx,qy,qz,ax,ay,az``, where time or all three accelerations may be
empty. Times are in s. Units and conventions of quaternions and accelerations are declared by the receiver.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from rtof_kin.core.packages import optional

_BUNDLE: Final = b"#bundle\x00"
_TYPES: Final = frozenset(b"ihfdstTFN[]")
_DEEPEST: Final = 8
"""Levels of bundles in bundles."""
_QUATERNION: Final = {"quat", "quaternion", "orientation"}
_ACCELERATION: Final = {"acc", "accel", "accelerometer", "acceleration"}
_COARSE_S: Final = 8192.0
"""[s] from here on a time as 32-bit float is wrong by more than half a millisecond."""
_FULL: Final = "time, quaternion (4) and acceleration (3)"


@dataclass(frozen=True)
class Reading:
    """What one message says of one sensor."""

    sensor: str
    time: float | None
    """[s] by the sender; None if it gives none."""
    quaternion: tuple[float, ...] | None
    """(4), in the sender's order."""
    acceleration: tuple[float, ...] | None
    """(3), in the sender's unit and axes."""


@dataclass(frozen=True)
class Points:
    """Detected points of one frame."""

    number: int | None
    """Of the frame."""
    time: float | None
    """[s] by the sender; None if it gives none."""
    uv_px: tuple[tuple[float, float], ...]
    """L points; NaN where unseen."""
    confidence: tuple[float, ...]
    """L numbers."""


@dataclass(frozen=True)
class Landmarks:
    """Names of the points of all frames to come."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class Remark:
    """Something wrong with what was sent."""

    subject: str
    """Sensor or address; '' for the datagram."""
    kind: str
    """Word by which equal problems of one subject are counted."""
    problem: str
    """The problem, and the remedy."""
    left_out: bool = True
    """Whether something was left out."""


Content = Reading | Points | Landmarks | Remark


def contents(datagram: bytes) -> Iterator[Content]:
    """Yield what a datagram holds, in its order; what cannot be read is a `Remark`.

    Args:
        datagram: any bytes.

    Raises:
        RtofError: it is OSC, and the extra is not installed.
    """
    if datagram[:1] == b"/" or datagram.startswith(_BUNDLE):
        yield from _osc_contents(datagram)
        return
    try:
        text = datagram.decode("utf-8").strip()
    except UnicodeDecodeError:
        yield _unreadable("neither OSC nor text")
        return
    values = _json(text)
    if values is not None:
        yield from map(_of_json, values)
        return
    for line in text.splitlines():
        values = _json(line)
        yield from map(_of_json, values) if values is not None else [_of_csv(line)]


def _unreadable(problem: str) -> Remark:
    return Remark("", "unreadable", f"a datagram cannot be read: {problem}; send OSC, JSON or CSV")


def _numbers(values: Any) -> tuple[float, ...] | None:
    """Return numbers, NaN for null; None if something else is among them."""
    if not isinstance(values, list | tuple):
        return None
    out = []
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float | None):
            return None
        try:
            out.append(math.nan if value is None else float(value))
        except OverflowError:
            return None
    return tuple(out)


def _of_length(values: Any, lengths: Sequence[int]) -> tuple[float, ...] | None:
    """Return numbers of an expected count, or None."""
    numbers = _numbers(values)
    return numbers if numbers is not None and len(numbers) in lengths else None


def _wrong(subject: str, needed: str) -> Remark:
    return Remark(subject, "arguments", f"its messages have other content than {needed}")


# --- OSC -----------------------------------------------------------------------------------------


@cache
def _osc() -> tuple[Any, Any]:
    """Return pythonosc's reader of one message and its reader of types."""
    return optional("pythonosc.osc_message", "live"), optional("pythonosc.parsing.osc_types", "live")


def _osc_contents(datagram: bytes) -> Iterator[Content]:
    messages, types = _osc()
    try:
        for tag, data in _osc_messages(datagram, types):
            _check_types(data)
            message = messages.OscMessage(data)
            yield from _of_osc(message.address, message.params, data, tag)
    except (messages.ParseError, types.ParseError, ValueError, OverflowError, RecursionError) as error:
        yield _unreadable(f"broken OSC ({error})")


def _osc_messages(datagram: bytes, types: Any) -> Iterator[tuple[float | None, bytes]]:
    """Yield the messages of nested bundles with their time tags, s since 1970, None for 'immediately'.

    pythonosc's own reader of bundles replaces time tags of the past by the time of reading, and does not end
    at a negative size.
    """
    waiting: list[tuple[float | None, bytes, int]] = [(None, datagram, 0)]
    while waiting:
        time, data, depth = waiting.pop()
        if not data.startswith(_BUNDLE):
            yield time, data
            continue
        if depth == _DEEPEST:
            raise ValueError(f"bundles in more than {_DEEPEST} levels")
        tag, at = types.get_date(data, len(_BUNDLE))
        parts = []
        while at < len(data):
            size, at = types.get_int(data, at)
            if not 0 < size <= len(data) - at:
                raise ValueError(f"a part of {size} bytes")
            parts.append((tag or time, data[at : at + size], depth + 1))
            at += size
        waiting += reversed(parts)


def _check_types(data: bytes) -> None:
    """Raise for a type of argument that pythonosc would skip and log."""
    first = data.find(b",")
    tags = data[first + 1 : max(data.find(b"\x00", first), 0)] if first >= 0 else b""
    if not set(tags) <= _TYPES:
        raise ValueError("an argument of a type that numbers and names do not have")


def _of_osc(address: str, values: list[Any], data: bytes, tag: float | None) -> Iterator[Content]:
    """Yield the content of one message; `data` is the message, `tag` the time of its bundle."""
    *path, kind = address.strip("/").split("/")
    if kind.lower() in _QUATERNION and path:
        numbers = _of_length(values, [4])
        yield Reading(path[-1], tag, numbers, None) if numbers else _wrong(address, "4 numbers")
    elif kind.lower() in _ACCELERATION and path:
        numbers = _of_length(values, [3])
        yield Reading(path[-1], tag, None, numbers) if numbers else _wrong(address, "3 numbers")
    elif path == ["imu"]:
        numbers = _of_length(values, [8])
        if not numbers:
            yield _wrong(kind, f"8 numbers: {_FULL}")
            return
        yield from _coarse(kind, numbers[0], data, 0)
        yield Reading(kind, numbers[0], numbers[1:5], numbers[5:])
    elif kind == "landmarks" and not path:
        yield _landmarks(values)
    elif kind == "frame" and not path:
        numbers = _numbers(values)
        if not numbers or len(numbers) % 3 != 2 or not math.isfinite(numbers[0]):
            yield _wrong("frames", "number, time, and x, y, confidence of each point")
            return
        yield from _coarse("frames", numbers[1], data, 1)
        uv = tuple(zip(numbers[2::3], numbers[3::3], strict=True))
        yield Points(int(numbers[0]), numbers[1], uv, numbers[4::3])
    else:
        known = "/imu/SENSOR, /SENSOR/quat, /SENSOR/acc, /landmarks and /frame"
        yield Remark(address[:64], "address", f"an unknown OSC address; known: {known}")


def _coarse(subject: str, time: float, data: bytes, argument: int) -> Iterator[Remark]:
    """Yield a remark on a time that is a 32-bit float and too large for it."""
    if abs(time) < _COARSE_S:
        return
    tags = data[data.index(b",") + 1 :]
    if tags[argument : argument + 1] == b"f":
        problem = "its time is a 32-bit float, which rounds it; send a 64-bit float (OSC type d)"
        yield Remark(subject, "coarse time", problem, left_out=False)


# --- text ----------------------------------------------------------------------------------------


def _json(text: str) -> list[Any] | None:
    """Return the objects of a JSON text; None if it is something else."""
    if not text.startswith(("{", "[")):
        return None
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, list) else [found]


def _of_json(found: Any) -> Content:
    if not isinstance(found, dict):
        return _unreadable("JSON that is no object")
    if "landmarks" in found:
        return _landmarks(found["landmarks"])
    if "uv" in found:
        return _points_of_json(found)
    sensor = found.get("sensor")
    if not isinstance(sensor, str):
        return _unreadable("JSON without 'sensor', 'uv' or 'landmarks'")
    time = _of_length([found.get("time")], [1])
    quaternion, acceleration = found.get("quat"), found.get("acc")
    numbers = _of_length(quaternion, [4]), _of_length(acceleration, [3])
    given = quaternion is not None, acceleration is not None
    if time is None or given != tuple(one is not None for one in numbers) or not any(given):
        return _wrong(sensor, "time (a number), quat (4 numbers) and acc (3 numbers)")
    return Reading(sensor, None if found.get("time") is None else time[0], *numbers)


def _points_of_json(found: dict[str, Any]) -> Content:
    number, uv, confidence = found.get("frame"), found["uv"], found.get("confidence")
    time = _of_length([found.get("time")], [1])
    rows = [_of_length(row, [2]) for row in uv] if isinstance(uv, list) else [None]
    points = [(row[0], row[1]) for row in rows if row is not None]
    if confidence is None:
        confidence = [1.0] * len(points)
    numbers = _of_length(confidence, [len(points)])
    whole = number is None or (isinstance(number, int) and not isinstance(number, bool))
    if time is None or len(points) < len(rows) or numbers is None or not whole:
        return _wrong("frames", "frame (a whole number), time, uv (pairs) and confidence (one a pair)")
    return Points(number, None if found.get("time") is None else time[0], tuple(points), numbers)


def _landmarks(names: Any) -> Content:
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        return _wrong("landmarks", "names")
    if len(set(names)) < len(names):
        return Remark("landmarks", "double", "a name occurs more than once; name every point differently")
    return Landmarks(tuple(names))


def _of_csv(line: str) -> Content:
    sensor, *cells = (cell.strip() for cell in line.split(","))
    if len(cells) != 8:
        return _unreadable(f"{1 + len(cells)} cells; a line has 9: sensor, {_FULL}")
    try:
        time, *numbers = (float(cell) if cell else math.nan for cell in cells)
    except ValueError:
        return _wrong(sensor, f"8 numbers: {_FULL}")
    acceleration = tuple(numbers[4:]) if any(cells[5:]) else None
    return Reading(sensor, time if cells[0] else None, tuple(numbers[:4]), acceleration)
