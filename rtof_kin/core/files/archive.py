"""ZIP archives whose bytes follow from their contents, and safe reading of archives of untrusted origin.

Nothing here loads NumPy, so that an archive may say how many threads its libraries are to have.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.folder import new_file

_UNSUSPICIOUS_BYTES, _LARGEST_RATIO = 256 * 2**20, 100
"""Archives above this size with a higher compression ratio are refused."""
_MOST_MEMBERS: Final = 10_000
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}(/[A-Za-z0-9_][A-Za-z0-9._-]{0,99}){0,7}")
"""Names of members: relative, of plain letters, no part begins with a point."""
_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
_PACKED: Final = (".npz", ".pt")
"""Endings of files that are compressed already, or do not shrink."""
_CHUNK: Final = 2**20


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


def write_archive(
    path: str | Path, members: Mapping[str, Path | bytes], comment: str = "", overwrite: bool = False
) -> None:
    """Write a ZIP archive: the same members give the same bytes, whenever and wherever.

    Args:
        overwrite: replace an existing file.

    Raises:
        OutputExistsError: it exists. WritingError: it cannot be written.
    """
    with new_file(path, overwrite) as whole, zipfile.ZipFile(whole, "w") as archive:
        archive.comment = comment.encode()
        for name, content in members.items():
            info = zipfile.ZipInfo(name, _EPOCH)
            info.create_system, info.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            info.compress_type = zipfile.ZIP_STORED if name.endswith(_PACKED) else zipfile.ZIP_DEFLATED
            archive.writestr(info, content if isinstance(content, bytes) else content.read_bytes())


@contextmanager
def open_archive(path: Path, limit: int) -> Iterator[zipfile.ZipFile]:
    """Open an archive of regular files with plain names inside it; errors of reading it are of the package.

    Args:
        limit: largest total size of the files, bytes.

    Raises:
        FileFormatError: no archive, damaged, too large, or a member that leads out of it, is a link or a
            folder, stands twice, is encrypted or overlaps with another.
    """
    try:
        if not path.is_file():
            raise FileFormatError(path, "there is no such file")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_members(path, members)
            if sum(member.compress_size for member in members) > path.stat().st_size:
                raise FileFormatError(path, "members overlap, which no archive of this package has")
            check_sizes(path, members, limit)
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, f"damaged, or no archive ({error}); ask for the file again") from error


def digest_of(archive: zipfile.ZipFile, name: str, target: Path | None = None) -> str:
    """Return the SHA-256 of a member, and write it to a file if one is named.

    Args:
        archive: of `open_archive`. target: file to write; its folder is made.
    """
    digest = hashlib.sha256()
    if target is not None:
        target.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(name) as member, (target or Path(os.devnull)).open("wb") as stream:
        while chunk := member.read(_CHUNK):
            digest.update(chunk)
            stream.write(chunk)
    return digest.hexdigest()


def _check_members(path: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    seen = set[str]()
    _check_number(path, len(members))
    for member in members:
        name, mode = member.orig_filename, member.external_attr >> 16
        problem = ""
        if not _NAME.fullmatch(name):
            problem = "leads out of the archive, or has a name that no file of this package has"
        elif stat.S_IFMT(mode) not in (0, stat.S_IFREG) or member.is_dir():
            problem = "is no regular file"
        elif name.casefold() in seen:
            problem = "stands in it twice"
        elif member.flag_bits & 1:
            problem = "is encrypted"
        elif member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            problem = "is compressed in an unusual way"
        if problem:
            raise FileFormatError(path, f"member {name[:80]!r} {problem}; not opened")
        seen.add(name.casefold())
