"""Cache folder of shared libraries, shared by all processes of a user.

Beside each library is a record with the SHA-256 of its bytes, its source and its compiler. A library that differs from
its record (truncated, exchanged, of another source) is compiled again. Nothing is loaded from a folder that another
user could write to; `trusted` returns a private folder instead.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

from filelock import FileLock, Timeout

from rtof_kin.core.files.manifest import sync

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Origin:
    """Source and compiler of a library."""

    source: str
    """SHA-256 of everything that determines the C source and the options."""
    compiler: str
    """Name and version."""


def trusted(folder: Path) -> Path:
    """Return the cache folder, created if missing; if others can write to it, a private one and a warning."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    doubt = _doubt(folder.resolve())
    return folder if doubt is None else _private(folder, doubt)


def kept(library: Path, source: str) -> bool:
    """Return whether a library exists, matches its record and has this source.

    Args:
        source: see `Origin`.
    """
    try:
        record = json.loads(_own_bytes(library.with_suffix(".json")))
        sha256 = hashlib.sha256(_own_bytes(library)).hexdigest()
        return bool(record["source"] == source and record["sha256"] == sha256)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def make(library: Path, origin: Origin, write: Callable[[Path], None], again: bool = False) -> None:
    """Build a library and its record, unless another process has done so meanwhile.

    Args:
        again: build it even if it matches its record.
    """
    with _locked(library):
        if kept(library, origin.source) and not again:
            return
        _remove_dead_builds(library)
        build = library.with_suffix(".build")
        build.mkdir(mode=0o700)
        try:
            made, record = build / library.name, build / "record.json"
            write(made)
            sha256 = hashlib.sha256(made.read_bytes()).hexdigest()
            record.write_text(json.dumps({"sha256": sha256, **asdict(origin)}), encoding="utf-8")
            for new, place in ((made, library), (record, library.with_suffix(".json"))):
                new.chmod(0o700)
                sync(new)
                new.replace(place)  # atomic
        finally:
            shutil.rmtree(build, ignore_errors=True)


def _locked(library: Path) -> AbstractContextManager[object]:
    """Acquire the lock of a library; waiting is logged."""
    lock = FileLock(library.with_suffix(".lock"), mode=0o600)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        _log.warning("another process compiles %s: waiting for it ...", library.name)
        return lock.acquire()


def _remove_dead_builds(library: Path) -> None:
    """Remove leftovers of killed builds: of this library, and of others that are not locked."""
    for left in library.parent.glob("*.build"):
        try:
            own = left.stem == library.stem
            lock = FileLock(left.with_suffix(".lock"), timeout=0, mode=0o600)
            with nullcontext() if own else lock:
                shutil.rmtree(left, ignore_errors=True)
        except Timeout:
            pass  # being built


def _own_bytes(path: Path) -> bytes:
    """Return the contents of a file; raise OSError if other users can write to it."""
    with path.open("rb") as file:
        if _writable_by_others(os.fstat(file.fileno())):
            raise PermissionError(f"{path}: others may write to it")
        return file.read()


# --- permissions ---------------------------------------------------------------------------------


def _writable_by_others(status: os.stat_result) -> bool:
    """Return whether anyone except this user and root may write."""
    if sys.platform == "win32":  # access rights are not in these bits
        return False
    return status.st_uid not in (0, os.geteuid()) or bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def _doubt(folder: Path) -> str | None:
    """Return why another user could put a library there; None if not possible."""
    if _writable_by_others(folder.stat()):
        return f"others may write to {folder} (chmod 700 it after a look at its contents, or delete it)"
    for parent in folder.parents:
        status = parent.stat()
        if _writable_by_others(status) and not _sticky(status) and not _of_own_group(status):
            return f"others may replace folders in {parent}"
    return None


def _sticky(status: os.stat_result) -> bool:
    """Return whether users can replace only their own entries of a folder of this user or root."""
    own = sys.platform == "win32" or status.st_uid in (0, os.geteuid())
    return own and bool(status.st_mode & stat.S_ISVTX)


def _of_own_group(status: os.stat_result) -> bool:
    """Return whether a folder belongs to this user and its group has no other member."""
    if sys.platform == "win32":
        return True
    import grp
    import pwd

    if status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH:
        return False
    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return group.gr_name == user.pw_name and {*group.gr_mem} <= {user.pw_name}


@lru_cache
def _private(folder: Path, doubt: str) -> Path:
    """Return a folder of this process in place of an unsafe one."""
    private = Path(tempfile.mkdtemp(prefix="rtof_kin_"))
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    _log.warning(
        "compiled code is not kept in %s: %s. It is compiled for this process alone; "
        "set RTOF_KIN_CACHE to a folder of your own to keep it",
        folder,
        doubt,
    )
    return private
