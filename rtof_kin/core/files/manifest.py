"""Manifest of an output folder: the files that this package wrote and may replace.

``.rtof_kin.json`` has the kind of the folder and the SHA-256 of every file. Files that are not listed or have
changed, links, and everything in a folder without a manifest belong to the user. Where a command can be
continued, it also has the fingerprints of what the files were made from.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

MANIFEST = ".rtof_kin.json"


@dataclass(frozen=True)
class Contents:
    """Contents of a folder by owner."""

    kind: str  #: Marker file of the kind of folder; '' without a manifest
    own: tuple[Path, ...]
    """Unchanged files and folders of this package without the manifest; a folder follows its contents."""
    foreign: tuple[str, ...]  #: Names of all others; names of folders end with '/'


def write_manifest(
    folder: Path, kind: str, inputs: Mapping[str, str] | None = None, paths: Iterable[Path] | None = None
) -> None:
    """Sync all files of a new folder, of this user alone and of this package, to the disk and list them in its
    manifest; in a folder that contains others too, those of `paths`.
    """
    files = {}
    for path in sorted(folder.rglob("*") if paths is None else paths):
        make_private(path)
        sync(path)
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = file_digest(path)
    content = {"kind": kind, "sha256": files} | ({"inputs": dict(inputs)} if inputs else {})
    partial = folder / f"{MANIFEST}.part"
    partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    make_private(partial)
    sync(partial)
    partial.replace(folder / MANIFEST)
    sync(folder)


def read_contents(folder: Path) -> Contents:
    """Compare a folder with its manifest; links are not followed. A file that cannot be read raises OSError."""
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
            elif path.is_symlink() or files[relative] != file_digest(path):
                foreign.append(f"{relative} (changed)")
            else:
                own.append(path)
    return Contents(kind, tuple(sorted(own, reverse=True)), tuple(sorted(foreign)))


def made_from(folder: Path) -> dict[str, str]:
    """Return the fingerprints of what a folder was made from, by step; empty where a file of it is missing."""
    try:
        content = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        complete = all((folder / name).is_file() for name in content["sha256"])
        return {str(step): str(value) for step, value in content["inputs"].items()} if complete else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def fingerprint(*parts: object) -> str:
    """Return a SHA-256 of files and folders (`Path`, with all contents but manifests), and of other values by their
    text; OSError where a file cannot be read.
    """
    whole = hashlib.sha256()
    for part in parts:
        if not isinstance(part, Path):
            whole.update(f"{part!r}\n".encode())
            continue
        paths = sorted(p for p in part.rglob("*") if p.is_file()) if part.is_dir() else [part]
        for path in paths:
            if path.name != MANIFEST:
                whole.update(f"{path.relative_to(part)} {file_digest(path)}\n".encode())
    return whole.hexdigest()


def remove_written(folder: Path) -> None:
    """Remove the files of this package, and the folder if it is empty then."""
    for path in read_contents(folder).own:
        if path.is_dir():
            with suppress(OSError):  # it contains files of the user
                path.rmdir()
        else:
            path.unlink(missing_ok=True)
    if os.listdir(folder) == [MANIFEST]:
        (folder / MANIFEST).unlink()
        folder.rmdir()


def make_private(path: Path) -> None:
    """Let no other user read a file or folder, where the system knows of permissions."""
    with suppress(OSError):
        path.chmod(0o700 if path.is_dir() else 0o600)


def make_folders(path: Path) -> None:
    """Make a folder and its parents, of this user alone (OSError if impossible); those that exist stay as they are."""
    if not path.is_dir():
        make_folders(path.parent)
        path.mkdir(mode=0o700, exist_ok=True)


def sync(path: Path) -> None:
    """Sync a file or folder to disk (OSError, e.g. if full); a folder is skipped where the system cannot sync it."""
    folder = path.is_dir()
    with suppress(OSError) if folder else nullcontext():  # Windows does not open folders
        descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _read_manifest(path: Path) -> tuple[str, dict[str, str]]:
    """Return kind and digests; empty without a valid manifest."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return str(content["kind"]), dict(content["sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return "", {}


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a regular file; '' of anything else."""
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _raise(error: OSError) -> None:
    raise error
