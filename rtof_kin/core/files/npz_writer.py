"""`NpzWriter`: arrays of an .npz file, written row by row in little memory.

The rows of each array go through their own deflate stream to a scratch file beside the target. At the end the
header of the array, which has its length, is put before them, and all are joined to one archive. The bytes of
the file depend on the arrays alone, not on the blocks that they were appended in.
"""

from __future__ import annotations

import io
import shutil
import struct
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_file

_ZEROS: Final = bytes(1 << 20)
_PIECE: Final = 1 << 20
"""[bytes] of an array that are compressed at once."""
_VERSION: Final = 45
"""Of ZIP64."""
_DEFLATE: Final = 8
_DATE: Final = 0x21
"""1 January 1980."""
_IN_ZIP64: Final = 0xFFFFFFFF


@dataclass
class _Member:
    """One array and the scratch file of its rows."""

    dtype: np.dtype[Any]
    row: tuple[int, ...]
    """Shape of a row."""
    stream: BinaryIO
    deflate: Any
    length: int = 0
    """Rows so far."""
    whole: bool = False
    """True for an array that was given at once: `row` is its shape."""
    checksum: int = 0
    size: int = 0
    """[bytes] of the rows."""
    packed: int = 0
    """[bytes] in the scratch file."""

    def write(self, rows: NDArray[Any]) -> None:
        data = np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
        for place in range(0, len(data), _PIECE):
            piece = data[place : place + _PIECE]
            self.checksum = zlib.crc32(piece, self.checksum)
            self.packed += self.stream.write(self.deflate.compress(piece))
        self.size += len(data)

    def header(self) -> bytes:
        """Return the header of the .npy format for all rows."""
        shape = self.row if self.whole else (self.length, *self.row)
        buffer = io.BytesIO()
        about = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(buffer, about)
        return buffer.getvalue()


class NpzWriter:
    """An .npz file that appears complete at the end of the context, or not at all."""

    def __init__(self, path: Path, overwrite: bool = True):
        """Write nothing yet.

        Args:
            overwrite: replace an existing file.
        """
        self._path, self._overwrite = path, overwrite
        self._members: dict[str, _Member] = {}
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Open the scratch files' folder.

        Raises:
            OutputExistsError: the file exists. WritingError: it cannot be written.
        """
        self._target = self._open.enter_context(new_file(self._path, self._overwrite))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            return self._open.__exit__(kind, error, trace)
        with self._open:  # to which an error is one of writing the file
            self._join()
        return None

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def append(self, rows: Mapping[str, NDArray[Any]]) -> None:
        """Append rows to arrays, each of which may have another number of them.

        Args:
            rows: (n, ...) by the array's name; type and shape of a row are always the same.

        Raises:
            InvalidInputError: another type or shape than before. OSError: the disk is full; it becomes a
                `WritingError` at the end of the context.
        """
        for name, array in rows.items():
            if name not in self._members:
                self._members[name] = self._member(array.dtype, array.shape[1:])
            member = self._members[name]
            if member.whole or (array.dtype, array.shape[1:]) != (member.dtype, member.row):
                raise InvalidInputError(
                    f"{self._path}: rows {array.shape[1:]} of {array.dtype} do not continue {name}, which "
                    f"has {member.row} of {member.dtype}"
                )
            member.write(array)
            member.length += len(array)

    def add(self, name: str, array: NDArray[Any]) -> None:
        """Write a whole array, of any shape.

        Args:
            name: that does not exist.

        Raises:
            InvalidInputError: the name exists. OSError: see `append`.
        """
        if name in self._members:
            raise InvalidInputError(f"{self._path}: {name} was already written")
        self._members[name] = member = self._member(array.dtype, array.shape)
        member.whole = True
        member.write(array)

    def _member(self, dtype: np.dtype[Any], row: tuple[int, ...]) -> _Member:
        if dtype.hasobject:
            raise InvalidInputError(f"{self._path}: objects are not written")
        scratch = self._target.with_name(f"{self._target.name}.{len(self._members)}")
        stream = self._open.enter_context(scratch.open("w+b"))
        return _Member(dtype, row, stream, zlib.compressobj(wbits=-zlib.MAX_WBITS))

    def _join(self) -> None:
        """Put the scratch files together to one archive."""
        directory = []
        with self._target.open("wb") as archive:
            for name, member in self._members.items():
                directory.append(_put(archive, f"{name}.npy".encode(), member))
            start = archive.tell()
            archive.write(b"".join(directory))
            _end(archive, start, len(directory))


def _put(archive: BinaryIO, name: bytes, member: _Member) -> bytes:
    """Append an array to the archive and return its entry in the directory."""
    header = member.header()
    deflate = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    head = deflate.compress(header) + deflate.flush(zlib.Z_FULL_FLUSH)  # ends at a byte; the rows continue
    member.packed += member.stream.write(member.deflate.flush())
    crc = _joined_checksum(zlib.crc32(header), member.checksum, member.size)
    sizes = struct.pack("<QQ", len(header) + member.size, len(head) + member.packed)
    place = archive.tell()
    common = struct.pack("<HHHHHIIIH", _VERSION, 0, _DEFLATE, 0, _DATE, crc, _IN_ZIP64, _IN_ZIP64, len(name))
    archive.write(b"PK\3\4" + common + struct.pack("<H", 20) + name + struct.pack("<HH", 1, 16) + sizes)
    archive.write(head)
    member.stream.seek(0)
    shutil.copyfileobj(member.stream, archive, _PIECE)
    extra = struct.pack("<HH", 1, 24) + sizes + struct.pack("<Q", place)
    rest = struct.pack("<HHHHII", len(extra), 0, 0, 0, 0, _IN_ZIP64)
    return b"PK\1\2" + struct.pack("<H", _VERSION) + common + rest + name + extra


def _end(archive: BinaryIO, start: int, count: int) -> None:
    """Write the end of an archive: its directory's place in the form of ZIP64, and the older form."""
    place = archive.tell()
    size = place - start
    archive.write(b"PK\6\6" + struct.pack("<QHHIIQQQQ", 44, _VERSION, _VERSION, 0, 0, count, count, size, start))
    archive.write(b"PK\6\7" + struct.pack("<IQI", 0, place, 1))
    archive.write(b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 0xFFFF, 0xFFFF, _IN_ZIP64, _IN_ZIP64, 0))


def _joined_checksum(first: int, second: int, length: int) -> int:
    """Return the CRC-32 of two parts together; it is linear in the bits of parts of one length.

    Args:
        length: of the second, bytes.
    """
    none = 0
    for place in range(0, length, len(_ZEROS)):
        zeros = memoryview(_ZEROS)[: length - place]
        first, none = zlib.crc32(zeros, first), zlib.crc32(zeros, none)
    return first ^ none ^ second
