"""Engines of jobs: what they have in common, the one that runs jobs in this process, and that of a Ray cluster.

A job is a key and an argument; all jobs of a run have one function. An engine yields what each job gave as
soon as it ends, in any order. It never raises for a job: one that raised, or whose process or machine was
lost, has no answer but a reason.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, Protocol

from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.packages import optional

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ended:
    """One job that ended."""

    key: str
    answer: Any = None
    lost: str | None = None  #: Why there is no answer; None where there is one


class Engine(Protocol):
    """Where and how jobs are run."""

    def run(self, function: Callable[[Any], Any], jobs: Iterable[tuple[str, Any]]) -> Generator[Ended, None, None]:
        """Run jobs and yield each as it ends; closing the generator stops those that run.

        The function stands at the top level of a module, or is a partial of such a one. The jobs, key and argument of
        each, are taken one by one as there is room for them.
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


_told: Final = ContextVar[int | None]("cores that may be used", default=None)


@contextmanager
def cores_limited(cores: int | None) -> Iterator[None]:
    """Let `usable_cores` return this number inside, unless it is None."""
    before = _told.set(cores or _told.get())
    try:
        yield
    finally:
        _told.reset(before)


def usable_cores() -> int:
    """Return the number of cores that this process may use; one in a process that is itself a worker and not told."""
    told, worker = _told.get(), multiprocessing.parent_process() is not None
    if told or worker:
        return told or 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_AHEAD: Final = 2  #: Jobs that are handed to the cluster, for each of its cores
_LOOK: Final = 10.0  # [s] between two looks at the size of the cluster


@dataclass(frozen=True)
class RayCluster:
    """Engine of a Ray cluster: jobs go to the nodes that have a free core and the memory stated per job.

    Ray schedules, retries a job whose worker or node is lost, and has a dashboard. It is an extra of the package,
    imported when a run begins. Jobs write their files themselves, to a folder that all nodes share.
    """

    address: str | None = None
    """Of the head node, as HOST:6379, or 'auto'; None: RAY_ADDRESS, else a cluster of this machine alone."""
    workers: int | None = None  #: Most jobs at a time; None: one per core of the cluster
    memory_per_job: float = 0.0  #: [bytes] that Ray reserves on a node for each job
    retries: int = 3  #: How often a job whose worker or node was lost is tried again

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InvalidInputError(f"workers: {self.workers}; give 1 or more")

    def run(self, function: Callable[[Any], Any], jobs: Iterable[tuple[str, Any]]) -> Generator[Ended, None, None]:
        """See `Engine.run`."""
        ray = optional("ray", "cluster")
        waiting = iter(jobs)
        with self._connected(ray):
            task = ray.remote(num_cpus=1, memory=int(self.memory_per_job) or None, max_retries=self.retries)(ended)
            given: dict[Any, str] = {}
            room, looked = 0, -_LOOK
            try:
                while True:
                    if time.monotonic() - looked > _LOOK:  # nodes come and go
                        cores = int(ray.cluster_resources().get("CPU", 0))
                        room, looked = self.workers or max(1, _AHEAD * cores), time.monotonic()
                    for key, argument in islice(waiting, max(0, room - len(given))):
                        given[task.remote(function, key, argument)] = key
                    if not given:
                        return
                    ready, _ = ray.wait(list(given), num_returns=1, timeout=_LOOK)
                    for one in ready:
                        yield _answer(ray, one, given.pop(one))
            finally:
                for one in given:
                    ray.cancel(one, force=True)

    @contextmanager
    def _connected(self, ray: Any) -> Iterator[None]:
        """Connect to the cluster, unless this process is already."""
        if ray.is_initialized():
            yield
            return
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
        try:
            ray.init(address=self.address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise RtofError(
                f"ray: no cluster at {self.address or 'this machine'} ({str(error).splitlines()[0]}); "
                "start one by ray start --head, and name its address"
            ) from error
        try:
            yield
        finally:
            ray.shutdown()


def _answer(ray: Any, one: Any, key: str) -> Ended:
    """Return what a job gave, or why Ray gave it up."""
    try:
        answer: Ended = ray.get(one)
        return answer
    except ray.exceptions.RayError as error:
        _log.debug("%s", key, exc_info=True)
        last = str(error).strip().splitlines()[-1]  # of a traceback
        return Ended(key, lost=f"ray gave it up: {last} ({type(error).__name__})")
