"""Independent measurements in parallel processes, each kept as soon as it is done.

A job's result is a pair of files, ``KEY.npz`` (arrays) and then ``KEY.json`` (facts, written atomically). A
job whose facts exist is not run again, so an interrupted run resumes. A job that fails, even one that kills
its process, is reported and does not stop the others; the next run tries it again.
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
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.files.text import write_text

SETTINGS: Final = "settings.json"
_MADE_BY: Final = {"made_by": "rtof_kin.protocols"}
"""Entry of the settings that marks a folder of results."""
_KILLED: Final = "its process was killed, also when it ran alone: is there too little memory for it?"
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobResult:
    """Result of one job."""

    facts: dict[str, Any]
    """Plain values, as in JSON; NaN becomes None. 'methods' has what was measured by name."""
    arrays: dict[str, Array] = field(default_factory=dict)
    """Curves and poses, for figures."""


@dataclass(frozen=True)
class Outcome:
    """Results of a set of jobs."""

    folder: Path
    done: dict[str, dict[str, Any]]
    """Facts of every job that succeeded, by key, in the order of the jobs."""
    failed: dict[str, str]
    """Error messages of the others."""

    def arrays(self, key: str) -> dict[str, Array]:
        """Read the arrays of a job that succeeded.

        Args:
            key: of the job.
        """
        return read_npz(self.folder / f"{key}.npz")


Progress = Callable[[int, int, str], None]
"""Called with (jobs done, jobs in all, last event)."""


def open_runs(
    folder: Path,
    settings: Mapping[str, Any],
    overwrite: bool,
    save: Path | None,
    motions: Mapping[str, Mapping[str, Path | None]],
) -> Path:
    """Make or reopen the folder for the results of jobs, and the one for their motions.

    Both get a file ``settings.json`` that identifies them. A finished job whose motions are wanted now and
    do not exist counts as not done.

    Args:
        folder, save: the two; motions lie in ``SUBJECT/TAKE/CAMERA/MODE`` of the second.
        settings: everything that the results depend on, plain values.
        overwrite: whether results of other settings may be removed.
        motions: files by the key of the job that writes them and by method.

    Returns:
        The folder for `run_jobs`.

    Raises:
        OutputExistsError: a folder holds other files, or results of other settings and `overwrite` is
            False; then neither folder is changed. RtofError: one of them cannot be written.
    """
    settings = _MADE_BY | dict(settings)
    owned = {folder: "runs/*.json"} | ({save: "*/*/*/*/motion.npz"} if save else {})
    outdated = {path: _holds_other_results(path, settings, overwrite) for path in owned}
    for path, results in owned.items():
        try:
            for result in path.glob(results) if outdated[path] else ():
                result.unlink()
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RtofError(f"{path}: cannot be written ({error}); name another folder") from error
        text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
        write_text(path / SETTINGS, text, overwrite=True)
    runs = folder / "runs"
    runs.mkdir(exist_ok=True)
    for key, files in motions.items():
        measured = (_facts(runs, key) or {}).get("methods", ())
        if any(file and method in measured and not file.is_file() for method, file in files.items()):
            (runs / f"{key}.json").unlink()
    return runs


def _holds_other_results(folder: Path, settings: Mapping[str, Any], overwrite: bool) -> bool:
    """Return whether a folder holds results of other settings, if these may be removed."""
    mark = folder / SETTINGS
    try:
        if not folder.is_dir() or not any(folder.iterdir()):
            return False
        before = json.loads(mark.read_text(encoding="utf-8")) if mark.is_file() else None
    except (ValueError, OSError) as error:
        raise OutputExistsError(f"{mark}: cannot be read ({error}); name a new folder") from error
    if not isinstance(before, dict) or not before.items() >= _MADE_BY.items():
        raise OutputExistsError(f"{folder}: holds other files; name a new folder")
    other = [k for k in sorted({*before, *settings}) if before.get(k) != settings.get(k)]
    if other and not overwrite:
        raise OutputExistsError(
            f"{folder}: holds results of other settings ({', '.join(other)}); name another folder, "
            "or overwrite it (--overwrite)"
        )
    return bool(other)


def _facts(folder: Path, key: str) -> dict[str, Any] | None:
    """Read the facts of a finished job; a damaged file counts as not done."""
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
    """Run the jobs that have no result yet in parallel processes.

    Args:
        function: at the top level of a module; called with one job's argument.
        jobs: argument of each job by its key. folder: for the results, see `open_runs`.
        workers: number of processes, the number of cores by default; 1 runs in this process.
        progress: called after every job; without it, failures are logged.

    Raises:
        InvalidInputError: fewer than one worker.
    """
    if workers is not None and workers < 1:
        raise InvalidInputError(f"workers: {workers}; give 1 or more")
    report = progress or (lambda done, total, text: None)
    waiting = {k: v for k, v in jobs.items() if _facts(folder, k) is None}
    failed: dict[str, str] = {}
    done = len(jobs) - len(waiting)
    report(done, len(jobs), f"{done} of {len(jobs)} were done before" if done else "")
    run = _in_this_process if workers == 1 else _in_processes
    with closing(run(function, waiting, folder, workers or os.cpu_count() or 1)) as results:
        for key, problem in results:
            done += 1
            if problem is not None:
                failed[key] = problem
                if progress is None:
                    _log.warning("%s: %s", key, problem)
            report(done, len(jobs), key if problem is None else f"{key} failed: {problem}")
    facts = {key: _facts(folder, key) for key in jobs if key not in failed}
    return Outcome(folder, {k: v for k, v in facts.items() if v is not None}, failed)


_Ended = tuple[str, str | None]
"""A job's key and the reason of its failure or None."""


def _in_this_process(
    function: Callable[[Any], JobResult], jobs: Mapping[str, Any], folder: Path, _: int
) -> Generator[_Ended]:
    for key, argument in jobs.items():
        yield key, _work(function, key, argument, folder)


def _in_processes(
    function: Callable[[Any], JobResult], jobs: Mapping[str, Any], folder: Path, workers: int
) -> Generator[_Ended]:
    """Run jobs in a pool; those that were lost with a killed process run again, one pool each."""
    broken = []
    if jobs:
        with _pool(min(workers, len(jobs))) as pool:
            futures = {pool.submit(_work, function, key, jobs[key], folder): key for key in jobs}
            for future in as_completed(futures):
                try:
                    yield futures[future], future.result()
                except BrokenProcessPool:
                    broken.append(futures[future])
    for key in broken:
        if len(jobs) == 1:
            yield key, _KILLED
        else:
            yield from _in_processes(function, {key: jobs[key]}, folder, 1)


def _work(function: Callable[[Any], JobResult], key: str, argument: Any, folder: Path) -> str | None:
    """Run one job and write its files; return the reason of a failure or None."""
    try:
        result = function(argument)
        np.savez_compressed(folder / f"{key}.npz", **result.arrays)  # type: ignore[arg-type]
        partial = folder / f"{key}.json.part"
        partial.write_text(json.dumps(_plain(result.facts)) + "\n", encoding="utf-8")
        partial.replace(folder / f"{key}.json")
    except RtofError as error:
        return str(error)
    except Exception as error:
        _log.exception("%s", key)
        return f"{type(error).__name__}: {error}"
    return None


def _plain(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not have, by None."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start new processes of one thread each; an exception in this process terminates them."""
    others = set(multiprocessing.active_children())
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    # Only the parent handles Ctrl-C.
    ignore_interrupt = signal.SIGINT, signal.SIG_IGN
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, signal.signal, ignore_interrupt)
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        for name in _THREADS:
            del os.environ[name]
        os.environ.update({name: before[name] for name in _THREADS if name in before})
