"""Reconstructions of the application: one after the other, each in a process of its own, which starts others for the
further cores.

What waits and what runs is kept with the recordings, so that a server that is started anew goes on; `run` keeps the
steps that are done.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.store import AT_WORK, FILES, SUBJECT, State, Store, Take, verdict
from rtof_kin.app.texts import TEXTS
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import RtofError, UndecidedError
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs import work_shared
from rtof_kin.core.jobs.engine import usable_cores
from rtof_kin.core.jobs.processes import end_with_parent
from rtof_kin.reporting.page import PAGE, review
from rtof_kin.setup.run import MOTION, make_recordings, run
from rtof_kin.setup.settings import ReconstructionTask

_CONTEXT: Final = multiprocessing.get_context("spawn")
_EVERY: Final = 0.2  # [s] between two reports of a stage
REVIEW: Final = "review.html"  #: Page of the motion beside its video
VIDEO: Final = "video"  #: Address of the video beside that of the page
REPORT: Final = "report"  #: Stage after all that are reported: angles and page


def write_review(folder: Path) -> None:
    """Write the page of a recording's result; errors of `review`."""
    filmed = Store.video(folder) is not None
    write_text(folder / REVIEW, review(folder / MOTION, VIDEO if filmed else ""), overwrite=True)


class Stages:
    """Stages of a reconstruction as they are reported, and the time that is left."""

    def __init__(self, earlier: Mapping[str, float]):
        """`earlier`: each stage of an earlier reconstruction, in order, and how long it took, s."""
        self.done: dict[str, tuple[int, int]] = {}  #: Stage -> steps done, and in all
        self.seconds: dict[str, float] = {}
        self._earlier, self._last, self._began = earlier, time.monotonic(), (0.0, 0)

    def report(self, stage: str, done: int, total: int) -> None:
        """Take one report."""
        now, spent = time.monotonic(), self.seconds.get(stage, 0.0)
        if stage not in self.done or done < self.done[stage][0]:
            self._began = spent, done  # maybe anew
        self.seconds[stage], self._last = spent + now - self._last, now
        self.done = {name: steps for name, steps in self.done.items() if name != stage} | {stage: (done, total)}

    @property
    def left(self) -> float | None:
        """Time left, s: of the present stage by its rate, of later ones by the earlier reconstruction; or None."""
        if not self.done:
            return sum(self._earlier.values()) or None
        *past, stage = self.done
        before = sum(self._earlier.get(name, 0.0) for name in past)
        pace = sum(self.seconds[name] for name in past if name in self._earlier) / before if before else 1.0
        later = pace * sum(s for name, s in self._earlier.items() if name not in self.done)
        (done, total), (spent, first) = self.done[stage], self._began
        if done > first:
            return (self.seconds[stage] - spent) * (total - done) / (done - first) + later
        expected = self._earlier.get(stage)
        return None if expected is None else max(0.0, pace * expected - self.seconds[stage]) + later


class Work:
    """The queue of a workspace, and what runs; only one of a workspace at a time."""

    def __init__(self, store: Store):
        """Go on with what waited or ran when the last one ended."""
        self.store = store
        self._changed, self._closed = threading.Condition(), False
        self._now: Path | None = None
        self._process: Any = None
        self._stages = Stages({})
        left = [path for path in store.takes() if store.take(path).state in AT_WORK]
        self._queue = sorted(left, key=lambda path: store.take(path).asked)
        for path in self._queue:
            store.change(path, state=State.WAITING)
        self.others: list[Callable[[Path], bool]] = []  #: Whether others are at work in a folder
        self._thread = threading.Thread(target=self._run, name="reconstructions", daemon=True)
        self._thread.start()

    def ask(self, folder: Path, look: bool = False) -> None:
        """Put a recording into the queue, or only to `look` at it before; errors of its files."""
        self.store.sources(folder)
        with self._changed:
            if folder != self._now and folder not in self._queue:
                self.store.change(folder, state=State.WAITING, asked=time.time(), said="", look=look, learned=())
                self._queue.append(folder)
                self._changed.notify()

    def cancel(self, folder: Path) -> None:
        """Take a recording out of the queue, or end its process; what was finished is kept."""
        with self._changed:
            if folder in self._queue:
                self._queue.remove(folder)
            elif folder == self._now:
                self._end()
            elif self.store.take(folder).state not in AT_WORK:  # else its end could not be written
                return
            self.store.change(folder, state=State.DRAFT)

    def stages(self, folder: Path) -> Stages | None:
        """Return the progress of a recording, None where it does not run."""
        return self._stages if folder == self._now else None

    def before(self, folder: Path) -> int:
        """Return how many are before a recording that waits."""
        with self._changed:
            place = self._queue.index(folder) if folder in self._queue else 0
            return place + (self._now is not None)

    def busy(self, folder: Path) -> bool:
        """Return whether something of a folder waits or runs."""
        with self._changed:
            own = any(one.is_relative_to(folder) for one in (*self._queue, *filter(None, [self._now])))
        return own or any(busy(folder) for busy in self.others)

    def close(self) -> None:
        """End; what runs or waits goes on with the next one."""
        with self._changed:
            self._closed = True
            self._end()
            self._changed.notify()
        self._thread.join()

    def _end(self) -> None:
        self._now = None
        if self._process is not None:
            self._process.terminate()  # the thread waits for it

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._queue)
                if self._closed:
                    return
                folder = self._now = self._queue.pop(0)
            try:
                outcome = self._reconstructed(folder)
            except (RtofError, OSError) as error:  # a full disk, or the folder is no more
                outcome = {"state": State.FAILED, "said": str(error)}
            with self._changed, suppress(RtofError):
                if self._now == folder:  # else it was cancelled
                    self._now = None
                    self.store.change(folder, **outcome)

    def _reconstructed(self, folder: Path) -> dict[str, Any]:
        """Run the process, read its reports until it ends, and return what changes in the `Take`."""
        look, outcome = self.store.take(folder).look, dict[str, Any]()
        self._stages = Stages({} if look else self._earlier())
        receiver, sender = _CONTEXT.Pipe(duplex=False)
        with receiver:
            with self._changed, sender:
                if self._now != folder:
                    return {}
                arguments = str(folder), self.store.change(folder, state=State.RUNNING), sender, usable_cores()
                process = self._process = _CONTEXT.Process(target=_reconstruct, args=arguments)
                process.start()
            with suppress(EOFError, OSError):
                while not outcome:
                    message = receiver.recv()
                    outcome = message if isinstance(message, dict) else {}
                    self._stages.report(*(message if not outcome else (REPORT, 1, 1)))
        process.join()
        how = TEXTS.lost.format(how=f"exit code {process.exitcode}")
        done = not look and outcome.get("state") in (State.DONE, State.ATTENTION)
        seconds = {"seconds": self.store.take(folder).seconds | self._stages.seconds} if done else {}
        return (outcome or {"state": State.FAILED, "said": how}) | seconds

    def _earlier(self) -> dict[str, float]:
        """Return the seconds by stage of the latest reconstruction."""
        done = [take for take in map(self.store.take, self.store.takes()) if REPORT in take.seconds]
        return max(done, key=lambda take: take.asked).seconds if done else {}


# --- in the process ------------------------------------------------------------------------------


def _reconstruct(place: str, take: Take, sender: Connection, cores: int) -> None:
    """Reconstruct a recording on some cores; sends (stage, steps done, in all), at last what changes in its `Take`."""
    end_with_parent()
    folder, sent = Path(place), ("", 0.0)

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal sent
        if stage != sent[0] or done in (0, total) or time.monotonic() - sent[1] > _EVERY:
            sent = stage, time.monotonic()
            sender.send((stage, done, total))

    learned = list[str]()
    try:
        files, setup, second = Store.setup(folder)
        subject = folder.parent.parent / SUBJECT
        learns = take.learn and not take.look
        task = ReconstructionTask(calibrate=True, subject=subject, update_subject=learns, threads=cores)
        how: dict[str, Any] = {"overwrite": True, "progress": progress}
        with without_warnings("rtof_kin"), work_shared(cores):
            if take.look:
                found = make_recordings(files, folder, setup, task, second, **how)
            else:
                found = run(files, folder, setup, task=task, second=second, learned=learned.append, **how).findings
        if not take.look:
            with suppress(RtofError):  # it is made again when it is asked for
                write_review(folder)
        state = State.DRAFT if take.look and not (folder / PAGE).is_file() else verdict(folder)
        sender.send({"state": state, "said": "", "places": found.places, "learned": tuple(learned)})
    except UndecidedError as error:
        sender.send({"state": State.ASKING, "said": "", "places": error.places})
    except Exception as error:
        said = str(error) if isinstance(error, RtofError) else f"{type(error).__name__}: {error}"
        sender.send({"state": State.FAILED, "said": said.replace(f"{folder / FILES}/", "").replace(f"{folder}/", "")})
