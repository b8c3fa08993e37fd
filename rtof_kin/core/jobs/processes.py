"""Engine of worker processes on this machine: one thread each, warm, and no more than the memory holds.

A worker that is killed loses its own job only. The job is tried once more when all others are done, alone, since most
processes are killed for want of memory. Workers end with the process that started them, even if that is killed.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Processes:
    """Engine of worker processes on this machine."""

    workers: int | None = None
    """Most of them; None: one per core that this process may use."""
    memory_per_job: float = 0.0
    """[bytes] that one job needs with its process. None starts while less is available; 0: not looked at."""
    jobs_per_worker: int = 200
    """A worker that has done as many is replaced by a new one."""

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
        pool = _Pool(self, function, self._most())
        try:
            again = []
            for job, answer in pool.run(iter(jobs)):
                if answer.lost is None or job is None:
                    yield answer
                else:
                    _log.warning("%s: %s; tried once more when all others are done", job[0], answer.lost)
                    again.append(job)
            for job in again:
                for _, answer in pool.run(iter([job])):
                    reason = f"{answer.lost}, also when it ran alone: is there too little memory for it?"
                    yield answer if answer.lost is None else Ended(answer.key, lost=reason)
        finally:
            pool.end()

    def _most(self) -> int:
        """Return the number of workers that cores and memory allow."""
        most, total = self.workers or usable_cores(), total_memory()
        if not self.memory_per_job or total is None:
            return most
        return max(1, min(most, int(total // self.memory_per_job)))


_Job = tuple[str, Any]


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

    @property
    def memory(self) -> int:
        """Resident memory, bytes."""
        return resident_memory(self.process.pid or 0)

    def give(self, job: _Job) -> None:
        self.job, self.done = job, self.done + 1
        with suppress(BrokenPipeError):  # it was killed: `take` tells
            self.connection.send(job)

    def take(self) -> Ended:
        """Return what the job gave, or that its process is no more."""
        job, self.job = self.job, None
        assert job is not None
        try:
            answer: Ended = self.connection.recv()
            return answer
        except (EOFError, ConnectionError):
            self.process.join()
            code = self.process.exitcode or 0
            how = f"killed (signal {-code})" if code < 0 else f"ended (exit code {code})"
            return Ended(job[0], lost=f"its process was {how}")

    def end(self) -> None:
        """Let a worker without a job end; terminate one with a job."""
        self.connection.close()
        if self.job is not None:
            self.process.terminate()


class _Pool:
    """The workers of a run."""

    def __init__(self, settings: Processes, function: Callable[[Any], Any], most: int):
        self.settings, self.function, self.most = settings, function, most
        self.idle: list[_Worker] = []
        self.busy: list[_Worker] = []
        self._reminded = -_REMIND

    def run(self, jobs: Iterator[_Job]) -> Iterator[tuple[_Job | None, Ended]]:
        """Yield each job that ended; with the job itself where its process was lost."""
        waiting = deque(_first(jobs))
        while waiting or self.busy:
            while waiting and len(self.busy) < self.most and self._memory_is_enough():
                self._start(waiting.popleft())
                waiting.extend(_first(jobs))
            held_back = waiting and len(self.busy) < self.most
            if not self.busy:
                time.sleep(_POLL)
                continue
            ready = wait([worker.connection for worker in self.busy], _POLL if held_back else None)
            for worker in [worker for worker in self.busy if worker.connection in ready]:
                job = worker.job
                self.busy.remove(worker)
                answer = worker.take()
                lost = worker.process.exitcode is not None
                if lost or worker.done >= self.settings.jobs_per_worker:
                    worker.end()
                else:
                    self.idle.append(worker)
                yield job if lost else None, answer

    def _start(self, job: _Job) -> None:
        worker = self.idle.pop() if self.idle else _Worker(self.function)
        self.busy.append(worker)
        worker.give(job)

    def _memory_is_enough(self) -> bool:
        """Return whether the memory is enough for one more job when those that run have all they need."""
        need, available = self.settings.memory_per_job, available_memory()
        if not need or available is None:
            return True
        promised = sum(max(0.0, need - worker.memory) for worker in self.busy)
        own = self.idle[-1].memory if self.idle else 0
        if available - promised >= need - own:
            return True
        if not self.busy and self.idle:  # they are warm, but hold memory
            self._let_go(self.idle)
        if not self.busy and time.monotonic() - self._reminded >= _REMIND:
            self._reminded = time.monotonic()
            _log.warning(
                "waiting for memory: a job needs %.1f GB, and %.1f GB are available", need / _GB, available / _GB
            )
        return False

    def _let_go(self, workers: list[_Worker]) -> None:
        for worker in workers:
            worker.end()
        for worker in workers:
            worker.process.join()
        workers.clear()

    def end(self) -> None:
        """End all workers; those that have a job are terminated."""
        self._let_go(self.busy)
        self._let_go(self.idle)


def _first(jobs: Iterator[_Job]) -> list[_Job]:
    """Return the next job, if there is one."""
    return [job for job in [next(jobs, None)] if job is not None]


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
