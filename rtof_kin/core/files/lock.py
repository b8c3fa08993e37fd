"""Lock of an output folder: one process at a time, and a second one learns who has it.

The system releases the lock when its process ends, however that happens. A file system without locks gets a
lock file with the process and machine in it instead (see `filelock`).
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from rtof_kin.core.errors import OutputExistsError, WritingError


@contextmanager
def only_one(lock: Path, what: str) -> Iterator[None]:
    """Hold a lock while the block runs.

    Raises:
        OutputExistsError: another process holds it; the message names it. WritingError: it cannot be made.
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
