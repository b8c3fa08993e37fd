"""Many independent measurements on all cores, each kept as soon as it is done.

A job's result is a pair of files, ``KEY.npz`` (arrays) and then ``KEY.json`` (facts): a job whose facts
are there is not run again, so an interrupted run goes on where it stopped. A job that fails, even one
that kills its process, says why and does not stop the others; it is tried again in the next run.
"""

from __future__ import annotations

import json
import logging
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import OutputExistsError, RtofError, ShapeError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.files.text import write_text

Array = NDArray[np.float64]
SETTINGS = "settings.json"
_MADE_BY = {"made_by": "rtof_kin.protocols"}
"""By this a folder of results is known from others that have a file of that name."""
_KILLED = "its process was killed, also when it ran alone: is there too little memory for it?"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobResult:
    """What one job measured."""

    facts: dict[str, Any]
    """Plain values, as JSON carries them; NaN becomes None. 'methods' has what was measured by name."""
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
    motions: Mapping[str, Mapping[str, Path | None]],
) -> Path:
    """The folder for the results of jobs, and the one for their motions, made or gone on with.

    Both get a file ``settings.json``, by which they are known again. A job measured before whose motions
    are wanted now and not there counts as not done.

    Args:
        folder, save: the two; motions lie in ``SUBJECT/TAKE/CAMERA/MODE`` of the second.
        settings: all that the results depend on, plain values.
        overwrite: whether results of other settings may be removed.
        motions: files by the key of the job that writes them and the method they are of.

    Returns:
        Where `run_jobs` shall keep its results.

    Raises:
        OutputExistsError: other things are there, or results of other settings, and overwriting was
            not asked for. Then neither folder is touched.
        RtofError: one of them cannot be written.
    """
    settings = _MADE_BY | dict(settings)
    owned = {folder: "runs/*.json"} | ({save: "*/*/*/*/motion.npz"} if save else {})
    changed = {path: _check_owned(path, settings, overwrite) for path in owned}
    for path, results in owned.items():
        _take_over(path, settings, results if changed[path] else None)
    runs = folder / "runs"
    runs.mkdir(exist_ok=True)
    for key, files in motions.items():
        measured = (_facts(runs, key) or {}).get("methods", ())
        wanted = [file for method, file in files.items() if method in measured]
        if any(file is not None and not file.is_file() for file in wanted):
            (runs / f"{key}.json").unlink()
    return runs


def _check_owned(folder: Path, settings: Mapping[str, Any], overwrite: bool) -> bool:
    """Whether a folder holds results of other settings, which may be removed."""
    mark = folder / SETTINGS
    try:
        if not folder.is_dir() or not any(folder.iterdir()):
            return False
        before = json.loads(mark.read_text(encoding="utf-8")) if mark.is_file() else {}
        if not isinstance(before, dict) or any(before.get(k) != v for k, v in _MADE_BY.items()):
            raise OutputExistsError(f"{folder}: holds other things; name a new folder")
    except ValueError as error:  # of JSON and of Unicode
        raise OutputExistsError(f"{mark}: damaged ({error}); name a new folder") from error
    except RtofError:  # one of them is an OSError too
        raise
    except OSError as error:
        raise RtofError(f"{folder}: cannot be read ({error}); name another folder") from error
    other = [k for k in sorted({*before, *settings}) if before.get(k) != settings.get(k)]
    if other and not overwrite:
        raise OutputExistsError(
            f"{folder}: holds results of other settings ({', '.join(other)}); name another folder, "
            "or overwrite it (--overwrite)"
        )
    return bool(other)


def _take_over(folder: Path, settings: Mapping[str, Any], results: str | None) -> None:
    """Make a folder that is known by its settings, without files that match a pattern."""
    try:
        for path in folder.glob(results) if results else ():
            path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RtofError(f"{folder}: cannot be written ({error}); name another folder") from error
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    write_text(folder / SETTINGS, text, overwrite=True)


def _facts(folder: Path, key: str) -> dict[str, Any] | None:
    """What a job has found, if it is done; a damaged file counts as not done."""
    try:
        facts = json.loads((folder / f"{key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return facts if isinstance(facts, dict) else None


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
        progress: told after every job; without it, what fails is logged.

    Raises:
        ShapeError: fewer than one worker.
    """
    if workers is not None and workers < 1:
        raise ShapeError(f"workers: {workers} processes do no work; give 1 or more")
    tell = progress or (lambda done, total, text: None)
    waiting = {k: v for k, v in jobs.items() if _facts(folder, k) is None}
    failed: dict[str, str] = {}
    done = len(jobs) - len(waiting)
    tell(done, len(jobs), f"{done} of {len(jobs)} were done before" if done else "")
    with closing(_results(function, waiting, folder, workers or os.cpu_count() or 1)) as results:
        for key, problem in results:
            done += 1
            if problem is not None:
                failed[key] = problem
                if progress is None:
                    _log.warning("%s: %s", key, problem)
            tell(done, len(jobs), key if problem is None else f"{key} failed: {problem}")
    facts = {key: _facts(folder, key) for key in jobs if key not in failed}
    return Outcome(folder, {k: v for k, v in facts.items() if v is not None}, failed)


def _results(
    function: Callable[[Any], JobResult], jobs: Mapping[str, Any], folder: Path, workers: int
) -> Generator[tuple[str, str | None]]:
    """Each job's key as it ends, and why it failed or None."""
    if workers == 1:
        for key, argument in jobs.items():
            yield key, _work(function, key, argument, folder)
        return
    broken = []
    for key, problem in _in_processes(function, jobs, folder, workers) if jobs else ():
        if problem == _KILLED:
            broken.append(key)
        else:
            yield key, problem
    for key in broken:  # one of them ended the process of all: each gets one of its own
        yield from _in_processes(function, {key: jobs[key]}, folder, 1)


def _in_processes(
    function: Callable[[Any], JobResult], jobs: Mapping[str, Any], folder: Path, workers: int
) -> Generator[tuple[str, str | None]]:
    """`_results` of a pool of processes; `_KILLED` of what was not done when one of them ended."""
    with _one_thread_each(), _pool(min(workers, len(jobs))) as pool:
        futures = {pool.submit(_work, function, key, argument, folder): key for key, argument in jobs.items()}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except BrokenProcessPool:
                yield futures[future], _KILLED


def _work(function: Callable[[Any], JobResult], key: str, argument: Any, folder: Path) -> str | None:
    """Run one job and write its files; why it failed, or None."""
    try:
        result = function(argument)
        np.savez_compressed(folder / f"{key}.npz", **result.arrays)  # type: ignore[arg-type]
        partial = folder / f"{key}.json.part"
        partial.write_text(json.dumps(_plain(result.facts)) + "\n", encoding="utf-8")
        partial.replace(folder / f"{key}.json")
    except RtofError as error:
        return str(error)
    except Exception as error:  # one bad take must not stop a night's work
        _log.exception("%s", key)
        return f"{type(error).__name__}: {error}"
    return None


def _plain(value: Any) -> Any:
    """A value that every reader of JSON understands: NaN and infinity are none of its numbers."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes, which an exception in this one ends at once."""
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _ignore_interrupt)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
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
