"""XDF files, as LabRecorder writes them: streams of the Lab Streaming Layer on one clock.

Inertial sensors are the streams whose channels are labelled as in `channels`; detected points those with
``<landmark>_x``, ``_y``, ``_confidence`` in px. Other streams are left aside. Times are the stamps, mapped to
the recorder's clock by the offsets in the file. They are not made equally spaced: where packets are lost that
would shift the others by some of them. A declared rate does it, for senders whose stamps jitter.

The library pyxdf reads them. Recorders that crash leave the last chunk incomplete, of which it would make a sample of
what is there, and it goes on after damage with a remark: chunks are counted before, and a remark of damage is an error.
"""

from __future__ import annotations

import io
import logging
import struct
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar
from xml.etree import ElementTree

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError, reading
from rtof_kin.core.files.text import opening
from rtof_kin.core.packages import optional
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.formats.channels import PointChannels, StreamChannels
from rtof_kin.formats.sensors.readings import lost

MAGIC: Final = b"XDF:"
_FILE_HEADER, _STREAM_HEADER, _SAMPLES, _CLOCK_OFFSET, _STREAM_FOOTER = 1, 2, 3, 4, 6
_LENGTHS: Final = {1: "<B", 4: "<I", 8: "<Q"}
_MOST_CHANNELS: Final = 2**14


@dataclass(frozen=True)
class _Header:
    """What one stream declares."""

    number: int  # of the stream, in the file
    name: str
    source_id: str
    count: int  # of channels
    row_bytes: int  # of the numbers of one sample
    labels: tuple[str, ...]  # of the channels; fewer where the metadata lacks them
    units: tuple[str, ...]
    types: tuple[str, ...]


@dataclass(frozen=True)
class _Structure:
    """Streams of numbers in a file and its intact part."""

    headers: tuple[_Header, ...]
    filled: frozenset[int]  # streams with samples
    synchronised: frozenset[int]  # streams with measured offsets of their clock
    end: int  # byte where the intact chunks end
    cut: bool  # whether bytes follow there, of a chunk that is incomplete


def _read_structure(path: Path) -> _Structure:
    """Walk through a file's chunks: a length, a tag and content (https://github.com/sccn/xdf/wiki/Specifications)."""
    headers, filled, synchronised, end = dict[int, _Header](), set[int](), set[int](), len(MAGIC)
    with opening(path), path.open("rb") as stream:
        try:
            size = path.stat().st_size
            if stream.read(end) != MAGIC:
                raise FileFormatError(path, "does not begin with 'XDF:'")
            while head := stream.read(1):
                of_length = _LENGTHS[head[0]]
                length = stream.read(head[0])
                if len(length) < head[0]:
                    break
                after = stream.tell() + struct.unpack(of_length, length)[0]
                if after > size:
                    break
                content = stream.read(after - stream.tell())
                tag, number = struct.unpack("<HI", content[:6].ljust(6, b"\0"))
                _check_metadata(tag, content)
                if tag == _STREAM_HEADER and (header := _header(number, content[6:])):
                    headers[number] = header
                elif tag == _SAMPLES and number in headers:
                    filled.add(number)
                    if not _fits(content[6:], headers[number].row_bytes):
                        raise ValueError(f"samples of stream {number} that do not fill their chunk")
                elif tag == _CLOCK_OFFSET:
                    synchronised.add(number)
                end = after
        except (LookupError, ValueError, ElementTree.ParseError) as error:
            raise FileFormatError(path, f"damaged at byte {end} ({error}); record or copy it again") from error
    return _Structure(tuple(headers.values()), frozenset(filled), frozenset(synchronised), end, end < size)


def _check_metadata(tag: int, content: bytes) -> None:
    """Refuse XML with declarations, whose entities could fill the memory."""
    xml = tag in (_FILE_HEADER, _STREAM_HEADER, _STREAM_FOOTER)
    if xml and b"<!" in content.replace(b"<![CDATA[", b"").replace(b"<!--", b""):
        raise ValueError("metadata with declarations, which XDF files do not have")


def _header(number: int, content: bytes) -> _Header | None:
    """Return what a stream of numbers declares; None of one of texts."""
    xml = ElementTree.fromstring(content.decode("utf-8", errors="replace"))
    name, source_id, kind, count = (
        (xml.findtext(key) or "").strip() for key in ("name", "source_id", "channel_format", "channel_count")
    )
    if kind == "string":
        return None
    if not 0 < int(count) <= _MOST_CHANNELS:
        raise ValueError(f"stream {number}: {count} channels")
    channels = xml.findall("desc/channels/channel")
    fields = [tuple((one.findtext(field) or "").strip() for one in channels) for field in ("label", "unit", "type")]
    item_bytes = int(kind.lstrip("abcdefghijklmnopqrstuvwxyz")) // 8  # of double64, int16, ...
    return _Header(number, name, source_id, int(count), int(count) * item_bytes, *fields)


def _fits(content: bytes, row_bytes: int) -> bool:
    """Return whether the samples of a chunk, each with a stamp of 8 bytes or with none, fill it: else pyxdf would go on
    in another place.
    """
    at = 1 + content[0]
    count = int.from_bytes(content[1:at], "little")
    if len(content) == at + count * (9 + row_bytes):
        return True
    for _ in range(min(count, len(content))):
        at += 1 + row_bytes + (8 if at < len(content) and content[at] else 0)
    return at == len(content)


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
    structure = _read_structure(path)

    def understood(header: _Header) -> StreamChannels:
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
            with reading(path, f"stream {header.name}: {{}}"):
                one = sensor.readings(times, values).stream(channels.declaration)
            streams.append(replace(one, notes=tuple(own)))
    declarations = {repr(channels.declaration) for _, channels in found}
    if len(declarations) > 1:
        notes.append(f"streams differ in units or conventions; shown are those of {found[0][0].name}")
    headers = [header for header, channels in found for _ in channels.sensors]
    named = _named(streams, headers, notes)
    return SensorLog(path, TITLE, named, found[0][1].declaration, (*notes, *remarks))


def _named(streams: Sequence[SensorStream], headers: Sequence[_Header], notes: list[str]) -> tuple[SensorStream, ...]:
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


class XdfPoints(NamedTuple):
    """Detected points of one person, from one stream."""

    times: Array  #: (T,) s, on the clock of the file's sensors
    uv_px: Array  #: (T, L, 2) px; NaN where unseen
    confidence: Array  #: (T, L) in [0, 1]; 0 where unseen
    names: tuple[str, ...]  #: L names


def read_xdf_points(path: str | Path) -> XdfPoints:
    """Read the detected points of a file; `FileFormatError`: unreadable, damaged, or no stream of points or several."""
    path = Path(path)
    structure = _read_structure(path)

    def understood(header: _Header) -> PointChannels:
        try:
            StreamChannels.of(header.name, _labels(header), header.units, header.types)
        except InvalidInputError:
            return PointChannels.of(header.name, _labels(header), header.units)
        raise InvalidInputError(f"stream {header.name}: of inertial sensors")

    found, _ = _understood(path, structure, understood, "of detected points")
    if len(found) > 1:
        names = ", ".join(header.name for header, _ in found)
        raise FileFormatError(path, f"has {len(found)} streams of points ({names}); keep one in a file")
    ((header, channels),) = found
    ((times, values, _),), _ = _load(path, structure, [header])
    return XdfPoints(times, *channels.points(values), channels.names)


def _labels(header: _Header) -> tuple[str, ...]:
    if len(header.labels) != header.count or not all(header.labels):
        named = sum(map(bool, header.labels))
        raise InvalidInputError(f"stream {header.name}: {header.count} channels, and labels of {named}")
    return header.labels


def _understood(
    path: Path, structure: _Structure, understood: Callable[[_Header], C], what: str
) -> tuple[list[tuple[_Header, C]], list[str]]:
    """Return the streams of a kind that have samples, and sentences about the others."""
    found, notes, aside = [], [], []
    for header in structure.headers:
        try:
            channels = understood(header)
        except UnknownNameError:
            raise
        except InvalidInputError as error:
            aside.append(str(error))
            continue
        if header.number in structure.filled:
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
    path: Path, structure: _Structure, headers: Sequence[_Header]
) -> tuple[list[tuple[Array, Array, list[str]]], tuple[str, ...]]:
    """Return times (T,), values (T, C) and remarks of each stream, and remarks of pyxdf."""
    pyxdf = optional("pyxdf", "live", f"{path}: an XDF file")
    numbers, log, collector = [header.number for header in headers], logging.getLogger("pyxdf"), _Collector()
    propagate, log.propagate = log.propagate, False
    log.addHandler(collector)
    try:
        with path.open("rb") as stream, warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
            intact = io.BytesIO(stream.read(structure.end)) if structure.cut else stream
            found, _ = pyxdf.load_xdf(intact, numbers, dejitter_timestamps=False)
    except Exception as error:  # pyxdf raises errors of many types
        raise FileFormatError(path, f"damaged ({error}); record or copy it again") from error
    finally:
        log.removeHandler(collector)
        log.propagate = propagate
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
    return loaded, tuple(f"pyxdf: {remark}" for remark in collector.remarks if _DIFFER not in remark)


class _Collector(logging.Handler):
    """Collects what pyxdf remarks in place of showing it; a remark of damage is an error."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.remarks: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            raise ValueError(record.getMessage())
        self.remarks.append(record.getMessage())


def _ordered(path: Path, header: _Header, times: Array, values: Array) -> tuple[Array, Array, list[str]]:
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
