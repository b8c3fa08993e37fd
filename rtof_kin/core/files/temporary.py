"""Temporary folders beside the output; those of a killed process are removed by the next one.

The owner locks its folder until its process ends. So on the system that made it, which its name tells (not
the host: a container has a new one each time), an unlocked folder is a leftover at once. Locks may not work
across machines, and not at all on some disks: there it is one when nothing in it was written for a day.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from rtof_kin.core.files.manifest import MANIFEST, remove_written

if sys.platform != "win32":
    import fcntl

_OWN = re.compile(r"\.rtof_kin-([A-Za-z0-9._]*)-[0-9a-f]{12}")
_OLD = 24 * 3600.0
"""[s] without a change after which a folder of another machine, or one without locks, is a leftover."""
_log = logging.getLogger(__name__)


@cache
def _system() -> str:
    """Return what identifies this system until it starts anew; '' where there is no such thing."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").partition("-")[0]
    return ""


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder, of this user alone, that is removed when the block ends; see `clear`.

    Raises:
        OSError: it cannot be created.
    """
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
    """Remove temporary folders of killed processes.

    Args:
        parent: their parent folder, which need not exist.
    """
    with suppress(OSError):
        for entry in list(os.scandir(parent)):
            found = _OWN.fullmatch(entry.name)
            mine = os.access(entry.path, os.R_OK | os.W_OK | os.X_OK)
            if found is None or not mine or not entry.is_dir(follow_symlinks=False):
                continue
            folder = Path(entry.path)
            with locked(folder) as held:
                ended = held and _system() and found[1] == _system()
                if ended or (held is not False and time.time() - _last_change(folder) > _OLD):
                    clear(folder)
                    if folder.exists():
                        _log.warning("%s: left by a killed process; contains files of yours", folder)


def _last_change(folder: Path) -> float:
    """Return when something in a folder was written, s since 1970."""
    return max(path.lstat().st_mtime for path in (folder, *folder.rglob("*")))
