"""Atomic output: files and folders appear complete or not at all and never replace files of the user.

They are of this user alone (0600, 0700), as they are data of patients; a file that is replaced keeps its permissions.

They are written in temporary folders beside them; those of a killed process are removed by the next one. The owner
locks its folder until its process ends. So on the system that made it, which its name tells (not the host: a
container has a new one each time), an unlocked folder is a leftover at once. Locks may not work across machines, and
not at all on some disks: there it is one when nothing in it was written for a day.

The lock of an output folder is of one process at a time, and a second one learns who has it; the system releases it
when its process ends. A file system without locks gets a lock file with the process and machine in it (see `filelock`).
"""

from __future__ import annotations

import errno
import json
import logging
import os
import platform
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path, PurePosixPath

from filelock import FileLock, Timeout

from rtof_kin.core.errors import OutputExistsError, RtofError, WritingError
from rtof_kin.core.files.manifest import (
    MANIFEST,
    make_folders,
    make_private,
    read_contents,
    remove_written,
    sync,
    write_manifest,
)

if sys.platform != "win32":
    import fcntl

_OWN = re.compile(r"\.rtof_kin-([A-Za-z0-9._]*)-[0-9a-f]{12}")
_OLD = 24 * 3600.0  #: [s] without a change after which a folder of another machine, or one without locks, is a leftover
_log = logging.getLogger(__name__)


@cache
def _system() -> str:
    """Return what identifies this system until it starts anew; '' where there is no such thing."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").partition("-")[0]
    return ""


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder, of this user alone, removed when the block ends, see `clear`; OSError if impossible."""
    remove_leftovers(parent)
    while True:
        folder = parent / f".rtof_kin-{_system()}-{secrets.token_hex(6)}"
        folder.mkdir(mode=0o700)
        with locked(folder) as held:
            if held is False or not folder.exists():
                continue  # another process removed it as a leftover before it was locked
            try:
                yield folder
            finally:
                clear(folder)
            return


@contextmanager
def locked(folder: Path) -> Iterator[bool | None]:
    """Lock a folder: True; False if another process has it locked or removed; None without file locks."""
    descriptor, held = None, None
    try:
        if sys.platform != "win32":
            descriptor = os.open(folder, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = True
    except (BlockingIOError, FileNotFoundError):
        held = False
    except OSError:  # a file system without locks
        held = None
    try:
        yield held
    finally:
        if descriptor is not None:
            os.close(descriptor)


def clear(folder: Path) -> None:
    """Remove a temporary folder; if it has a manifest (a replaced output), only files of this package."""
    if os.path.lexists(folder / MANIFEST):
        with suppress(OSError):
            remove_written(folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def remove_leftovers(parent: Path) -> None:
    """Remove temporary folders of killed processes from their parent folder, which need not exist."""
    with suppress(OSError):
        for entry in list(os.scandir(parent)):
            found = _OWN.fullmatch(entry.name)
            mine = os.access(entry.path, os.R_OK | os.W_OK | os.X_OK)
            if found is None or not mine or not entry.is_dir(follow_symlinks=False):
                continue
            folder = Path(entry.path)
            with locked(folder) as held:
                ended = held and _system() and found[1] == _system()
                changed = max(path.lstat().st_mtime for path in (folder, *folder.rglob("*")))
                if ended or (held is not False and time.time() - changed > _OLD):
                    clear(folder)
                    if folder.exists():
                        _log.warning("%s: left by a killed process; contains files of yours", folder)


_NAMED = 3  #: Number of foreign files that an error message lists
_NO_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP}
_NO_LINKS = {errno.ENOSYS, errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems that cannot exchange folders or create hard links."""
_HERE, _EXCHANGE = -100, 2  #: Linux's AT_FDCWD and RENAME_EXCHANGE


def path_inside(folder: Path, name: str) -> Path | None:
    """Return the path of a name inside a folder; None if it leads out of it ('..', absolute names, links)."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or ":" in name or "\0" in name or not parts.parts:
        return None
    path = folder.joinpath(*parts.parts)
    try:
        return path if path.resolve().is_relative_to(folder.resolve()) else None
    except (OSError, RuntimeError):  # a link to itself
        return None


# --- folders -------------------------------------------------------------------------------------


@contextmanager
def new_folder(
    path: str | Path, marker: str, overwrite: bool = False, inputs: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to `path` when the block ends without an error.
    `OutputExistsError`: `path` exists, or appears meanwhile, and may not be replaced; `WritingError`: it cannot be
    written.

    Args:
        marker: name of a file that every folder of this kind contains.
        overwrite: replace an earlier folder of this kind, see `check_replaceable`.
        inputs: fingerprints of what it is made from, for `core.files.manifest.made_from`.
    """
    path = Path(os.path.abspath(path))
    check_replaceable(path, marker, overwrite)
    try:
        make_folders(path.parent)
        with temporary_folder(path.parent) as temporary:
            yield temporary
            write_manifest(temporary, marker, inputs)
            _put_folder(temporary, path, marker, overwrite)
            sync(path.parent)
    except WritingError as error:  # of a file in the temporary folder: name the final one
        problem = error.__cause__ or error
        raise WritingError(f"{path}: cannot be written ({problem}); choose another folder") from error
    except RtofError:  # OutputExistsError is an OSError
        raise
    except OSError as error:
        raise WritingError(f"{path}: cannot be written ({error}); choose another folder") from error


def check_replaceable(path: str | Path, marker: str, overwrite: bool = False) -> None:
    """Check that an output folder may be written, else `OutputExistsError` or `WritingError`. Long computations check
    before they start. An empty folder may be filled. With `overwrite` a folder of the same kind may be replaced if it
    contains only unchanged files of this package (see `core.files.manifest`).
    """
    path = Path(path)
    if path.is_symlink() or os.path.ismount(path):
        raise OutputExistsError(f"{path}: is a link or a mounted disk; name a folder of its own")
    _check_place(path, "choose another folder")
    if not path.exists():
        return
    if not path.is_dir():
        raise OutputExistsError(f"{path}: is a file; name a folder")
    try:
        found = read_contents(path)
    except OSError as error:
        raise RtofError(f"{path}: cannot be read ({error}); choose another folder") from error
    if not (found.own or found.foreign):
        return
    if found.foreign:
        more = len(found.foreign) - _NAMED
        names = ", ".join(found.foreign[:_NAMED]) + (f" and {more} more" if more > 0 else "")
        raise OutputExistsError(
            f"{path}: contains files that this package did not write and that are never replaced: "
            f"{names}; move it elsewhere or name another folder"
        )
    if Path(found.kind).stem != Path(marker).stem:  # an earlier version wrote motion.npz for motion.h5
        raise OutputExistsError(
            f"{path}: was written by another command ({found.kind}) and is not replaced by this one; "
            "name another folder"
        )
    if not overwrite:
        raise OutputExistsError.of(path)


def _check_place(path: Path, remedy: str) -> None:
    place = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise WritingError(f"{path}: cannot be written ({place} is no folder to write to); {remedy}")


def _put_folder(new: Path, path: Path, marker: str, overwrite: bool) -> None:
    """Rename a folder, or exchange it with an earlier one and remove that."""
    if path.is_dir() and not os.listdir(path):
        path.rmdir()  # Windows does not rename over a folder
    try:
        os.rename(new, path)
    except OSError:
        if not os.path.lexists(path):
            raise
        check_replaceable(path, marker, overwrite)
        _exchange(new, path)
        _remove_replaced(new, path)


def _exchange(new: Path, path: Path) -> None:
    """Exchange two folders, atomically on Linux; elsewhere the old one is renamed to ``*.replaced-*`` for a moment."""
    try:
        _exchange_at_once(new, path)
    except OSError as error:
        if error.errno not in _NO_EXCHANGE:
            raise
        aside = _beside(path, "replaced")
        try:
            os.rename(path, aside)
            os.rename(new, path)
        except BaseException:
            with suppress(OSError):  # if `path` exists again, the old folder keeps its other name
                os.rename(aside, path)
            raise
        os.rename(aside, new)


def _exchange_at_once(first: Path, second: Path) -> None:
    import ctypes  # slow to import, rarely needed

    if sys.platform != "linux":
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    paths = os.fsencode(first), os.fsencode(second)
    if library.renameat2(_HERE, paths[0], _HERE, paths[1], ctypes.c_uint(_EXCHANGE)):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(second))


def _remove_replaced(old: Path, path: Path) -> None:
    """Remove an earlier output but keep files that were added at the last moment."""
    clear(old)
    with suppress(FileNotFoundError):  # removed completely, maybe by another run
        if read_contents(old).foreign:
            kept = _beside(path, "kept")
            os.rename(old, kept)
            _log.warning("%s: was replaced while files were added to it; they are in %s", path, kept)


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.name}.{what}-{secrets.token_hex(4)}")


# --- files ---------------------------------------------------------------------------------------


@contextmanager
def new_file(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary file that is renamed to `path`, of which a link is followed, when the block ends without an
    error; `OutputExistsError` where it exists, or appears meanwhile, and may not be replaced, `WritingError` where it
    cannot be written.
    """
    check_new_file(path, overwrite)
    target = Path(os.path.realpath(path))
    try:
        make_folders(target.parent)
        with temporary_folder(target.parent) as folder:
            file = folder / Path(path).name
            yield file
            make_private(file)
            sync(file)
            try:
                _put_file(file, target, overwrite)
            except FileExistsError as error:
                raise OutputExistsError.of(path) from error
            sync(target.parent)
    except RtofError:
        raise
    except OSError as error:
        raise WritingError(f"{path}: cannot be written ({error}); name another file") from error


def check_new_file(path: str | Path, overwrite: bool) -> None:
    """Check that an output file may be written: `OutputExistsError` where it exists, `WritingError` where its folder
    cannot be.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise OutputExistsError(f"{path}: is {what}; name a file")
    _check_place(Path(os.path.realpath(path)), "name another file")
    if path.exists() and not overwrite:
        raise OutputExistsError.of(path)


def _put_file(new: Path, path: Path, overwrite: bool) -> None:
    if overwrite:
        with suppress(FileNotFoundError):
            shutil.copymode(path, new)
        os.replace(new, path)
        return
    try:
        os.link(new, path)  # fails if `path` exists; a renaming would replace it
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))  # reserves the name
        os.replace(new, path)


@contextmanager
def only_one(lock: Path, what: str) -> Iterator[None]:
    """Hold a lock while the block runs; `OutputExistsError`, which names the process, where another one holds it,
    `WritingError` where it cannot be made.
    """
    try:
        held = FileLock(lock, timeout=0).acquire()
    except Timeout:
        raise OutputExistsError(f"{what}: {_holder(lock)} is at work on it; wait until it ends, or end it") from None
    except OSError as error:
        raise WritingError(f"{lock}: cannot be locked ({error}); name a folder on another disk") from error
    with held:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        holder = {"process": os.getpid(), "machine": platform.node(), "since": now}
        with suppress(OSError):  # a full disk; the lock holds anyway
            _file(lock).write_text(json.dumps(holder), encoding="utf-8")
        yield


def is_held(lock: Path) -> str | None:
    """Return the process that holds a lock, in words, or None."""
    try:
        with FileLock(lock, timeout=0):
            return None
    except Timeout:
        return _holder(lock)


def _holder(lock: Path) -> str:
    try:
        holder = json.loads(_file(lock).read_text(encoding="utf-8"))
        return f"process {holder['process']} on {holder['machine']}, since {holder['since']} by its clock,"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def _file(lock: Path) -> Path:
    return lock.with_suffix(".json")
