"""Results of jobs in a folder, each kept as soon as it is done.

A job's result is a pair of files, ``KEY.npz`` (arrays) and then ``KEY.json`` (facts, written atomically). A
job whose facts exist is not run again, so an interrupted run resumes. A job that fails, even one that kills
its process, is reported and does not stop the others; the next run tries it again.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import OutputExistsError, RtofError
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs.engine import Engine, InThisProcess
from rtof_kin.core.jobs.processes import Processes

SETTINGS: Final = "settings.json"
_MADE_BY: Final = {"made_by": "rtof_kin.protocols"}  #: Entry of the settings that marks a folder of results
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobResult:
    """Result of one job."""

    facts: dict[str, Any]  #: Plain values, as in JSON; NaN becomes None. 'methods' has what was measured by name.
    arrays: dict[str, Array] = field(default_factory=dict)  #: Curves and poses, for figures


@dataclass(frozen=True)
class Outcome:
    """Results of a set of jobs."""

    folder: Path
    done: dict[str, dict[str, Any]]  #: Facts of every job that succeeded, by key, in the order of the jobs
    failed: dict[str, str]  #: Error messages of the others

    def arrays(self, key: str) -> dict[str, Array]:
        """Read the arrays of a job that succeeded."""
        return read_npz(self.folder / f"{key}.npz")


Progress = Callable[[int, int, str], None]  #: Called with (jobs done, jobs in all, last event)


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
        overwrite: whether results of other settings may be removed.
        motions: files by the key of the job that writes them and by method.

    Returns:
        The folder for `run_jobs`.

    Raises:
        OutputExistsError: a folder holds other files, or results of other settings and `overwrite` is
            False; then neither folder is changed. RtofError: one of them cannot be written.
    """
    settings = _MADE_BY | dict(settings)
    owned = {folder: "runs/*.json"} | ({save: "*/*/*/*/motion.h5"} if save else {})
    outdated = {path: _holds_other_results(path, settings, overwrite) for path in owned}
    for path, results in owned.items():
        try:
            for result in path.glob(results) if outdated[path] else ():
                result.unlink()
            make_folders(path)
        except OSError as error:
            raise RtofError(f"{path}: cannot be written ({error}); name another folder") from error
        text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
        write_text(path / SETTINGS, text, overwrite=True)
    runs = folder / "runs"
    make_folders(runs)
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
        what = f"{folder}: holds results of other settings ({', '.join(other)})"
        raise OutputExistsError(f"{what}; name another folder, or overwrite it (--overwrite)")
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
    engine: Engine | None = None,
) -> Outcome:
    """Run the jobs that have no result yet in parallel processes. `InvalidInputError`: fewer than one worker.

    Args:
        function: at the top level of a module; called with one job's argument.
        jobs: argument of each job by its key. folder: for the results, see `open_runs`.
        workers: number of processes, the number of cores by default; 1 runs in this process.
        progress: called after every job; without it, failures are logged.
        engine: instead of processes of this machine; its workers write to `folder`.
    """
    if engine is None:
        engine = InThisProcess() if workers == 1 else Processes(workers)
    report = progress or (lambda done, total, text: None)
    waiting = {k: v for k, v in jobs.items() if _facts(folder, k) is None}
    failed: dict[str, str] = {}
    done = len(jobs) - len(waiting)
    report(done, len(jobs), f"{done} of {len(jobs)} were done before" if done else "")
    keyed = ((key, (key, argument)) for key, argument in waiting.items())
    with closing(engine.run(partial(_work, function, folder), keyed)) as results:
        for ended in results:
            done += 1
            problem = ended.lost or ended.answer
            if problem is not None:
                failed[ended.key] = problem
                if progress is None:
                    _log.warning("%s: %s", ended.key, problem)
            report(done, len(jobs), ended.key if problem is None else f"{ended.key} failed: {problem}")
    facts = {key: _facts(folder, key) for key in jobs if key not in failed}
    return Outcome(folder, {k: v for k, v in facts.items() if v is not None}, failed)


def _work(function: Callable[[Any], JobResult], folder: Path, job: tuple[str, Any]) -> str | None:
    """Run one job and write its files; return the reason of a failure or None."""
    key, argument = job
    try:
        result = function(argument)
        np.savez_compressed(folder / f"{key}.npz", **result.arrays)  # type: ignore[arg-type]
        write_text(folder / f"{key}.json", json.dumps(_plain(result.facts)) + "\n", overwrite=True)
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
