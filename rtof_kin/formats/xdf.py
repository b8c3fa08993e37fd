"""XDF files, as LabRecorder writes them: streams of the Lab Streaming Layer on one clock.

Inertial sensors are the streams whose channels are labelled as in `channels`; detected points those with
``<landmark>_x``, ``_y``, ``_confidence`` in px. Other streams are left aside. Times are the stamps, mapped to
the recorder's clock by the offsets in the file. They are not made equally spaced: where packets are lost that
would shift the others by some of them. A declared rate does it, for senders whose stamps jitter.

A file is ``XDF:`` and chunks of a length, a tag and content (https://github.com/sccn/xdf/wiki/Specifications). Every
length is checked against the others before anything is decoded, so that a damaged file is an error and neither fills
the memory nor gives wrong numbers. Recorders that crash leave the last chunk incomplete; what precedes it is intact.
"""

from __future__ import annotations

import io
import logging
import struct
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar
from xml.etree import ElementTree

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.packages import optional
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.channels import PointChannels, StreamChannels
from rtof_kin.formats.sensors.readings import lost

MAGIC: Final = b"XDF:"
_FILE_HEADER, _STREAM_HEADER, _SAMPLES, _CLOCK_OFFSET, _BOUNDARY, _STREAM_FOOTER = range(1, 7)
_OF_STREAM: Final = (_STREAM_HEADER, _SAMPLES, _CLOCK_OFFSET, _STREAM_FOOTER)
_LENGTHS: Final = {1: "<B", 4: "<I", 8: "<Q"}
_ITEM_BYTES: Final = {"double64": 8, "float32": 4, "int64": 8, "int32": 4, "int16": 2, "int8": 1}
_LARGEST_XML: Final = 2**24
_MOST_CHANNELS: Final = 2**14
_STAMP_BYTES: Final = 8
_OFFSET_BYTES: Final = 16


@dataclass(frozen=True)
class XdfHeader:
    """What one stream declares."""

    number: int  #: Of the stream, in the file
    name: str
    type: str
    source_id: str
    count: int  #: Number of channels
    item_bytes: int  #: Of one number; 0 for text
    rate_hz: float  #: Nominal sampling rate, Hz; 0 where irregular
    labels: tuple[str, ...]  #: Of the channels; fewer where the metadata lacks them
    units: tuple[str, ...]
    types: tuple[str, ...]


@dataclass(frozen=True)
class XdfStructure:
    """Streams of a file and its intact part."""

    headers: tuple[XdfHeader, ...]
    samples: Mapping[int, int]  #: Number of samples of each stream
    synchronised: frozenset[int]  #: Streams with measured offsets of their clock
    end: int  #: Byte where the intact chunks end
    cut: bool  #: Whether bytes follow there, of a chunk that is incomplete


class _CutError(Exception):
    """The file ends within a chunk."""


def read_structure(path: Path) -> XdfStructure:
    """Return the streams of a file, all of whose intact chunks fit together; else `FileFormatError`, which names the
    byte.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise FileFormatError(path, "does not begin with 'XDF:'")
            return _Chunks(path, stream).structure()
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error


class _Chunks:
    """Reads one file from its first chunk on."""

    def __init__(self, path: Path, stream: BinaryIO):
        self._path, self._stream = path, stream
        self._size = path.stat().st_size
        self._headers: dict[int, XdfHeader] = {}
        self._samples: dict[int, int] = {}
        self._synchronised: set[int] = set()

    def structure(self) -> XdfStructure:
        end = self._stream.tell()
        try:
            while end < self._size:
                self._chunk(end)
                end = self._stream.tell()
        except _CutError:
            pass
        return XdfStructure(
            tuple(self._headers.values()), self._samples, frozenset(self._synchronised), end, end < self._size
        )

    def _chunk(self, start: int) -> None:
        length = self._length(start)
        content = self._stream.tell()
        (tag,) = struct.unpack("<H", self._bytes(2))
        if not _FILE_HEADER <= tag <= _STREAM_FOOTER or length < 2:
            raise self._damaged(start, f"a chunk of the unknown kind {tag}")
        if content + length > self._size:
            raise _CutError
        if tag in _OF_STREAM:
            if length < 6:
                raise self._damaged(start, "a chunk without a stream")
            (number,) = struct.unpack("<I", self._bytes(4))
            self._of_stream(start, tag, number, length - 6)
        elif tag == _FILE_HEADER:
            self._xml(start, length - 2)
        self._stream.seek(content + length)

    def _of_stream(self, start: int, tag: int, number: int, length: int) -> None:
        if (tag == _STREAM_HEADER) == (number in self._headers):
            raise self._damaged(start, f"stream {number} has {'two headers' if number in self._headers else 'none'}")
        if tag == _STREAM_HEADER:
            self._headers[number] = self._header(start, number, self._xml(start, length))
            self._samples[number] = 0
        elif tag == _STREAM_FOOTER:
            self._xml(start, length)
        elif tag == _SAMPLES:
            if self._headers[number].item_bytes:
                self._samples[number] += self._count(start, self._headers[number], length)
        elif length == _OFFSET_BYTES:
            self._synchronised.add(number)
        else:
            raise self._damaged(start, f"an offset of the clock of {length} bytes")

    def _count(self, start: int, header: XdfHeader, length: int) -> int:
        """Return the number of samples of a chunk, whose lengths must add up to its own."""
        begin = self._stream.tell()
        count = self._length(start)
        length -= self._stream.tell() - begin
        row = header.count * header.item_bytes
        if 0 <= length == count * (1 + _STAMP_BYTES + row):
            return count
        data = self._bytes(max(length, 0))
        at = 0
        for _ in range(count if count <= length else 0):
            at += 1 + row + (_STAMP_BYTES if at < length and data[at] else 0)
        if at != length or count > length:
            raise self._damaged(start, f"samples of stream {header.number} that do not fill their chunk")
        return count

    def _header(self, start: int, number: int, xml: ElementTree.Element) -> XdfHeader:
        text = {
            key: (xml.findtext(key) or "").strip()
            for key in ("name", "type", "source_id", "channel_count", "channel_format", "nominal_srate")
        }
        kind = text["channel_format"]
        try:
            count, rate = int(text["channel_count"]), float(text["nominal_srate"])
        except ValueError as error:
            raise self._damaged(start, f"stream {number}: {error}") from error
        if not 0 < count <= _MOST_CHANNELS or not 0 <= rate < 1e6 or kind not in (*_ITEM_BYTES, "string"):
            raise self._damaged(start, f"stream {number}: {count} channels of {kind or 'no type'} at {rate:g} Hz")
        channels = xml.findall("desc/channels/channel")
        labels, units, types = (
            tuple((channel.findtext(field) or "").strip() for channel in channels)
            for field in ("label", "unit", "type")
        )
        return XdfHeader(
            number,
            text["name"],
            text["type"],
            text["source_id"],
            count,
            _ITEM_BYTES.get(kind, 0),
            rate,
            labels,
            units,
            types,
        )

    def _xml(self, start: int, length: int) -> ElementTree.Element:
        if length > _LARGEST_XML:
            raise self._damaged(start, f"metadata of {length} bytes")
        text = self._bytes(length).decode("utf-8", errors="replace")
        if "<!" in text.replace("<![CDATA[", "").replace("<!--", ""):
            raise self._damaged(start, "metadata with declarations, which XDF files do not have")
        try:
            return ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError) as error:
            raise self._damaged(start, f"metadata that are no XML ({error})") from error

    def _length(self, start: int) -> int:
        size = self._bytes(1)[0]
        if size not in _LENGTHS:
            raise self._damaged(start, f"a length of {size} bytes")
        (length,) = struct.unpack(_LENGTHS[size], self._bytes(size))
        return int(length)

    def _bytes(self, count: int) -> bytes:
        found = self._stream.read(count)
        if len(found) < count:
            raise _CutError
        return found

    def _damaged(self, start: int, what: str) -> FileFormatError:
        return FileFormatError(self._path, f"damaged at byte {start}: {what}; record or copy it again")


C = TypeVar("C")
TITLE: Final = "XDF"
_JITTER: Final = 0.1  #: [sampling periods] of the stamps, by which lost packets can no longer be counted
_DIFFER: Final = "Segments and clock-segments differ"
"""Remark of pyxdf about every stream whose clock was not measured."""


def is_xdf(head: str) -> bool:
    """Implement `sensors.files.Format.recognise`."""
    return head.startswith(MAGIC.decode())


def read_xdf(path: Path, **declared: Any) -> SensorLog:
    """Implement `sensors.files.Format.read`; a declared `rate_hz` replaces the stamps after the first."""
    Declaration().changed(**declared)
    structure = read_structure(path)

    def understood(header: XdfHeader) -> StreamChannels:
        channels = StreamChannels.of(header.name, _labels(header), header.units, header.types, declared=declared)
        if all(one.quaternions is None and one.gyroscope is None for one in channels.sensors):
            raise InvalidInputError(f"stream {header.name}: no orientation, and no gyroscope to find it by")
        return channels

    found, notes = _understood(path, structure, understood, "of inertial sensors")
    loaded, remarks = _load(path, structure, [header for header, _ in found])
    streams: list[SensorStream] = []
    for (header, channels), (times, values, own) in zip(found, loaded, strict=True):
        notes += channels.notes
        rate_hz = channels.declaration.rate_hz
        if rate_hz is not None:
            times = times[0] + np.arange(len(times)) / rate_hz
        else:
            own += _spacing(times)
        for sensor in channels.sensors:
            try:
                one = sensor.readings(times, values).stream(channels.declaration)
            except InvalidInputError as error:
                raise FileFormatError(path, f"stream {header.name}: {error}") from error
            streams.append(replace(one, notes=tuple(own)))
    declarations = {repr(channels.declaration) for _, channels in found}
    if len(declarations) > 1:
        notes.append(f"streams differ in units or conventions; shown are those of {found[0][0].name}")
    headers = [header for header, channels in found for _ in channels.sensors]
    named = _named(streams, headers, notes)
    return SensorLog(path, TITLE, named, found[0][1].declaration, (*notes, *remarks))


def _named(streams: Sequence[SensorStream], headers: Sequence[XdfHeader], notes: list[str]) -> tuple[SensorStream, ...]:
    """Return the sensors with what tells streams of one name apart in their names."""
    twice = {name for name, number in Counter(one.name for one in streams).items() if number > 1}
    named = []
    for one, header in zip(streams, headers, strict=True):
        ids = [h.source_id for s, h in zip(streams, headers, strict=True) if s.name == one.name]
        by_id = len(set(ids)) == len(ids) and all(ids)
        mark = header.source_id if by_id else f"#{header.number}"
        named.append(replace(one, name=f"{one.name} {mark}") if one.name in twice else one)
    if twice:
        notes.append(f"{', '.join(sorted(twice))}: in several streams, which are told apart in their names")
    return tuple(named)


@dataclass(frozen=True)
class XdfPoints:
    """Detected points of one person, from one stream."""

    stream: str  #: Name of the stream
    times: Array  #: (T,) s, on the clock of the file's sensors
    uv_px: Array  #: (T, L, 2) px; NaN where unseen
    confidence: Array  #: (T, L) in [0, 1]; 0 where unseen
    names: tuple[str, ...]  #: L names
    notes: tuple[str, ...]  #: Remarks, in sentences

    def sequence(self, camera: Camera) -> KeypointSequence:
        """Return the points as keypoints."""
        return KeypointSequence(camera, self.times, self.uv_px, self.confidence, self.names)


def read_xdf_points(path: str | Path, stream: str | None = None) -> XdfPoints:
    """Read the detected points of a file; the stream's name is not needed where only one has points. `FileFormatError`:
    unreadable, damaged, or no stream of points or several.
    """
    path = Path(path)
    structure = read_structure(path)

    def understood(header: XdfHeader) -> PointChannels:
        if stream not in (None, header.name):
            raise InvalidInputError(f"stream {header.name}: not asked for")
        try:
            StreamChannels.of(header.name, _labels(header), header.units, header.types)
        except InvalidInputError:
            return PointChannels.of(header.name, _labels(header), header.units)
        raise InvalidInputError(f"stream {header.name}: of inertial sensors")

    found, notes = _understood(path, structure, understood, "of detected points")
    if len(found) > 1:
        names = ", ".join(header.name for header, _ in found)
        raise FileFormatError(path, f"has {len(found)} streams of points ({names}); name one")
    ((header, channels),) = found
    ((times, values, own),), remarks = _load(path, structure, [header])
    uv, confidence = channels.points(values)
    return XdfPoints(header.name, times, uv, confidence, channels.names, (*own, *notes, *remarks))


def _labels(header: XdfHeader) -> tuple[str, ...]:
    if len(header.labels) != header.count or not all(header.labels):
        named = sum(map(bool, header.labels))
        raise InvalidInputError(f"stream {header.name}: {header.count} channels, and labels of {named}")
    return header.labels


def _understood(
    path: Path, structure: XdfStructure, understood: Callable[[XdfHeader], C], what: str
) -> tuple[list[tuple[XdfHeader, C]], list[str]]:
    """Return the streams of a kind that have samples, and sentences about the others."""
    found, notes, aside = [], [], []
    for header in structure.headers:
        if not header.item_bytes:
            continue
        try:
            channels = understood(header)
        except UnknownNameError:
            raise
        except InvalidInputError as error:
            aside.append(str(error))
            continue
        if structure.samples[header.number]:
            found.append((header, channels))
        else:
            aside.append(f"stream {header.name}: has no samples")
    if not found:
        why = "; ".join(aside) or "no stream of numbers"
        raise FileFormatError(path, f"has no stream {what} ({why[:600]})")
    if structure.cut:
        notes.append(f"its last chunk, from byte {structure.end} on, is incomplete and left out")
    return found, notes + [f"left aside: {one}" for one in aside]


def _load(
    path: Path, structure: XdfStructure, headers: Sequence[XdfHeader]
) -> tuple[list[tuple[Array, Array, list[str]]], tuple[str, ...]]:
    """Return times (T,), values (T, C) and remarks of each stream, and remarks of pyxdf."""
    pyxdf = optional("pyxdf", "live", f"{path}: an XDF file")
    numbers = [header.number for header in headers]
    try:
        with path.open("rb") as stream, _remarks() as remarks, np.errstate(all="ignore"):
            intact = io.BytesIO(stream.read(structure.end)) if structure.cut else stream
            found, _ = pyxdf.load_xdf(intact, numbers, dejitter_timestamps=False)
    except Exception as error:  # pyxdf raises errors of many types
        raise FileFormatError(path, f"damaged ({error}); record or copy it again") from error
    by_number = {one["info"]["stream_id"]: one for one in found}
    loaded = []
    for header in headers:
        one = by_number[header.number]
        times, values = np.asarray(one["time_stamps"], float), np.asarray(one["time_series"], float)
        times, values, own = _ordered(path, header, times, values)
        resets = len(one["info"]["clock_segments"]) - 1
        if resets > 0:
            own.append(f"its sender's clock began anew {resets} times; each part has its own offset")
        if header.number not in structure.synchronised:
            own.append("the file has no offsets of its clock; its stamps are taken as they are")
        loaded.append((times, values, own))
    return loaded, tuple(f"pyxdf: {remark}" for remark in remarks if _DIFFER not in remark)


@contextmanager
def _remarks() -> Iterator[list[str]]:
    """Collect what pyxdf logs or warns of, in place of showing it."""
    remarks: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            remarks.append(record.getMessage())

    log, handler = logging.getLogger("pyxdf"), Collector(logging.WARNING)
    propagate, log.propagate = log.propagate, False
    log.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield remarks
    finally:
        log.removeHandler(handler)
        log.propagate = propagate


def _ordered(path: Path, header: XdfHeader, times: Array, values: Array) -> tuple[Array, Array, list[str]]:
    """Return samples in the order of time, each time once, and sentences about what was changed."""
    if not np.isfinite(times).all():
        i = int(np.flatnonzero(~np.isfinite(times))[0])
        raise FileFormatError(path, f"stream {header.name}: sample {i} has no time")
    order = np.argsort(times, kind="stable")
    late = int(np.sum(np.diff(times) < 0))
    times, values = times[order], values[order]
    new = np.diff(times, prepend=-np.inf) > 0
    notes = [f"{late} samples late, put in their places"] if late else []
    if not new.all():
        notes.append(f"{int(np.sum(~new))} samples at the time of another left out")
    return times[new], values[new], notes


def _spacing(times: Array) -> list[str]:
    """Return sentences about lost packets, or about stamps that jitter."""
    if len(times) < 3:
        return []
    steps = np.diff(times) / np.median(np.diff(times))
    jitter = float(np.median(np.abs(steps - np.round(steps))))
    if jitter < _JITTER:
        return list(lost(times))
    milliseconds = 1e3 * jitter * float(np.median(np.diff(times)))
    return [f"its stamps jitter by {milliseconds:.1f} ms; declare rate_hz if its samples are equally spaced"]
