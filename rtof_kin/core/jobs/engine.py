"""Engines of jobs: what they have in common, and the one that runs jobs in this process.

A job is a key and an argument; all jobs of a run have one function. An engine yields what each job gave as
soon as it ends, in any order. It never raises for a job: one that raised, or whose process or machine was
lost, has no answer but a reason.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ended:
    """One job that ended."""

    key: str
    answer: Any = None
    lost: str | None = None
    """Why there is no answer; None where there is one."""


class Engine(Protocol):
    """Where and how jobs are run."""

    def run(self, function: Callable[[Any], Any], jobs: Iterable[tuple[str, Any]]) -> Generator[Ended, None, None]:
        """Run jobs and yield each as it ends; closing the generator stops those that run.

        Args:
            function: at the top level of a module (or a partial of such a one); called with an argument.
            jobs: key and argument of each, taken one by one as there is room for them.
        """
        ...


@dataclass(frozen=True)
class InThisProcess:
    """Engine that runs one job after the other in this process; an interrupt is raised to the caller."""

    def run(self, function: Callable[[Any], Any], jobs: Iterable[tuple[str, Any]]) -> Generator[Ended, None, None]:
        """See `Engine.run`."""
        for key, argument in jobs:
            yield ended(function, key, argument)


def ended(function: Callable[[Any], Any], key: str, argument: Any) -> Ended:
    """Run one job here."""
    try:
        return Ended(key, function(argument))
    except Exception as error:
        _log.exception("%s", key)
        return Ended(key, lost=f"{type(error).__name__}: {error}")


def usable_cores() -> int:
    """Return the number of cores that this process may use; one in a process that is itself a worker."""
    if multiprocessing.parent_process() is not None:
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
