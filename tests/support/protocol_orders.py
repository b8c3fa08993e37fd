"""Small jobs with a prescribed behaviour for worker processes of tests."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.jobs import JobResult


@dataclass(frozen=True)
class Order:
    """Behaviour of a job."""

    name: str
    log: Path
    """Folder in which every call leaves a file."""
    doing: str = "work"
    fact: Any = 0.0


def orders(log: Path, **doing: str) -> dict[str, Order]:
    """One order by name: what each does."""
    log.mkdir(exist_ok=True)
    return {name: Order(name, log, what, float(k)) for k, (name, what) in enumerate(doing.items())}


def calls(log: Path) -> list[str]:
    """Names of the jobs that were called, sorted; once for every call."""
    return sorted(path.name.split("-")[0] for path in log.iterdir())


def obey(order: Order) -> JobResult:
    """Do what is ordered."""
    (order.log / f"{order.name}-{uuid.uuid4().hex}-{os.getpid()}").touch()
    if order.doing == "refuse":
        raise InvalidInputError(f"{order.name}: the take is too short")
    if order.doing == "crash":
        raise ZeroDivisionError(f"{order.name} divided by nothing")
    if order.doing == "interrupt":
        raise KeyboardInterrupt
    if order.doing == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if order.doing == "sleep":
        time.sleep(60)
    if order.doing == "meet":
        _wait_for_another(order.log)
    facts = {
        "fact": order.fact,
        "process": type(multiprocessing.current_process()).__name__,
        "threads": os.environ.get("OMP_NUM_THREADS"),
        "methods": {"a": {}},
    }
    return JobResult(facts, {"squares": np.arange(4.0) ** 2 + 1 / 3})


def _wait_for_another(log: Path) -> None:
    """Until a second process has been called as well."""
    for _ in range(2000):
        if len({path.name.split("-")[2] for path in log.iterdir()}) > 1:
            return
        time.sleep(0.01)
    raise TimeoutError("there is no other process")


def values(done: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The fact of every job, by key."""
    return {key: facts["fact"] for key, facts in done.items()}
