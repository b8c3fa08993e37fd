"""Shared libraries kept in a folder: made once for all processes, loaded only as they were made.

Beside each library lies a record: the SHA-256 of its bytes, and the source and the compiler that it was
made from. A library that is not what its record says (cut off, exchanged, of another source) is made
again. Nothing is loaded from where another user could have put it: `trusted` gives a private folder then.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import logging
import os
import shutil
import stat
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
    """What a library is made from."""

    source: str
    """SHA-256 of what its C and the compiler's options follow from."""
    compiler: str
    """Name and version."""


def trusted(folder: Path) -> Path:
    """The folder, made where it is not there; a private one of this process, with a warning, where
    others could write.
    """
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    doubt = _doubt(folder.resolve())
    return folder if doubt is None else _private(folder, doubt)


def kept(library: Path, source: str) -> bool:
    """Whether a library is there and is what its record says, made from this source."""
    try:
        record = json.loads(_own_bytes(library.with_suffix(".json")))
        sha256 = hashlib.sha256(_own_bytes(library)).hexdigest()
        return bool(record["source"] == source and record["sha256"] == sha256)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def make(library: Path, origin: Origin, write: Callable[[Path], None], again: bool = False) -> None:
    """Make a library and its record, unless another process has done so meanwhile.

    Args:
        write: makes the library at a path. again: also where it is what its record says.
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
                new.replace(place)  # whole or not at all
        finally:
            shutil.rmtree(build, ignore_errors=True)


def _locked(library: Path) -> AbstractContextManager[object]:
    """The lock of one library, taken; it is logged where that takes waiting."""
    lock = FileLock(library.with_suffix(".lock"), mode=0o600)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        _log.warning("another process compiles %s: waiting for it ...", library.name)
        return lock.acquire()


def _remove_dead_builds(library: Path) -> None:
    """Remove what killed builds left: those of other libraries that nobody holds the lock of, and of this
    one, which is ours.
    """
    for left in library.parent.glob("*.build"):
        try:
            own = left.stem == library.stem
            lock = FileLock(left.with_suffix(".lock"), timeout=0, mode=0o600)
            with nullcontext() if own else lock:
                shutil.rmtree(left, ignore_errors=True)
        except Timeout:
            pass  # it is being built


def _own_bytes(path: Path) -> bytes:
    """A file's content.

    Raises:
        OSError: it cannot be read, or somebody else could have written it.
    """
    with path.open("rb") as file:
        if _writable_by_others(os.fstat(file.fileno())):
            raise PermissionError(f"{path}: others may write to it")
        return file.read()


# --- whom a folder belongs to --------------------------------------------------------------------


def _writable_by_others(status: os.stat_result) -> bool:
    """Whether somebody who is neither this user nor the administrator may write."""
    if os.name != "posix":  # Windows: rights of the user's profile are not in these bits
        return False
    return status.st_uid not in (0, os.geteuid()) or bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def _doubt(folder: Path) -> str | None:
    """Who else could put a library there, as a clause; None where nobody could."""
    if _writable_by_others(folder.stat()):
        return f"others may write to {folder} (chmod 700 it after a look at what it holds, or delete it)"
    for parent in folder.parents:
        status = parent.stat()
        sticky = status.st_mode & stat.S_ISVTX and status.st_uid in (0, os.geteuid())
        if _writable_by_others(status) and not sticky and not _of_own_group(status):
            return f"others may replace folders in {parent}"
    return None


def _of_own_group(status: os.stat_result) -> bool:
    """Whether a folder is this user's, and the group that may write is this user alone, as many systems
    set home folders up.
    """
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
    """A folder of this process in place of one that is in doubt."""
    private = Path(tempfile.mkdtemp(prefix="rtof_kin_"))
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    _log.warning(
        "compiled code is not kept in %s: %s. It is compiled for this process alone; "
        "set RTOF_KIN_CACHE to a folder of your own to keep it", folder, doubt,
    )  # fmt: skip
    return private
