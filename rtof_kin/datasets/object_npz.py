"""Dictionaries of arrays that others saved in an .npz file, read without trusting it.

NumPy saves what is no array of numbers as a pickle. `rtof_kin.datasets.pickled` reads it as data: nothing is
ever unpickled.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import LARGEST_BYTES, check_sizes, read_npy_header
from rtof_kin.core.files.text import check_file
from rtof_kin.datasets.pickled import RefusedError, numbers, read_pickle

LARGEST_RATIO = 1000
"""A member that grows more than this when it is unpacked is refused."""


def read_object_npz(path: str | Path, wanted: Sequence[str], limit: int = LARGEST_BYTES) -> dict[str, Any]:
    """Members of an .npz file whose objects are data; nothing in the file is ever executed.

    Args:
        wanted: names of the members to read; others are not looked at.
        limit: largest sum of their sizes, bytes.

    Returns:
        By name: a numeric array where that was saved, else (a 0-d array of one object) the object, made
        of dict with text keys, list, tuple, str, int, float, bool, None and read-only numeric arrays.

    Raises:
        FileFormatError: no such file or member, damaged, too large, or a pickle that names or does
            anything else; the message says what it wanted to run.
    """
    path = Path(path)
    try:
        check_file(path, "an NPZ archive")
        with zipfile.ZipFile(path) as archive:
            members = _members(path, archive, wanted, limit)
            found: dict[str, Any] = {}
            for name, member in members.items():
                with archive.open(member) as stream:
                    found[name] = _read_member(path, name, stream, member.file_size)
            return found
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, MemoryError) as error:
        raise FileFormatError(path, f"damaged, or no NPZ archive ({error}); get it again") from error


def _members(
    path: Path, archive: zipfile.ZipFile, wanted: Sequence[str], limit: int
) -> dict[str, zipfile.ZipInfo]:
    """The directory's entries of those wanted, whose sizes are believable."""
    there = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    for name in wanted:
        if name not in there:
            raise FileFormatError(path, f"no member {name!r}; there is {', '.join(there) or 'none'}")
        member = there[name]
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileFormatError(path, f"{name}: packed in a way that NumPy never uses")
        if member.file_size > LARGEST_RATIO * max(member.compress_size, 1):
            raise FileFormatError(
                path, f"{name}: unpacks to {member.file_size} bytes from {member.compress_size}, as no "
                "recording of anything does; not opened"
            )  # fmt: skip
    check_sizes(path, [there[name] for name in wanted], limit)
    return {name: there[name] for name in wanted}


def _read_member(path: Path, name: str, stream: IO[bytes], size: int) -> Any:
    """One array: its header, then numbers or a pickle."""
    try:
        shape, fortran, dtype = read_npy_header(stream)
        if not dtype.hasobject:
            return numbers(shape, dtype, fortran, stream.read())
        if dtype != np.dtype(object) or shape != ():
            raise RefusedError(f"an array of objects of shape {shape}; expected a single object")
        value = read_pickle(stream, size)
        if stream.read(1):
            raise RefusedError("something follows the end of the pickle")
        return value
    except RefusedError as error:
        raise FileFormatError(path, f"{name}: not opened: {error}") from error
    except (ValueError, LookupError, TypeError, OverflowError, SyntaxError, RecursionError) as error:
        why = f"{type(error).__name__}: {str(error)[:200]}"
        raise FileFormatError(path, f"{name}: damaged, or no array ({why}); get it again") from error
