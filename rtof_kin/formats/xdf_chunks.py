"""Structure of XDF files: the streams they declare, and where their intact chunks end.

A file is ``XDF:`` and chunks of a length, a tag and content (https://github.com/sccn/xdf/wiki/Specifications). Every
length is checked against the others before anything is decoded, so that a damaged file is an error and neither fills
the memory nor gives wrong numbers. Recorders that crash leave the last chunk incomplete; what precedes it is intact.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final
from xml.etree import ElementTree

from rtof_kin.core.errors import FileFormatError

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

    number: int
    """Of the stream, in the file."""
    name: str
    type: str
    source_id: str
    count: int
    """Number of channels."""
    item_bytes: int
    """Of one number; 0 for text."""
    rate_hz: float
    """Nominal sampling rate, Hz; 0 where irregular."""
    labels: tuple[str, ...]
    """Of the channels; fewer where the metadata lacks them."""
    units: tuple[str, ...]
    types: tuple[str, ...]


@dataclass(frozen=True)
class XdfStructure:
    """Streams of a file and its intact part."""

    headers: tuple[XdfHeader, ...]
    samples: Mapping[int, int]
    """Number of samples of each stream."""
    synchronised: frozenset[int]
    """Streams with measured offsets of their clock."""
    end: int
    """Byte where the intact chunks end."""
    cut: bool
    """Whether bytes follow there, of a chunk that is incomplete."""


class _CutError(Exception):
    """The file ends within a chunk."""


def read_structure(path: Path) -> XdfStructure:
    """Return the streams of a file, all of whose intact chunks fit together.

    Raises:
        FileFormatError: no XDF file, or damaged; names the byte.
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
