"""What this package wrote into a folder, kept in the folder itself: so much of it may be replaced.

``.rtof_kin.json`` names the folder's kind and has the SHA-256 of every file. What is not in that list,
what was changed since, links, and everything in a folder without a list are the user's.
"""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

MANIFEST = ".rtof_kin.json"


@dataclass(frozen=True)
class Contents:
    """What is in a folder, by who it belongs to."""

    kind: str
    """The file that tells the kind of folder this package wrote; '' where it wrote none."""
    own: tuple[Path, ...]
    """Files and folders as this package wrote them, a folder after what is in it; not the list itself."""
    foreign: tuple[str, ...]
    """Names of all others, those of folders with a '/'."""


def write_manifest(folder: Path, kind: str) -> None:
    """List all files of a folder that this package alone has written to, once they are on the disk.

    Args:
        kind: name of a file that every folder of this kind holds.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        sync(path)
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = _digest(path)
    partial = folder / f"{MANIFEST}.part"
    partial.write_text(json.dumps({"kind": kind, "sha256": files}, indent=1) + "\n", encoding="utf-8")
    sync(partial)
    partial.replace(folder / MANIFEST)
    sync(folder)


def read_contents(folder: Path) -> Contents:
    """Compare a folder with its list; links are not followed.

    Raises:
        OSError: something in it cannot be read.
    """
    kind, files = _read_manifest(folder / MANIFEST)
    folders = {str(parent) for name in files for parent in Path(name).parents}
    own: list[Path] = []
    foreign: list[str] = []
    for place, below, names in os.walk(folder, onerror=_raise):
        here = Path(place)
        for name in list(below):
            path = here / name
            if path.is_symlink() or str(path.relative_to(folder)) not in folders:
                below.remove(name)
                foreign.append(f"{path.relative_to(folder).as_posix()}/")
            else:
                own.append(path)
        for name in names:
            path = here / name
            relative = path.relative_to(folder).as_posix()
            if files and relative == MANIFEST:
                continue
            if relative not in files:
                foreign.append(relative)
            elif path.is_symlink() or files[relative] != _digest(path):
                foreign.append(f"{relative} (changed)")
            else:
                own.append(path)
    return Contents(kind, tuple(sorted(own, reverse=True)), tuple(sorted(foreign)))


def remove_written(folder: Path) -> None:
    """Remove what this package wrote, and the folder if nothing else is in it."""
    for path in read_contents(folder).own:
        if path.is_dir():
            with suppress(OSError):  # something of the user is in it
                path.rmdir()
        else:
            path.unlink(missing_ok=True)
    if os.listdir(folder) == [MANIFEST]:
        (folder / MANIFEST).unlink()
        folder.rmdir()


def sync(path: Path) -> None:
    """Wait until a file is on the disk, or a folder where the system can tell.

    Raises:
        OSError: it cannot be written there, e.g. the disk is full.
    """
    if path.is_dir():
        with suppress(OSError):  # Windows opens no folders, some file systems do not sync them
            _fsync(path, os.O_RDONLY)
    else:
        _fsync(path, os.O_RDWR)


def _fsync(path: Path, how: int) -> None:
    descriptor = os.open(path, how)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read_manifest(path: Path) -> tuple[str, dict[str, str]]:
    """Kind and digests; nothing where there is no list, or none that this package wrote."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return str(content["kind"]), dict(content["sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return "", {}


def _digest(path: Path) -> str:
    """SHA-256 of a regular file; '' of what is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _raise(error: OSError) -> None:
    raise error
