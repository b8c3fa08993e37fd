"""`NpzBlocks`: rows of the arrays of an .npz file, without unpacking the file into memory or onto the disk.

A member of the archive is one deflate stream, which can only be read from its start. One pass over the file,
in the background, keeps a copy of the decompressor every few megabytes. Rows that were passed are read from
the copy before them.
"""

from __future__ import annotations

import math
import struct
import threading
import zipfile
import zlib
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.archive import array_members
from rtof_kin.core.files.arrays import read_npy_header
from rtof_kin.core.files.text import LARGEST_NUMBER, check_file, measurable

_LARGEST_MEMBER: Final = 512 * 2**20
"""[bytes] of an array that is read as a whole."""
_SPACING: Final = 3 * 2**20
"""[bytes] Default distance of two copies of a decompressor, each of 40 kB."""
_ROWS: Final = 256
"""Rows that a pass reads at once."""
_CHUNK: Final = 1 << 16
"""[bytes] read from the file at once."""
_LOCAL_HEADER: Final = 30
"""[bytes] of a member's header in the file before its name."""


class _File:
    """An open file that several threads read; one that replaces it meanwhile is not seen."""

    def __init__(self, path: Path):
        self.stream: BinaryIO = path.open("rb")
        self._lock = threading.Lock()

    def read(self, place: int, count: int) -> bytes:
        """Return bytes from a place in the file; fewer at its end."""
        with self._lock:
            self.stream.seek(place)
            return self.stream.read(count)


@dataclass
class _Reader:
    """Decompresses one member from some place on."""

    file: _File
    place: int
    """[bytes] in the file of the next compressed byte."""
    end: int
    """[bytes] in the file of the end of the member."""
    inflate: Any
    """Decompressor of zlib; None for a member that is not compressed."""
    pending: bytes = b""
    """Compressed bytes that were read but not used."""

    def copy(self) -> _Reader:
        """Return a reader that goes on from here independently; it holds no bytes of the file."""
        inflate = None if self.inflate is None else self.inflate.copy()
        return _Reader(self.file, self.place - len(self.pending), self.end, inflate)

    def read(self, count: int, skip: int = 0) -> bytes:
        """Return the next bytes after skipping some; fewer at the end."""
        parts: list[bytes] = []
        left, drop = count + skip, skip
        while left > 0:
            part = self._next(left)
            if not part:
                break
            left -= len(part)
            parts.append(part[drop:])
            drop = max(drop - len(part), 0)
        return b"".join(parts)

    def _next(self, most: int) -> bytes:
        """Return up to so many bytes; none at the end."""
        while True:
            if not self.pending:
                self.pending = self.file.read(self.place, min(_CHUNK, self.end - self.place))
                self.place += len(self.pending)
            if self.inflate is None:
                part, self.pending = self.pending[:most], self.pending[most:]
                return part
            before = len(self.pending)
            part = self.inflate.decompress(self.pending, most)
            self.pending = self.inflate.unconsumed_tail
            if part or self.inflate.eof or not before:
                return bytes(part)


@dataclass
class _Member:
    """One array of the file."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    crc: int
    """Checksum of the member in the archive."""
    reader: _Reader
    """At the next row of the pass."""
    checksum: int = 0
    """Of what the pass has read."""
    copies: list[tuple[int, _Reader]] = field(default_factory=list)
    """Rows and the readers that begin at them, in order."""
    last: tuple[int, _Reader] | None = None
    """Row after those that were read last, and the reader that goes on there."""
    whole: NDArray[Any] | None = None
    """All rows, of an array whose rows are not together in the file (Fortran order)."""

    @property
    def row_bytes(self) -> int:
        """Size of one row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize


class NpzBlocks:
    """Arrays of one length whose rows become readable while `scan` passes over the file.

    Attributes:
        path: the file. length: rows of the arrays, e.g. frames.
    """

    def __init__(self, path: Path, members: Sequence[str], spacing: int = _SPACING):
        """Find the arrays in the file; nothing of them is read.

        Args:
            members: names of arrays with one row per frame; missing ones are left out.
            spacing: distance of the places from which rows are read, bytes of an array.

        Raises:
            FileFormatError: no such file, not an archive, or arrays of another kind or of different lengths.
        """
        self.path, self._spacing = path, spacing
        self._lock, self._pass = threading.Lock(), threading.Lock()
        self._done = 0
        check_file(path, "an NPZ archive")
        self._file = _File(path)
        with ExitStack() as failed:
            failed.callback(self.close)
            self._members = self._found(members)
            lengths = {member.shape[0] for member in self._members.values()}
            if len(lengths) != 1:
                raise FileFormatError(path, f"arrays of different lengths {sorted(lengths)}, not one per frame")
            self.length = lengths.pop()
            failed.pop_all()

    def __contains__(self, name: str) -> bool:
        return name in self._members

    @property
    def available(self) -> int:
        """Number of rows, from the first, that can be read."""
        return self._done

    def scan(self, stop: threading.Event | None = None, until: int | None = None) -> None:
        """Pass over the file, on from where the last pass ended, so that rows become readable; may be called
        in a thread.

        Args:
            until: number of rows that are wanted; default: all.

        Raises:
            FileFormatError: the file is damaged.
        """
        wanted = self.length if until is None else min(until, self.length)
        while self._done < wanted and not (stop is not None and stop.is_set()):
            with self._pass:
                self._step()

    def _step(self) -> None:
        """Pass over the next rows; at the end compare the checksums."""
        count = min(_ROWS, self.length - self._done)
        streamed = [member for member in self._members.values() if member.whole is None]
        for member in streamed:
            if self._far(member):
                copy = member.reader.copy()
                with self._lock:
                    member.copies.append((self._done, copy))
            data = self._read(member, member.reader, count)
            member.checksum = zlib.crc32(data, member.checksum)
        if self._done + count == self.length:
            for member in streamed:
                if member.checksum != member.crc:
                    raise FileFormatError(self.path, f"{member.name}: damaged (checksum); reconstruct again")
        self._done += count

    def rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return rows of an array.

        Args:
            start, stop: rows, within `available`.

        Raises:
            FileFormatError: damaged, or a number beyond any measurement.
        """
        member = self._members[name]
        if not 0 <= start <= stop <= self._done:
            raise IndexError(f"rows {start} to {stop} of {self._done} that are readable")
        array = self._slice(member, start, stop) if member.whole is None else member.whole[start:stop]
        if member.dtype.kind == "f" and not measurable(array):
            raise FileFormatError(self.path, f"{name}: holds a number beyond {LARGEST_NUMBER:g}")
        return array

    def _slice(self, member: _Member, start: int, stop: int) -> NDArray[Any]:
        with self._lock:
            first, reader = member.copies[bisect_right(member.copies, start, key=itemgetter(0)) - 1]
            last, member.last = member.last, None
            first, reader = last if last and first <= last[0] <= start else (first, reader.copy())
        data = self._read(member, reader, stop - start, skip=start - first)
        member.last = (stop, reader)
        return np.frombuffer(data, member.dtype).reshape(stop - start, *member.shape[1:])

    def _far(self, member: _Member) -> bool:
        """Return whether the last copy of a decompressor is so far back that one more is worth its memory."""
        if not member.copies:
            return True
        return (self._done - member.copies[-1][0]) * member.row_bytes >= self._spacing

    def whole(self, name: str) -> NDArray[Any]:
        """Return a whole array at once, also before `scan`.

        Args:
            name: of an array of at most 512 MiB.

        Raises:
            FileFormatError: it is damaged or larger.
        """
        return self._unpacked(self._members[name])

    def _unpacked(self, member: _Member) -> NDArray[Any]:
        if member.row_bytes * member.shape[0] > _LARGEST_MEMBER:
            raise FileFormatError(self.path, f"{member.name}: larger than {_LARGEST_MEMBER / 2**20:.0f} MiB")
        if member.whole is not None:
            return member.whole
        _, reader = member.copies[0] if member.copies else (0, member.reader)
        data = self._read(member, reader.copy(), member.shape[0])
        return np.frombuffer(data, member.dtype).reshape(member.shape)

    def _read(self, member: _Member, reader: _Reader, count: int, skip: int = 0) -> bytes:
        size = member.row_bytes
        try:
            data = reader.read(count * size, skip * size)
        except (zlib.error, OSError) as error:
            raise FileFormatError(self.path, f"{member.name}: damaged ({error})") from error
        if len(data) != count * size:
            raise FileFormatError(self.path, f"{member.name}: damaged, its end is missing")
        return data

    def close(self) -> None:
        """Close the file."""
        self._file.stream.close()

    def _found(self, names: Sequence[str]) -> dict[str, _Member]:
        """Return the members of the archive that are wanted and there."""
        try:
            with zipfile.ZipFile(self._file.stream) as archive:
                there = array_members(self.path, archive)
                found = {name: self._member(archive, name, there[name]) for name in names if name in there}
        except FileFormatError:
            raise
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError, struct.error) as error:
            raise FileFormatError(self.path, f"damaged, or no NPZ archive ({error}); reconstruct again") from error
        if not found:
            raise FileFormatError(self.path, f"has none of the arrays {', '.join(names)}")
        return found

    def _member(self, archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> _Member:
        if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileFormatError(self.path, f"{name}: compressed in another way; reconstruct again")
        try:
            with archive.open(info) as stream:
                shape, fortran, dtype = read_npy_header(stream)
                header = stream.tell()
        except ValueError as error:
            raise FileFormatError(self.path, f"{name}: not a NumPy array ({error})") from error
        if dtype.hasobject or dtype.kind not in "fiub" or not shape:
            raise FileFormatError(self.path, f"{name}: no table of numbers by frames; reconstruct again")
        if min(shape) < 0 or math.prod(shape) * dtype.itemsize != info.file_size - header:
            raise FileFormatError(self.path, f"{name}: shape {shape} is not that of its bytes")
        start = self._data_start(info)
        inflate = zlib.decompressobj(-zlib.MAX_WBITS) if info.compress_type == zipfile.ZIP_DEFLATED else None
        reader = _Reader(self._file, start, start + info.compress_size, inflate)
        head = reader.read(header)
        member = _Member(name, shape, dtype, info.CRC, reader, zlib.crc32(head))
        if fortran and len(shape) > 1:
            member.whole = self._unpacked(member).reshape(-1).reshape(shape, order="F")
        return member

    def _data_start(self, info: zipfile.ZipInfo) -> int:
        """Return the place of a member's first compressed byte."""
        head = self._file.read(info.header_offset, _LOCAL_HEADER)
        if len(head) != _LOCAL_HEADER or head[:4] != b"PK\x03\x04":
            raise FileFormatError(self.path, f"{info.filename}: damaged, its header is missing")
        names = sum(int.from_bytes(head[i : i + 2], "little") for i in (26, 28))
        return info.header_offset + _LOCAL_HEADER + names
