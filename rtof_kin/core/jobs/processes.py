"""Engine of worker processes on this machine: one thread each, warm, and no more than the memory holds.

A worker that is killed loses its own job only: a pool of the standard library, or of joblib, gives up all of its
jobs then. The job is tried once more when all others are done, alone, since most processes are killed for want of
memory. Workers end with the process that started them, even if that is killed.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from typing import Any, Final

from rtof_kin.core.environment import VARIABLES
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.jobs.engine import Ended, ended, usable_cores
from rtof_kin.core.jobs.memory import available_memory, resident_memory, total_memory

_GB: Final = 1e9
_POLL: Final = 1.0  # [s] between two looks at the memory
_REMIND: Final = 60.0  # [s] between two messages that the memory is not enough
_CONTEXT: Final = multiprocessing.get_context("spawn")
_log = logging.getLogger(__name__)
_Job = tuple[str, Any]


@dataclass(frozen=True)
class Processes:
    """Engine of worker processes on this machine."""

    workers: int | None = None  #: Most of them; None: one per core that this process may use
    memory_per_job: float = 0.0
    """[bytes] that one job needs with its process. None starts while less is available; 0: not looked at."""
    jobs_per_worker: int = 200  #: A worker that has done as many is replaced by a new one

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InvalidInputError(f"workers: {self.workers}; give 1 or more")
        if self.memory_per_job < 0 or self.jobs_per_worker < 1:
            raise InvalidInputError("memory per job is 0 or more, and jobs per worker 1 or more")
        total = total_memory()
        if total is not None and self.memory_per_job > total:
            raise InvalidInputError(
                f"memory per job: {self.memory_per_job / _GB:.1f} GB, but this machine has "
                f"{total / _GB:.1f} GB; state less, or run on a larger one"
            )

    def run(self, function: Callable[[Any], Any], jobs: Iterable[tuple[str, Any]]) -> Generator[Ended, None, None]:
        """See `Engine.run`."""
        pool, again = _Pool(self, function), list[_Job]()
        try:
            for job, answer in pool.run(iter(jobs)):
                if job is None:
                    yield answer
                else:
                    _log.warning("%s: %s; tried once more when all others are done", job[0], answer.lost)
                    again.append(job)
            for one in again:
                for job, answer in pool.run(iter([one])):
                    reason = f"{answer.lost}, also when it ran alone: is there too little memory for it?"
                    yield answer if job is None else Ended(answer.key, lost=reason)
        finally:
            for workers in (pool.busy, pool.idle):
                _end(workers)


class _Worker:
    """A process that does one job after the other."""

    def __init__(self, function: Callable[[Any], Any]):
        self.connection, inner = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_serve, args=(function, inner))
        self.job: _Job | None = None
        self.done = 0
        with _one_thread():
            self.process.start()
        inner.close()  # so that the end of the process is the end of the pipe

    def give(self, job: _Job) -> None:
        self.job, self.done = job, self.done + 1
        with suppress(BrokenPipeError):  # it was killed: `take` says so
            self.connection.send(job)

    def take(self) -> tuple[_Job | None, Ended]:
        """Return what the job gave; with the job itself where its process is no more."""
        job, self.job = self.job, None
        assert job is not None
        try:
            return None, self.connection.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            code = self.process.exitcode or 0
            how = f"killed (signal {-code})" if code < 0 else f"ended (exit code {code})"
            return job, Ended(job[0], lost=f"its process was {how}")


def _end(workers: list[_Worker]) -> None:
    """End workers; those that have a job are terminated."""
    for worker in workers:
        worker.connection.close()
        if worker.job is not None:
            worker.process.terminate()
    for worker in workers:
        worker.process.join()
    workers.clear()


class _Pool:
    """The workers of a run."""

    def __init__(self, settings: Processes, function: Callable[[Any], Any]):
        self.settings, self.function, self.most = settings, function, settings.workers or usable_cores()
        if settings.memory_per_job and (total := total_memory()) is not None:
            self.most = max(1, min(self.most, int(total // settings.memory_per_job)))
        self.idle: list[_Worker] = []
        self.busy: list[_Worker] = []
        self._reminded = -_REMIND

    def run(self, jobs: Iterator[_Job]) -> Iterator[tuple[_Job | None, Ended]]:
        """Yield each job that ended; with the job itself where its process was lost."""
        waiting = list(islice(jobs, 1))
        while waiting or self.busy:
            while waiting and len(self.busy) < self.most and self._memory_is_enough():
                worker = self.idle.pop() if self.idle else _Worker(self.function)
                self.busy.append(worker)
                worker.give(waiting.pop())
                waiting = list(islice(jobs, 1))
            if not self.busy:
                time.sleep(_POLL)
                continue
            held_back = waiting and len(self.busy) < self.most
            ready = wait([worker.connection for worker in self.busy], _POLL if held_back else None)
            for worker in [worker for worker in self.busy if worker.connection in ready]:
                self.busy.remove(worker)
                lost, answer = worker.take()
                if lost is not None or worker.done >= self.settings.jobs_per_worker:
                    worker.connection.close()
                else:
                    self.idle.append(worker)
                yield lost, answer

    def _memory_is_enough(self) -> bool:
        """Return whether the memory is enough for one more job when those that run have all they need."""
        need, available = self.settings.memory_per_job, available_memory()
        if not need or available is None:
            return True
        own = _memory_of(self.idle[-1]) if self.idle else 0
        if available - sum(max(0.0, need - _memory_of(worker)) for worker in self.busy) >= need - own:
            return True
        if not self.busy:  # idle ones are warm, but hold memory
            _end(self.idle)
            if time.monotonic() - self._reminded >= _REMIND:
                self._reminded = time.monotonic()
                _log.warning(
                    "waiting for memory: a job needs %.1f GB, and %.1f GB are available", need / _GB, available / _GB
                )
        return False


def _memory_of(worker: _Worker) -> int:
    return resident_memory(worker.process.pid or 0)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let numerical libraries of a process that is started have one thread."""
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    try:
        yield
    finally:
        for name in VARIABLES:
            del os.environ[name]
        os.environ.update({name: before[name] for name in VARIABLES if name in before})


# --- in the worker -------------------------------------------------------------------------------


def _serve(function: Callable[[Any], Any], connection: Connection) -> None:
    """Do the jobs that come until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent handles Ctrl-C
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            key, argument = connection.recv()
        except EOFError:
            return
        answer = ended(function, key, argument)
        try:
            connection.send(answer)
        except BrokenPipeError:
            return
        except Exception as error:  # an answer that cannot be pickled
            connection.send(Ended(key, lost=f"{type(error).__name__}: {error}"))


def _end_with_parent() -> None:
    """End this process when the one that started it is no more."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
