"""Checks of archives of arrays of untrusted origin, before one is read."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError

_UNSUSPICIOUS_BYTES, _LARGEST_RATIO = 256 * 2**20, 100
"""Archives above this size with a higher compression ratio are refused."""
_MOST_MEMBERS: Final = 10_000


def check_sizes(path: Path, members: Sequence[zipfile.ZipInfo], limit: float) -> None:
    """Check that an archive does not exhaust the memory.

    Args:
        limit: of their sizes, bytes.

    Raises:
        FileFormatError: it is too large, or large and compressed beyond any recording.
    """
    full = sum(member.file_size for member in members)
    if full > limit:
        raise FileFormatError(path, f"would fill more than {limit / 2**20:.0f} MiB of memory")
    check_ratio(path, full, sum(member.compress_size for member in members))


def check_ratio(path: Path, full: int, packed: int) -> None:
    """Raise `FileFormatError` for what is large and compressed beyond any recording.

    Args:
        full, packed: bytes of memory and of the file.
    """
    if full > _UNSUSPICIOUS_BYTES and full > _LARGEST_RATIO * packed:
        raise FileFormatError(path, f"unpacks to {full} bytes from {packed}, which no recording does; not opened")


def array_members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an archive of arrays by the name of the array.

    Raises:
        FileFormatError: an array twice, of which readers differ in the one they take; or too many.
    """
    members = archive.infolist()
    _check_number(path, len(members))
    found = {member.filename.removesuffix(".npy"): member for member in members}
    if len(found) < len(members):
        names = Counter(member.filename.removesuffix(".npy") for member in members)
        raise FileFormatError(path, f"array {names.most_common(1)[0][0][:80]!r} stands in it twice; not opened")
    return found


def _check_number(path: Path, number: int) -> None:
    if number > _MOST_MEMBERS:
        raise FileFormatError(path, f"{number} members; no archive of this package has so many")
