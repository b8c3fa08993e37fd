"""MVNX files of Xsens MVN: XML with sensors, segments and a list of frames, read as a stream.

Frames of calibration poses (``type`` identity, tpose, npose, ...) are left out. Of the others these tags of sensors are
read, each of which may be absent: sensorOrientation (quaternion w x y z from the sensor to MVN's world, z up),
sensorFreeAcceleration (m/s^2, gravity removed, axes of MVN's world), sensorMagneticField (sensor axes). There is no
gyroscope.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.readings import Readings, lost, sensor_log
from rtof_kin.formats.sensors.sensor_text import utc_of_milliseconds

TITLE: Final = "Xsens MVNX"
LARGEST_BYTES = 2**33  #: Largest file that is read, bytes; an hour of MVN at 60 Hz with all its tags has about 4 GB
_WIDTHS: Final = {"sensorOrientation": 4, "sensorFreeAcceleration": 3, "sensorMagneticField": 3}
"""Numbers per sensor in the tags that are read."""
_MOST: Final = 1000  #: Largest number of sensors
_RAW: Final = frozenset({"sensorAcceleration", "sensorAngularVelocity"})


def is_mvnx(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return "<mvnx" in head


def read_mvnx(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the file's frameRate. Entities and a document type,
    which MVN does not write and which could fill the memory, are refused.
    """
    declaration = Declaration(gravity="removed", acceleration_axes="inertial").changed(**declared)
    content = _read(path)
    rate = declaration.rate_hz or content.rate_hz
    times = np.array(content.index) / rate
    found = {
        tag: np.array(content.numbers[tag]).reshape(len(times), -1, width)
        for tag, width in _WIDTHS.items()
        if content.numbers[tag]
    }
    if not found.keys() & set(list(_WIDTHS)[:2]):
        raise FileFormatError(path, f"no frame has {' or '.join(list(_WIDTHS)[:2])}; export them")
    sensors = []
    for s, name in enumerate(content.sensors):
        quat, a, m = (found[tag][:, s] if tag in found else None for tag in _WIDTHS)
        sensors.append(Readings(name, times, a, None, m, quat))
    notes = [*lost(times, rate)]
    if content.poses:
        notes.append(f"calibration poses ({', '.join(content.poses)}) are no samples")
    if content.unread:
        notes.append(f"not read, as their axes differ between versions: {', '.join(sorted(content.unread))}")
    start = content.start_utc and content.start_utc + timedelta(seconds=float(times[0]))
    return sensor_log([path], TITLE, sensors, declaration, notes, start)


def _read(path: Path) -> _Content:
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
    if not content.index or np.isnan(content.rate_hz):
        raise FileFormatError(path, "has no frame of a recording in a <subject>")
    return content


def _elements(path: Path) -> Iterator[Element]:
    """Yield each element at its end, frames whole and others without children, and drop it after use."""
    above: list[Element] = []
    tags: list[str] = []
    with path.open("rb") as stream:
        for event, element in iterparse(stream, events=("start", "end"), forbid_dtd=True):
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


def _tag(element: Element) -> str:
    """Return the tag without its name space."""
    return str(element.tag).rpartition("}")[2]


@dataclass
class _Content:
    """Content read so far."""

    path: Path
    rate_hz: float = np.nan
    sensors: list[str] = field(default_factory=list)
    index: list[int] = field(default_factory=list)  # numbers of the frames; missing ones were not exported
    numbers: dict[str, array[float]] = field(default_factory=lambda: {tag: array("d") for tag in _WIDTHS})
    poses: dict[str, None] = field(default_factory=dict)  # types of calibration poses, e.g. 'tpose'
    unread: set[str] = field(default_factory=set)  # tags of raw sensor data, of old versions
    start_utc: datetime | None = None  # of frame 0 (recDateMSecsSinceEpoch)

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
        elif tag == "sensor":
            self.sensors.append(element.get("label", ""))
            if len(self.sensors) > _MOST or self.sensors[-1] in ("", *self.sensors[:-1]):
                problem = f"<sensor> {len(self.sensors)} has no label of its own ({self.sensors[-1][:40]!r})"
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
        kind = frame.get("type", "normal")
        if kind != "normal":
            self.poses[kind] = None
            return
        children = {_tag(child): child.text for child in frame}
        self.unread |= _RAW & set(children)
        done = len(self.index)
        where = f"frame {frame.get('index', done)}"
        self.index.append(int(self._number(frame.get("index", str(done)), f"index of {where}")))
        if done and self.index[-1] <= self.index[-2]:
            raise FileFormatError(self.path, f"{where} comes after frame {self.index[-2]}")
        for tag, each in _WIDTHS.items():
            width, words = each * len(self.sensors), (children.get(tag) or "").split()
            try:
                values = array("d", map(float, words))
            except ValueError as error:
                raise FileFormatError(self.path, f"{where}: {tag} holds no numbers ({error})") from error
            if words and len(words) != width:
                problem = f"{where}: {tag} has {len(words)} numbers, and {width} are needed"
                raise FileFormatError(self.path, problem)
            missing = array("d", [np.nan]) * width
            if words and not self.numbers[tag]:
                self.numbers[tag] = missing * done
            if words or self.numbers[tag]:
                self.numbers[tag] += values if words else missing
