"""MVNX files of Xsens MVN: XML with sensors, segments and a list of frames, read as a stream.

Frames of calibration poses come first (``type`` identity, tpose, npose, ...) and are kept apart. Of the
others these tags are read, each of which may be absent: sensorOrientation (quaternion w x y z from the
sensor to MVN's world, z up), sensorFreeAcceleration (m/s^2, gravity removed, axes of MVN's world),
sensorMagneticField (sensor axes); orientation and position (m) of segments in MVN's world. A sensor is
named by the segment that carries it, as MVN does. There is no gyroscope.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse
from numpy.typing import NDArray

from rtof_kin.checks import readonly
from rtof_kin.errors import FileFormatError
from rtof_kin.inertial.declaration import Declaration
from rtof_kin.inertial.packets import lost
from rtof_kin.inertial.readings import Readings, sensor_log
from rtof_kin.inertial.streams import SensorLog
from rtof_kin.io.sensor_text import LARGEST_NUMBER

Array = NDArray[np.float64]
TITLE = "Xsens MVNX"
LARGEST_BYTES = 2**33
"""Larger files are refused; an hour of MVN at 60 Hz with all its tags has about 4 GB."""
_SENSOR_TAGS = {"sensorOrientation": 4, "sensorFreeAcceleration": 3, "sensorMagneticField": 3}
_SEGMENT_TAGS = {"orientation": 4, "position": 3}
_WIDTHS = _SENSOR_TAGS | _SEGMENT_TAGS
"""Numbers of each sensor, or of each segment, in the tags that are read."""
_RAW = {"sensorAcceleration", "sensorAngularVelocity"}
_MOST = 1000
"""Sensors or segments; more are none."""


@dataclass(frozen=True)
class MvnxPose:
    """A calibration pose of MVN's avatar."""

    quat_wxyz: Array | None
    """(G, 4) from each segment to MVN's world."""
    p_world: Array | None
    """(G, 3) each segment's origin, m."""


@dataclass(frozen=True)
class Mvnx:
    """What an MVNX file holds, in MVN's own frames; arrays are None where the file lacks them."""

    sensors: tuple[str, ...]
    """S labels; a sensor is called by its segment."""
    segments: tuple[str, ...]
    """G labels."""
    rate_hz: float
    index: NDArray[np.int64]
    """(T,) numbers of the frames; those that are missing were not exported."""
    poses: Mapping[str, MvnxPose]
    """Calibration poses by their type, e.g. 'tpose'."""
    quat_world_sensor: Array | None
    """(T, S, 4), w x y z."""
    a_world: Array | None
    """(T, S, 3) free acceleration, m/s^2, in MVN's world."""
    m_sensor: Array | None
    """(T, S, 3) in sensor axes."""
    quat_world_segment: Array | None
    """(T, G, 4), w x y z."""
    p_world_segment: Array | None
    """(T, G, 3) m."""
    unread: tuple[str, ...] = ()
    """Tags of raw sensor data, of old versions, that are there and are not read."""


def is_mvnx(head: str) -> bool:
    """Whether a file that begins so is such a file."""
    return "<mvnx" in head


def read_mvnx(path: Path, **declared: Any) -> SensorLog:
    """The sensors of one file.

    Args:
        declared: fields of `Declaration` to set otherwise than the format does; `rate_hz` instead of
            the file's frameRate.

    Raises:
        FileFormatError: as `read_mvnx_file`; or there is nothing of a sensor in it.
    """
    own = Declaration(gravity="removed", acceleration_axes="inertial")
    declaration = own.changed(**declared)
    mvnx = read_mvnx_file(path)
    rate = declaration.rate_hz or mvnx.rate_hz
    times = mvnx.index / rate
    if mvnx.quat_world_sensor is None and mvnx.a_world is None:
        raise FileFormatError(path, f"no frame has {' or '.join(list(_SENSOR_TAGS)[:2])}; export them")
    sensors = [
        Readings(
            name,
            times,
            acceleration=None if mvnx.a_world is None else mvnx.a_world[:, s],
            magnetometer=None if mvnx.m_sensor is None else mvnx.m_sensor[:, s],
            quaternions=None if mvnx.quat_world_sensor is None else mvnx.quat_world_sensor[:, s],
        )
        for s, name in enumerate(mvnx.sensors)
    ]
    notes = [*lost(times, rate)]
    if mvnx.poses:
        notes.append(f"frames of calibration poses are kept apart: {', '.join(mvnx.poses)}")
    if mvnx.unread:
        notes.append(f"not read, as their axes differ between versions: {', '.join(mvnx.unread)}")
    return sensor_log([path], TITLE, sensors, declaration, notes)


def read_mvnx_file(path: Path) -> Mvnx:
    """Sensors, segments and poses of a file, in MVN's own frames.

    Raises:
        FileFormatError: no such file, too large, broken XML, entities or a document type (which MVN does
            not write, and which can be made to fill the memory), no frame, numbers that are none.
    """
    content = _Content(path)
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise FileFormatError(path, f"larger than {LARGEST_BYTES / 2**30:.0f} GiB; split it")
        for element in _elements(path):
            content.take(element)
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except ParseError as error:
        raise FileFormatError(path, f"broken XML: {error}", error.position[0]) from error
    except DefusedXmlException as error:
        problem = f"holds what no MVNX file needs and is refused: {type(error).__name__}"
        raise FileFormatError(path, problem) from error
    except (OSError, ValueError, LookupError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, f"cannot be read: {error}") from error
    return content.mvnx()


def _elements(path: Path) -> Iterator[Element]:
    """Elements that say something, each as soon as it ends; what was read is dropped at once."""
    above: list[Element] = []
    with path.open("rb") as stream:
        for event, element in iterparse(stream, events=("start", "end"), forbid_dtd=True):
            if event == "start":
                above.append(element)
                if len(above) == 1 and _tag(element) != "mvnx":
                    raise FileFormatError(path, f"its root is <{_tag(element)[:40]}>, not <mvnx>")
                if _tag(element) == "subject":
                    yield element
                continue
            above.pop()
            if _tag(element) in ("sensor", "segment", "frame"):
                yield element
                above[-1].remove(element)


def _tag(element: Element) -> str:
    """Its tag without the name space."""
    return str(element.tag).rpartition("}")[2]


@dataclass
class _Content:
    """What was read so far."""

    path: Path
    rate_hz: float = np.nan
    labels: dict[str, list[str]] = field(default_factory=lambda: {"sensor": [], "segment": []})
    index: list[int] = field(default_factory=list)
    numbers: dict[str, array[float]] = field(default_factory=dict)
    poses: dict[str, MvnxPose] = field(default_factory=dict)
    unread: set[str] = field(default_factory=set)

    def take(self, element: Element) -> None:
        tag = _tag(element)
        if tag == "subject":
            self.rate_hz = self._number(element.get("frameRate"), "frameRate of <subject>")
        elif tag == "frame":
            self._frame(element)
        else:
            labels = self.labels[tag]
            labels.append(element.get("label", ""))
            if len(labels) > _MOST or labels[-1] in ("", *labels[:-1]):
                problem = f"<{tag}> {len(labels)} has no label of its own ({labels[-1][:40]!r})"
                raise FileFormatError(self.path, problem)

    def _number(self, text: str | None, what: str) -> float:
        try:
            value = float(text or "")
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise FileFormatError(self.path, f"{what} is {text!r}, not a number")
        return value

    def _frame(self, frame: Element) -> None:
        children = {_tag(child): child.text for child in frame}
        kind = frame.get("type", "normal")
        if kind != "normal":
            if len(self.poses) < _MOST:
                pose = {tag: self._values(tag, children, f"frame {kind!r}") for tag in _SEGMENT_TAGS}
                self.poses[kind] = MvnxPose(*(self._shaped(tag, pose[tag]) for tag in _SEGMENT_TAGS))
            return
        self.unread |= _RAW & set(children)
        done = len(self.index)
        where = f"frame {frame.get('index', done)}"
        self.index.append(int(self._number(frame.get("index", str(done)), f"index of {where}")))
        if done and self.index[-1] <= self.index[-2]:
            raise FileFormatError(self.path, f"{where} comes after frame {self.index[-2]}")
        for tag in _WIDTHS:
            values = self._values(tag, children, where)
            if values is not None and tag not in self.numbers:
                self.numbers[tag] = array("d", [np.nan]) * (done * self._width(tag))
            if tag in self.numbers:
                self.numbers[tag].extend([np.nan] * self._width(tag) if values is None else values)

    def _width(self, tag: str) -> int:
        kind = "sensor" if tag in _SENSOR_TAGS else "segment"
        return len(self.labels[kind]) * _WIDTHS[tag]

    def _values(self, tag: str, children: dict[str, str | None], where: str) -> list[float] | None:
        """The numbers of one tag of a frame; None where it is absent or empty."""
        words = (children.get(tag) or "").split()
        if not words:
            return None
        try:
            values = list(map(float, words))
        except ValueError as error:
            raise FileFormatError(self.path, f"{where}: {tag} holds no numbers ({error})") from error
        if len(values) != self._width(tag):
            problem = f"{where}: {tag} has {len(values)} numbers, and {self._width(tag)} are needed"
            raise FileFormatError(self.path, problem)
        if any(abs(value) > LARGEST_NUMBER for value in values):
            raise FileFormatError(self.path, f"{where}: {tag} holds a number that is no measurement")
        return values

    def _shaped(self, tag: str, values: array[float] | list[float] | None) -> Array | None:
        if values is None or len(values) == 0:
            return None
        table = np.array(values).reshape(-1, _WIDTHS[tag])
        return np.asarray(readonly(tag, table, table.shape))

    def mvnx(self) -> Mvnx:
        if not self.index:
            raise FileFormatError(self.path, "has no frame of a recording")
        Declaration(rate_hz=self.rate_hz)
        T = len(self.index)
        flat = {tag: self._shaped(tag, self.numbers.get(tag)) for tag in _WIDTHS}
        of_tag = {tag: v if v is None else v.reshape(T, -1, v.shape[1]) for tag, v in flat.items()}
        return Mvnx(
            sensors=tuple(self.labels["sensor"]),
            segments=tuple(self.labels["segment"]),
            rate_hz=self.rate_hz,
            index=np.array(self.index),
            poses=self.poses,
            quat_world_sensor=of_tag["sensorOrientation"],
            a_world=of_tag["sensorFreeAcceleration"],
            m_sensor=of_tag["sensorMagneticField"],
            quat_world_segment=of_tag["orientation"],
            p_world_segment=of_tag["position"],
            unread=tuple(sorted(self.unread)),
        )
