"""Small jobs for the engines, which run them in other processes."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.jobs.engine import cores_limited, usable_cores


def square(number: int) -> int:
    return number * number


def whereabouts(_: int) -> tuple[int, str | None]:
    """Process and its number of threads."""
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


def cores(told: int | None) -> int:
    """Cores that may be used in a worker that is told some."""
    with cores_limited(told):
        return usable_cores()


def die(tries: tuple[Path, int]) -> int:
    """Be killed the first so many times."""
    log, times = tries
    count = len(list(log.parent.glob(f"{log.name}-*")))
    log.with_name(f"{log.name}-{count}").touch()
    if count < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return count


def fail(kind: str) -> object:
    if kind == "exit":
        os._exit(7)
    if kind == "raise":
        raise ZeroDivisionError("by nothing")
    return lambda: None  # cannot be sent back


def call(task: Callable[[], object]) -> object:
    return task()


def warn(text: str) -> None:
    logging.getLogger("rtof_kin.core").warning(text)


def refuse(why: str) -> None:
    raise InvalidInputError(why)


def sleep_and_tell(folder: Path) -> None:
    (folder / f"{os.getpid()}.pid").touch()
    time.sleep(120)
