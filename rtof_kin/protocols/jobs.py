"""Many independent measurements on all cores, each kept as soon as it is done.

A job's result is a pair of files, ``KEY.npz`` (arrays) and then ``KEY.json`` (facts): a job whose facts
are there is not run again, so an interrupted run goes on where it stopped. A job that fails says why
and does not stop the others; it is tried again in the next run.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.errors import OutputExistsError, RtofError
from rtof_kin.io.arrays import read_npz

Array = NDArray[np.float64]
SETTINGS = "settings.json"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobResult:
    """What one job measured."""

    facts: dict[str, Any]
    """Plain values, as JSON carries them."""
    arrays: dict[str, Array] = field(default_factory=dict)
    """Curves and poses, for pictures."""


@dataclass(frozen=True)
class Outcome:
    """What became of a set of jobs."""

    folder: Path
    done: dict[str, dict[str, Any]]
    """Facts of every job that succeeded, by key, in the order of the jobs."""
    failed: dict[str, str]
    """Why each of the others did not."""

    def arrays(self, key: str) -> dict[str, Array]:
        """The arrays of a job that succeeded."""
        return read_npz(self.folder / f"{key}.npz")


Progress = Callable[[int, int, str], None]
"""Called with (jobs done, jobs in all, what happened last)."""


def open_runs(
    folder: Path,
    settings: Mapping[str, Any],
    overwrite: bool,
    save: Path | None,
    motions: Mapping[str, Sequence[Path | None]],
) -> Path:
    """The folder for the results of jobs, and the one for their motions, made or gone on with.

    A job measured before whose motions are wanted now and not there counts as not done.

    Args:
        folder, save: see `_own_folder`; motions lie in ``SUBJECT/TAKE/CAMERA/MODE`` of the second.
        settings: all that the results depend on. overwrite: whether those of others may be removed.
        motions: files by the key of the job that writes them.

    Returns:
        Where `run_jobs` shall keep its results.
    """
    _own_folder(folder, settings, overwrite, "runs/*.json")
    if save is not None:
        _own_folder(save, settings, overwrite, "*/*/*/*/motion.npz")
    runs = folder / "runs"
    runs.mkdir(exist_ok=True)
    for key, files in motions.items():
        if any(file is not None and not file.is_file() for file in files):
            (runs / f"{key}.json").unlink(missing_ok=True)
    return runs


def _own_folder(folder: Path, settings: Mapping[str, Any], overwrite: bool, results: str) -> None:
    """Make a folder for the results of these settings, or go on in it.

    Args:
        folder: gets a file ``settings.json``, by which it is known again.
        settings: all that the results depend on, plain values.
        overwrite: whether results of other settings may be removed.
        results: pattern of the files that are results.

    Raises:
        OutputExistsError: other things are there, or results of other settings, and overwriting was
            not asked for.
        RtofError: it cannot be written.
    """
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    mark = folder / SETTINGS
    try:
        if folder.is_dir() and any(folder.iterdir()) and not mark.is_file():
            raise OutputExistsError(f"{folder}: holds other things; name a new folder")
        if mark.is_file() and mark.read_text(encoding="utf-8") != text:
            if not overwrite:
                raise OutputExistsError(
                    f"{folder}: holds results of other settings ({_difference(mark, settings)}); "
                    "name another folder, or overwrite it"
                )
            for path in folder.glob(results):
                path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        mark.write_text(text, encoding="utf-8")
    except RtofError:  # one of them is an OSError too
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise RtofError(f"{folder}: cannot be written ({error}); name another folder") from error


def _difference(mark: Path, settings: Mapping[str, Any]) -> str:
    """Which settings differ, for a message."""
    try:
        before = json.loads(mark.read_text(encoding="utf-8"))
        keys = [k for k in sorted({*before, *settings}) if before.get(k) != settings.get(k)]
    except (ValueError, TypeError, AttributeError):
        return f"{mark.name} is damaged"
    return ", ".join(keys)


def run_jobs(
    function: Callable[[Any], JobResult],
    jobs: Mapping[str, Any],
    folder: Path,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Run what has no result yet, in as many processes as there are cores.

    Args:
        function: at the top level of a module; called with one job's argument.
        jobs: argument of each job by its key.
        folder: where results lie; see `open_runs`.
        workers: processes; 1 runs in this one. As many as cores where not given.
        progress: told after every job.
    """
    tell = progress or (lambda done, total, text: None)
    waiting = {k: v for k, v in jobs.items() if not (folder / f"{k}.json").is_file()}
    failed: dict[str, str] = {}
    done = len(jobs) - len(waiting)
    tell(done, len(jobs), f"{done} of {len(jobs)} were done before" if done else "")
    for key, problem in _results(function, waiting, folder, workers or os.cpu_count() or 1):
        done += 1
        if problem is not None:
            failed[key] = problem
            _log.warning("%s: %s", key, problem)
        tell(done, len(jobs), key if problem is None else f"{key} failed: {problem}")
    facts = {
        key: json.loads((folder / f"{key}.json").read_text(encoding="utf-8"))
        for key in jobs
        if key not in failed
    }
    return Outcome(folder, facts, failed)


def _results(
    function: Callable[[Any], JobResult], jobs: Mapping[str, Any], folder: Path, workers: int
) -> Iterator[tuple[str, str | None]]:
    """Each job's key as it ends, and why it failed or None."""
    workers = min(workers, len(jobs))
    if workers <= 1:
        for key, argument in jobs.items():
            yield key, _work(function, key, argument, folder)
        return
    with _one_thread_each(), _pool(workers) as pool:
        futures = {
            pool.submit(_work, function, key, argument, folder): key
            for key, argument in jobs.items()
        }
        for future in as_completed(futures):
            yield futures[future], _answer(future)


def _answer(future: Future[str | None]) -> str | None:
    try:
        return future.result()
    except BrokenProcessPool:
        return "its process was killed, probably for want of memory; use fewer workers"


def _work(
    function: Callable[[Any], JobResult], key: str, argument: Any, folder: Path
) -> str | None:
    """Run one job and write its files; why it failed, or None."""
    try:
        result = function(argument)
    except RtofError as error:
        return str(error)
    except Exception as error:  # one bad take must not stop a night's work
        _log.exception("%s", key)
        return f"{type(error).__name__}: {error}"
    np.savez_compressed(folder / f"{key}.npz", **result.arrays)  # type: ignore[arg-type]
    partial = folder / f"{key}.json.part"
    partial.write_text(json.dumps(result.facts) + "\n", encoding="utf-8")
    partial.replace(folder / f"{key}.json")
    return None


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes, which an exception in this one ends at once."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _ignore_interrupt)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    pool.shutdown()


def _ignore_interrupt() -> None:
    """The parent alone answers Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started inside compute with one thread each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
