"""Engine of worker processes on this machine: one thread each, warm, and no more than the memory held at the start.

A worker that is killed loses its own job only: a pool of the standard library, or of joblib, gives up all of its
jobs then. The job is tried once more when all others are done, alone, since most processes are killed for want of
memory. Workers end with the process that started them, even if that is killed.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, Final, TypeVar

from rtof_kin.core.environment import VARIABLES
from rtof_kin.core.errors import InvalidInputError, RtofError, SolverError
from rtof_kin.core.jobs.engine import Ended, cores_limited, ended, usable_cores
from rtof_kin.core.jobs.memory import available_memory, total_memory

_GB: Final = 1e9
_AT_ONCE: Final = 4  #: Workers that are started before there are jobs for them
_SHARE_BYTES: Final = 0.6e9  #: Memory of a process that shares the work
_CONTEXT: Final = multiprocessing.get_context("spawn")
_log = logging.getLogger(__name__)
_Job = tuple[str, Any]


@dataclass(frozen=True)
class Processes:
    """Engine of worker processes on this machine."""

    workers: int | None = None  #: Most of them; None: one per core that this process may use
    memory_per_job: float = 0.0
    """[bytes] that one job needs with its process: as many run at once as are available then; 0: not looked at."""
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
        with Workers(self, function) as workers:
            yield from workers.run(jobs)


class _Worker:
    """A process that does one job after the other."""

    def __init__(self, function: Callable[[Any], Any], *needed: Callable[..., Any]):
        self.connection, inner = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_serve, args=(inner, function, *needed))
        self.job: _Job | None = None
        self.done = 0
        with _on_its_own(function):
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


class Workers(AbstractContextManager["Workers"]):
    """Processes that do the jobs of several runs, one run after the other; a context that ends them."""

    def __init__(self, settings: Processes, function: Callable[[Any], Any], *needed: Callable[..., Any]):
        self.settings, self.most = settings, settings.workers or usable_cores()
        self.start = partial(_Worker, function, *needed)
        if settings.memory_per_job and (available := available_memory()) is not None:
            self.most = max(1, min(self.most, int(available // settings.memory_per_job)))
        self.idle: list[_Worker] = []
        self.busy: list[_Worker] = []

    def __exit__(self, *_: object) -> None:
        """End them; those that have a job are terminated."""
        workers = [*self.busy, *self.idle]
        for worker in workers:
            worker.connection.close()
            if worker.job is not None:
                worker.process.terminate()
        for worker in workers:
            worker.process.join()

    def begin(self) -> None:
        """Start some of them now: the modules of all functions are imported before the first job is known."""
        self.idle += [self.start() for _ in range(min(self.most, _AT_ONCE))]

    def run(self, jobs: Iterable[_Job]) -> Iterator[Ended]:
        """Run jobs, see `Engine.run`; it has to be exhausted before the next run."""
        again = list[_Job]()
        for job, answer in self._ended(iter(jobs)):
            if job is None:
                yield answer
            else:
                _log.warning("%s: %s; tried once more when all others are done", job[0], answer.lost)
                again.append(job)
        for one in again:
            for job, answer in self._ended(iter([one])):
                reason = f"{answer.lost}, also when it ran alone: is there too little memory for it?"
                yield answer if job is None else Ended(answer.key, lost=reason)

    def _ended(self, jobs: Iterator[_Job]) -> Iterator[tuple[_Job | None, Ended]]:
        """Yield each job that ended; with the job itself where its process was lost."""
        answers, ahead = list[tuple[_Job | None, Ended]](), list[_Job]()
        try:
            while True:
                given = list[tuple[_Worker, _Job]]()
                for job in islice(chain(ahead, jobs), self.most - len(self.busy)):
                    given.append((self.idle.pop() if self.idle else self.start(), job))
                    self.busy.append(given[-1][0])
                for worker, job in given:  # all have begun: a large job waits until its worker has
                    worker.give(job)
                ahead = list(islice(jobs, 1))  # is made, and answers are used, while they work
                yield from answers
                if not self.busy:
                    return
                ready = wait([worker.connection for worker in self.busy])
                answers = []
                for worker in [worker for worker in self.busy if worker.connection in ready]:
                    self.busy.remove(worker)
                    lost, answer = worker.take()
                    answers.append((lost, answer))
                    if lost is not None or worker.done >= self.settings.jobs_per_worker:
                        worker.connection.close()
                    else:
                        self.idle.append(worker)
        finally:  # also if nobody wants the others
            for worker in self.busy:
                worker.process.terminate()
                worker.connection.close()
            self.busy.clear()


_T = TypeVar("_T")
_sharing: Final = ContextVar[Workers | None]("workers of `in_order`", default=None)


@contextmanager
def work_shared(cores: int | None = None, *needed: Callable[..., Any]) -> Iterator[None]:
    """Let `in_order` and `side_by_side` inside use so many processes, by default one per usable core; nothing changes
    where that is one, or inside another such context. They import the modules of the functions that are needed at once.
    """
    if is_shared() or (cores or usable_cores()) == 1:
        yield
        return
    with cores_limited(cores), Workers(Processes(cores, memory_per_job=_SHARE_BYTES), outcome, *needed) as workers:
        before = _sharing.set(workers)
        try:
            workers.begin()
            yield
        finally:
            _sharing.reset(before)


def is_shared() -> bool:
    """Return whether tasks of `in_order` are given to other processes."""
    return _sharing.get() is not None


def side_by_side(function: Callable[[Any], _T], items: Iterable[Any]) -> Iterator[_T]:
    """Yield a function's results in order; it raises its errors."""
    with closing(in_order(partial(function, item) for item in items)) as results:
        for found in results:
            if isinstance(found, RtofError):
                raise found
            yield found


def in_order(tasks: Iterable[Callable[[], _T] | RtofError]) -> Generator[_T | RtofError, None, None]:
    """Yield the `outcome` of each task, by other processes inside `work_shared`, unless they are at work already."""
    workers = _sharing.get()
    if workers is None or workers.busy:
        yield from map(outcome, tasks)
        return
    early, due = dict[str, Ended](), 0
    for one in workers.run((str(number), task) for number, task in enumerate(tasks)):
        early[one.key] = one
        while (found := early.pop(str(due), None)) is not None:
            due += 1
            yield SolverError(found.lost) if found.lost else found.answer


def outcome(task: Callable[[], _T] | RtofError) -> _T | RtofError:
    """Return what a task returned, or the error that it raised or that is in its place."""
    try:
        return task if isinstance(task, RtofError) else task()
    except RtofError as error:
        return error


@contextmanager
def _on_its_own(function: Callable[[Any], Any]) -> Iterator[None]:
    """Let libraries of a process that is started have one thread, and one for `in_order` not run this one's script."""
    environment, script = dict(os.environ), sys.modules["__main__"]
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    if function is outcome:
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        for name in VARIABLES:
            del os.environ[name]
        os.environ.update({name: environment[name] for name in VARIABLES if name in environment})


# --- in the worker -------------------------------------------------------------------------------


def _serve(connection: Connection, function: Callable[[Any], Any], *_: Callable[..., Any]) -> None:
    """Do the jobs that come until the connection is closed."""
    end_with_parent()
    if function is outcome:  # the process that shares its work warns itself
        logging.getLogger("rtof_kin").setLevel(logging.ERROR)
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


def end_with_parent() -> None:
    """Leave Ctrl-C to the process that started this one, and end this one when that is no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
