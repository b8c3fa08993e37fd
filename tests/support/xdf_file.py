"""Contents of small XDF files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

_CODES = {"double64": "<f8", "float32": "<f4", "int16": "<i2"}


@dataclass(frozen=True)
class Stream:
    """One stream; an empty list of labels leaves the channels out of the metadata."""

    number: int
    name: str
    labels: Sequence[str]
    times: Any
    """(T,) s of its own clock."""
    values: Any
    """(T, C)"""
    units: Sequence[str] = ()
    type: str = "IMU"
    source_id: str = ""
    rate_hz: float = 60.0
    offsets: Sequence[tuple[float, float]] = field(default_factory=list)
    """Time and offset of each measurement of its clock, s."""
    format: str = "double64"
    stamped: int = 1
    """Every which sample has a stamp; the others follow from the rate."""

    @property
    def header(self) -> bytes:
        rows = "".join(
            f"<channel><label>{escape(label)}</label>"
            f"<unit>{escape(self.units[i]) if self.units else ''}</unit></channel>"
            for i, label in enumerate(self.labels)
        )
        return (
            f'<?xml version="1.0"?><info><name>{escape(self.name)}</name><type>{self.type}</type>'
            f"<channel_count>{np.shape(self.values)[1]}</channel_count>"
            f"<nominal_srate>{self.rate_hz:g}</nominal_srate><channel_format>{self.format}</channel_format>"
            f"<source_id>{self.source_id}</source_id><desc><channels>{rows}</channels></desc></info>"
        ).encode()

    def samples(self, first: int, last: int) -> bytes:
        rows = []
        for i in range(first, last):
            stamp = b"\x08" + struct.pack("<d", self.times[i]) if i % self.stamped == 0 else b"\0"
            rows.append(stamp + np.asarray(self.values[i], dtype=_CODES[self.format]).tobytes())
        return length(last - first) + b"".join(rows)


def length(count: int) -> bytes:
    """A number with the number of its bytes before it."""
    return b"\x01" + struct.pack("<B", count) if count < 256 else b"\x04" + struct.pack("<I", count)


def chunk(tag: int, content: bytes, number: int | None = None) -> bytes:
    stream = b"" if number is None else struct.pack("<I", number)
    return length(2 + len(stream) + len(content)) + struct.pack("<H", tag) + stream + content


def content(*streams: Stream, in_chunk: int = 16) -> bytes:
    """A file as LabRecorder writes it: headers, samples of the streams by turns, offsets, footers."""
    parts = [b"XDF:", chunk(1, b"<info><version>1.0</version></info>")]
    parts += [chunk(2, one.header, one.number) for one in streams]
    for first in range(0, max(len(one.times) for one in streams), in_chunk):
        for one in streams:
            last = min(first + in_chunk, len(one.times))
            if first < last:
                parts.append(chunk(3, one.samples(first, last), one.number))
        parts.append(chunk(5, bytes.fromhex("43A546DCCBF5410FB30ED5467383CBE4")))
    for one in streams:
        parts += [chunk(4, struct.pack("<dd", *offset), one.number) for offset in one.offsets]
        footer = f"<info><sample_count>{len(one.times)}</sample_count></info>".encode()
        parts.append(chunk(6, footer, one.number))
    return b"".join(parts)
