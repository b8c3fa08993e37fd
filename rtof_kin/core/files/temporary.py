"""Temporary folders beside what is being written; those of a run that was killed are removed by the next.

Their owner holds a lock on them that ends with its process: a folder that can be locked was left behind.
Only those made on this machine are looked at, as locks need not be seen across machines. Systems without
such locks leave them where they are.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rtof_kin.core.files.manifest import MANIFEST, remove_written

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_PREFIX = f".rtof_kin-{re.sub('[^A-Za-z0-9.]', '_', platform.node())[:64]}-"
_OWN = re.compile(re.escape(_PREFIX) + "[0-9a-f]{12}")
_log = logging.getLogger(__name__)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent`, removed when the block ends; see `clear`.

    Raises:
        OSError: it cannot be made.
    """
    _remove_leftovers(parent)
    while True:
        folder = parent / f"{_PREFIX}{secrets.token_hex(6)}"
        folder.mkdir()
        with _locked(folder) as held:
            if held is False or not folder.exists():
                continue  # another run took it for a leftover before it was locked
            try:
                yield folder
            finally:
                clear(folder)
            return


@contextmanager
def _locked(folder: Path) -> Iterator[bool | None]:
    """Hold a folder's lock: True; False: another does, or it is gone; None: there are no locks here."""
    descriptor, held = None, None
    try:
        if fcntl is not None:
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
    """Remove a temporary folder. One with a manifest is an earlier output that was replaced: of that only
    what this package wrote is removed.
    """
    if os.path.lexists(folder / MANIFEST):
        with suppress(OSError):
            remove_written(folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_leftovers(parent: Path) -> None:
    with suppress(OSError):
        for entry in list(os.scandir(parent)):
            if _OWN.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                _remove_leftover(Path(entry.path))


def _remove_leftover(folder: Path) -> None:
    with _locked(folder) as held:
        if held:
            clear(folder)
            if folder.exists():
                _log.warning("%s: left by a run that was killed; holds files of yours", folder)
