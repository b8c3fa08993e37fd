"""MVNX files of Xsens MVN: XML with sensors, segments and a list of frames, read as a stream.

Frames of calibration poses come first (``type`` identity, tpose, npose, ...) and are kept apart. Of the
others these tags are read, each of which may be absent: sensorOrientation (quaternion w x y z from the
sensor to MVN's world, z up), sensorFreeAcceleration (m/s^2, gravity removed, axes of MVN's world),
sensorMagneticField (sensor axes); orientation and position (m) of segments in MVN's world. A sensor has
the name of the segment that carries it. There is no gyroscope.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import IO, Any, Final
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.readings import Readings, lost, sensor_log
from rtof_kin.formats.sensors.sensor_text import utc_of_milliseconds

TITLE: Final = "Xsens MVNX"
LARGEST_BYTES = 2**33  #: Largest file that is read, bytes; an hour of MVN at 60 Hz with all its tags has about 4 GB
LARGEST_FRAME = 2**24  #: Largest frame, bytes; MVN's have some 20 thousand
_SENSOR_TAGS: Final = {"sensorOrientation": 4, "sensorFreeAcceleration": 3, "sensorMagneticField": 3}
_SEGMENT_TAGS: Final = {"orientation": 4, "position": 3}
_WIDTHS: Final = _SENSOR_TAGS | _SEGMENT_TAGS  #: Numbers per sensor, or per segment, in the tags that are read
_RAW: Final = frozenset({"sensorAcceleration", "sensorAngularVelocity"})
_MOST: Final = 1000  #: Largest number of sensors, segments or poses


@dataclass(frozen=True)
class MvnxPose:
    """A calibration pose of MVN's avatar."""

    quat_wxyz: Array | None  #: (G, 4) from each segment to MVN's world
    p_world: Array | None  #: (G, 3) each segment's origin, m


@dataclass(frozen=True)
class Mvnx:
    """Content of an MVNX file in MVN's own frames; arrays are None where absent."""

    sensors: tuple[str, ...]  #: S names
    segments: tuple[str, ...]  #: G names
    rate_hz: float
    index: NDArray[np.int64]  #: (T,) numbers of the frames; missing ones were not exported
    poses: Mapping[str, MvnxPose]  #: Calibration poses by their type, e.g. 'tpose'.
    quat_world_sensor: Array | None  #: (T, S, 4), w x y z
    a_world: Array | None  #: (T, S, 3) free acceleration, m/s^2, in MVN's world
    m_sensor: Array | None  #: (T, S, 3) in sensor axes
    quat_world_segment: Array | None  #: (T, G, 4), w x y z
    p_world_segment: Array | None  #: (T, G, 3) m
    unread: tuple[str, ...] = ()  #: Tags of raw sensor data, of old versions, that are ignored
    start_utc: datetime | None = None  #: Date and time of frame 0 (recDateMSecsSinceEpoch), with its zone UTC


def is_mvnx(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return "<mvnx" in head


def read_mvnx(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the file's frameRate."""
    own = Declaration(gravity="removed", acceleration_axes="inertial")
    declaration = own.changed(**declared)
    mvnx = read_mvnx_file(path)
    rate = declaration.rate_hz or mvnx.rate_hz
    times = mvnx.index / rate
    if mvnx.quat_world_sensor is None and mvnx.a_world is None:
        raise FileFormatError(path, f"no frame has {' or '.join(list(_SENSOR_TAGS)[:2])}; export them")
    a, m, quat = mvnx.a_world, mvnx.m_sensor, mvnx.quat_world_sensor
    sensors = [
        Readings(
            name,
            times,
            acceleration=None if a is None else a[:, s],
            magnetometer=None if m is None else m[:, s],
            quaternions=None if quat is None else quat[:, s],
        )
        for s, name in enumerate(mvnx.sensors)
    ]
    notes = [*lost(times, rate)]
    if mvnx.poses:
        notes.append(f"calibration poses ({', '.join(mvnx.poses)}) are no samples; see read_mvnx_file")
    if mvnx.unread:
        notes.append(f"not read, as their axes differ between versions: {', '.join(mvnx.unread)}")
    start = mvnx.start_utc
    if start is not None:
        start += timedelta(seconds=float(times[0]))
    return sensor_log([path], TITLE, sensors, declaration, notes, start)


def read_mvnx_file(path: Path) -> Mvnx:
    """Read sensors, segments and calibration poses of a file, in MVN's own frames. `FileFormatError`: no such file, too
    large, broken XML, entities or a document type (not written by MVN, and usable to fill the memory), no frame, or
    invalid numbers.
    """
    content = _Content(path)
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise FileFormatError(path, f"larger than {LARGEST_BYTES / 2**30:.0f} GiB; split it")
        for element in _elements(path):
            content.take(element)
    except FileFormatError:
        raise
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except ParseError as error:
        raise FileFormatError(path, f"broken XML: {error}", error.position[0]) from error
    except DefusedXmlException as error:
        problem = f"holds what no MVNX file needs and is refused: {type(error).__name__}"
        raise FileFormatError(path, problem) from error
    except (OSError, ValueError, LookupError) as error:  # e.g. an unknown encoding
        raise FileFormatError(path, f"cannot be read: {error}") from error
    return content.mvnx()


def _elements(path: Path) -> Iterator[Element]:
    """Yield each element at its end, frames whole and others without children, and drop it after use."""
    above: list[Element] = []
    tags: list[str] = []
    with path.open("rb") as stream:
        bounded = _Bounded(path, stream)
        for event, element in iterparse(bounded, events=("start", "end"), forbid_dtd=True):
            if event == "start":
                above.append(element)
                tags.append(_tag(element))
                if tags[0] != "mvnx":
                    raise FileFormatError(path, f"its root is <{tags[0][:40]}>, not <mvnx>")
                continue
            above.pop()
            tags.pop()
            if "frame" not in tags:
                yield element
                if above:
                    above[-1].remove(element)
                bounded.unreleased = 0


@dataclass
class _Bounded:
    """A file whose bytes since the last dropped element are limited to `LARGEST_FRAME`."""

    path: Path
    stream: IO[bytes]
    unreleased: int = 0

    def read(self, size: int = -1) -> bytes:
        self.unreleased += size
        if self.unreleased > LARGEST_FRAME:
            problem = f"an element in it is larger than {LARGEST_FRAME / 2**20:.0f} MiB"
            raise FileFormatError(self.path, problem)
        return self.stream.read(size)


def _tag(element: Element) -> str:
    """Return the tag without its name space."""
    return str(element.tag).rpartition("}")[2]


@dataclass
class _Content:
    """Content read so far."""

    path: Path
    rate_hz: float = np.nan
    labels: dict[str, list[str]] = field(default_factory=lambda: {"sensor": [], "segment": []})
    index: list[int] = field(default_factory=list)
    numbers: dict[str, array[float]] = field(default_factory=dict)
    poses: dict[str, MvnxPose] = field(default_factory=dict)
    unread: set[str] = field(default_factory=set)
    start_utc: datetime | None = None

    def take(self, element: Element) -> None:
        """Read an element of the file, in the order of the file."""
        tag = _tag(element)
        if tag == "subject":
            self.rate_hz = self._number(element.get("frameRate"), "frameRate of <subject>")
            if self.rate_hz <= 0:
                problem = f"frameRate of <subject> is {self.rate_hz:g}; it must be positive"
                raise FileFormatError(self.path, problem)
            self.start_utc = utc_of_milliseconds(element.get("recDateMSecsSinceEpoch", ""))
        elif tag == "frame":
            self._frame(element)
        elif tag in self.labels:
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
        return len(self.labels["sensor" if tag in _SENSOR_TAGS else "segment"]) * _WIDTHS[tag]

    def _values(self, tag: str, children: dict[str, str | None], where: str) -> list[float] | None:
        """Return the numbers of one tag of a frame; None where it is absent or empty."""
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
        return values

    def _shaped(self, tag: str, values: array[float] | list[float] | None) -> Array | None:
        if values is None or len(values) == 0:
            return None
        table = np.array(values).reshape(-1, _WIDTHS[tag])
        return np.asarray(readonly(tag, table, table.shape))

    def mvnx(self) -> Mvnx:
        """Return what was read; raise `FileFormatError` where it is no recording."""
        if not self.index or np.isnan(self.rate_hz):
            raise FileFormatError(self.path, "has no frame of a recording in a <subject>")
        T = len(self.index)
        flat = (self._shaped(tag, self.numbers.get(tag)) for tag in _WIDTHS)
        quat, a, m, quat_segment, p = (v if v is None else v.reshape(T, -1, v.shape[1]) for v in flat)
        sensors, segments = tuple(self.labels["sensor"]), tuple(self.labels["segment"])
        index = readonly("index", self.index, ("T",), np.int64)
        unread = tuple(sorted(self.unread))
        return Mvnx(
            sensors, segments, self.rate_hz, index, self.poses, quat, a, m, quat_segment, p, unread, self.start_utc
        )
