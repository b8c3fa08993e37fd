"""Temporary folders beside the output; those of a killed process are removed by the next one.

The owner locks its folder until its process ends, so an unlocked folder is a leftover. Only folders of this
machine are removed, because locks may not work across machines; without file locks none are removed.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rtof_kin.core.files.manifest import MANIFEST, remove_written

if sys.platform != "win32":
    import fcntl

_PREFIX = f".rtof_kin-{re.sub('[^A-Za-z0-9.]', '_', platform.node())[:64]}-"
_OWN = re.compile(re.escape(_PREFIX) + "[0-9a-f]{12}")
_log = logging.getLogger(__name__)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder that is removed when the block ends; see `clear`.

    Args:
        parent: its parent folder.

    Raises:
        OSError: it cannot be created.
    """
    remove_leftovers(parent)
    while True:
        folder = parent / f"{_PREFIX}{secrets.token_hex(6)}"
        folder.mkdir()
        with _lock(folder) as locked:
            if locked is False or not folder.exists():
                continue  # another process removed it as a leftover before it was locked
            try:
                yield folder
            finally:
                clear(folder)
            return


@contextmanager
def _lock(folder: Path) -> Iterator[bool | None]:
    """Lock a folder: True; False if another process has it locked or removed; None without file locks."""
    descriptor, locked = None, None
    try:
        if sys.platform != "win32":
            descriptor = os.open(folder, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            locked = True
    except (BlockingIOError, FileNotFoundError):
        locked = False
    except OSError:  # a file system without locks
        locked = None
    try:
        yield locked
    finally:
        if descriptor is not None:
            os.close(descriptor)


def clear(folder: Path) -> None:
    """Remove a temporary folder; if it has a manifest (a replaced output), only files of this package.

    Args:
        folder: to be removed.
    """
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
            if _OWN.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                folder = Path(entry.path)
                with _lock(folder) as locked:
                    if locked:
                        clear(folder)
                        if folder.exists():
                            _log.warning("%s: left by a killed process; contains files of yours", folder)
