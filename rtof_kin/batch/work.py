"""What a worker does with one recording: the steps of the chain that are not done, and its row.

``batch.json`` in the recording's output says what each finished step was made from and what it wrote. It is
written before every step and at the end, so a run that was killed goes on with the step it was in.
"""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import hashlib
import json
import logging
import os
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rtof_kin.batch.recordings import MOTION, PAGE, Step, output_name
from rtof_kin.batch.rows import DONE, Row
from rtof_kin.core.errors import OutputExistsError, RtofError
from rtof_kin.core.files.folder import remove_leftovers
from rtof_kin.core.files.manifest import MANIFEST, fingerprint, make_folders, make_private
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs.memory import peak_memory, reset_peak

STATE: Final = "batch.json"
DISK_FULL: Final = "disk_full"  #: Entry of the plain row of a recording that failed because of it, as all others would
Command = Callable[[list[str]], int]  #: Runs a command line, raises its `RtofError`, and returns the exit code
_MB: Final = 1e6


@dataclass(frozen=True)
class Task:
    """One recording with all that its worker needs."""

    name: str
    recording: Path
    out: Path  #: Folder of the batch
    token: str  #: Content of the batch's mark, which proves that the worker sees the same folder
    steps: tuple[Step, ...]
    marks: tuple[str, ...]  #: Fingerprint of each step with those before it: version, options, files that these name
    version: str


def mark_of(out: Path) -> Path:
    """Return the file that marks the folder of a batch."""
    return out / ".batch" / "mark.json"


def process(command: Command, task: Task) -> dict[str, Any]:
    """Run the steps of a recording that are not done, and return its row as plain data."""
    state = None
    try:
        _check_shared(task)
        remove_leftovers(task.out / task.name)
        content = fingerprint(task.recording)
        state = _State.read(task)
        for step, mark in zip(task.steps, task.marks, strict=True):
            made_from = fingerprint(mark, content)
            if not state.is_done(step, made_from):
                _run_step(command, task, state, step, made_from)
        row = _with_figures(_verdict(task, state), task, state)
        state.keep(row)
        return row.plain()
    except (_StepError, RtofError, OSError) as error:
        # The recording by its name, and not where it lies: tables and pages are passed on.
        text = str(error).replace(str(task.recording), task.name).replace(f"{task.out}/", "")
        row, full = Row(task.name, error=text), _is_of_full_disk(error)
        if isinstance(error, _StepError):
            row = replace(row, step=error.step.command, log=_log_name(error.step))
    return _with_figures(row, task, state).plain() | {DISK_FULL: full}


def _is_of_full_disk(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


class _StepError(Exception):
    """A step that failed, and why."""

    def __init__(self, step: Step, problem: str):
        super().__init__(problem)
        self.step = step


class _State:
    """Contents of `STATE`."""

    def __init__(self, task: Task, steps: dict[str, Any], row: Any = None):
        self.folder, self.steps, self.row = task.out / task.name, steps, row

    @classmethod
    def read(cls, task: Task) -> _State:
        """Read what earlier runs did, if any; raises OutputExistsError: there are files that no batch wrote."""
        folder = task.out / task.name
        try:
            found = json.loads((folder / STATE).read_text(encoding="utf-8"))
            steps = found["steps"]
            if isinstance(steps, dict) and all(isinstance(step, dict) for step in steps.values()):
                return cls(task, steps, found.get("row"))
        except FileNotFoundError:
            # Temporary entries are those that a killed process leaves.
            if folder.is_symlink() or (
                folder.exists() and any(not path.name.startswith(".rtof_kin-") for path in folder.iterdir())
            ):
                raise OutputExistsError(
                    f"{folder}: contains files that no batch wrote; name another folder for the output"
                ) from None
        except (ValueError, KeyError, TypeError):
            pass  # damaged: nothing counts as done
        return cls(task, {})

    def write(self) -> None:
        content = {"steps": self.steps, "row": self.row}
        write_text(self.folder / STATE, json.dumps(content, indent=1) + "\n", overwrite=True)

    def is_done(self, step: Step, made_from: str) -> bool:
        """Return whether a step's result is there, complete, and made from the same."""
        found = self.steps.get(output_name(step), {})
        return found.get("made_from") == made_from and self.is_own(step, found)

    def is_own(self, step: Step, found: dict[str, Any]) -> bool:
        """Return whether the output is what a batch wrote."""
        digest = _digest(self.folder / (step.output or _log_name(step)))
        return digest is not None and found.get("output") == digest

    def begin(self, step: Step) -> None:
        """Note that a step writes its output from now on; raises OutputExistsError: a file of the user is there."""
        found = self.steps.get(output_name(step), {})
        path = self.folder / (step.output or _log_name(step))
        own = found.get("begun") or self.is_own(step, found) or path.is_dir()  # a folder has its manifest
        if step.output and path.exists() and not own:
            raise OutputExistsError(f"{path}: no batch wrote it, or it was changed; move it elsewhere")
        self.steps[output_name(step)], self.row = {"begun": True}, None
        self.write()

    def finish(self, step: Step, made_from: str, seconds: float, cpu_seconds: float) -> None:
        """Note the result of a step, which is written with the next one or with the row."""
        output = _digest(self.folder / (step.output or _log_name(step)))
        self.steps[output_name(step)] = {
            "made_from": made_from,
            "output": output,
            "seconds": round(seconds, 3),
            "cpu_seconds": round(cpu_seconds, 3),
            "peak_memory_mb": round((peak_memory() or 0) / _MB, 1),
        }

    def keep(self, row: Row) -> None:
        """Write the row of a recording all of whose steps are done, unless it is there."""
        if self.row != row.plain():
            self.row = row.plain()
            self.write()


def _check_shared(task: Task) -> None:
    """Raise unless this worker sees the output folder of the process that gave the task."""
    mark = mark_of(task.out)
    try:
        same = mark.read_text(encoding="utf-8") == task.token
    except OSError:
        same = False
    if not same:
        raise RtofError(f"{task.out}: is not the batch's folder on this machine; all must share it under one name")


def _run_step(command: Command, task: Task, state: _State, step: Step, made_from: str) -> None:
    state.begin(step)
    began, cpu_began = time.perf_counter(), _cpu_seconds()
    reset_peak()
    try:
        with _printing_to(state.folder / _log_name(step)):
            line = step.line(task.recording, state.folder, overwrite=True)
            code = command(line)
    except RtofError as error:
        raise _StepError(step, str(error)) from error
    except (Exception, SystemExit) as error:
        raise _StepError(step, f"{type(error).__name__}: {error}") from error
    if code:
        raise _StepError(step, f"a check does not hold, or was not possible (exit code {code})")
    state.finish(step, made_from, time.perf_counter() - began, _cpu_seconds() - cpu_began)


@contextlib.contextmanager
def _printing_to(path: Path) -> Iterator[None]:
    """Collect what is printed and logged, and the traceback of an error or a crash."""
    make_folders(path.parent)
    root = logging.getLogger()
    before = root.handlers[:]
    with path.open("w", encoding="utf-8", errors="replace") as stream:
        make_private(path)
        handler = logging.StreamHandler(stream)
        handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
        root.handlers = [handler]
        faulthandler.enable(stream)
        try:
            with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
                yield
        except RtofError as error:
            stream.write(f"error: {error}\n")
            raise
        except BaseException:
            stream.write(traceback.format_exc())
            raise
        finally:
            faulthandler.disable()
            root.handlers = before


def _cpu_seconds() -> float:
    """Return the time of the processor for this process and those it waited for."""
    return sum(os.times()[:4])


def _log_name(step: Step) -> str:
    return f"log/{step.command}.txt"


def _digest(path: Path) -> str | None:
    """Return the SHA-256 of a file, or of the manifest of a folder that has all its files; None without."""
    try:
        if path.is_dir():
            names = json.loads((path / MANIFEST).read_text(encoding="utf-8"))["sha256"]
            if not all((path / name).is_file() for name in names):
                return None
            path /= MANIFEST
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _verdict(task: Task, state: _State) -> Row:
    """Return the row of a recording all of whose steps succeeded."""
    row, last = Row(task.name, DONE, log=_log_name(task.steps[-1])), state.folder / PAGE
    if PAGE in state.steps and last.is_file():
        row = replace(row, report=PAGE)
    summary = state.folder / MOTION / "summary.json"
    if MOTION not in state.steps or not summary.is_file():
        return row
    found = json.loads(summary.read_text(encoding="utf-8"))
    frames, verdict = int(found["frames"]), found["verdict"]
    seconds = round(frames / found["rate_hz"], 3)
    certificate = found.get("certificate") or {}
    row = replace(row, certified_deg=certificate.get("error_deg"), certified_ratio=certificate.get("ratio"))
    return replace(row, verdict=verdict["grade"], sentence=verdict["headline"], frames=frames, duration_s=seconds)


def _with_figures(row: Row, task: Task, state: _State | None) -> Row:
    """Add what the results cost."""
    if state is None:
        return replace(row, version=task.version)
    steps = [state.steps.get(output_name(step), {}) for step in task.steps]
    results = (Path(place, name) for place, _, names in os.walk(state.folder) for name in names if name != STATE)
    return replace(
        row,
        version=task.version,
        seconds=round(sum(step.get("seconds", 0.0) for step in steps), 3),
        cpu_seconds=round(sum(step.get("cpu_seconds", 0.0) for step in steps), 3),
        peak_memory_mb=max((step.get("peak_memory_mb", 0.0) for step in steps), default=0.0),
        output_mb=round(sum(path.stat().st_size for path in results) / _MB, 3),
    )
