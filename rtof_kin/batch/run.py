"""A batch: many recordings through a chain of commands, resumable, with a table and an index.

============================  ==================================================================
batch.csv                     one row for each recording that ended, sorted by name
index.html                    the same as a page, the worst verdict first
NAME/                         output of one recording: what its commands write
NAME/log/*.txt                what they printed
NAME/batch.json               what each finished command was made from, see `rtof_kin.batch.work`
.batch/                       rows as they came, locks, number of runs
============================  ==================================================================

Whether something is done is decided by the contents of files alone, never by their times or the clock.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Final

from rtof_kin.batch.chain import Step, files_in, steps_of, with_absolute_files
from rtof_kin.batch.index import write_index
from rtof_kin.batch.place import Place, claim
from rtof_kin.batch.recordings import Entry, Shard
from rtof_kin.batch.rows import ERROR, Row, RowFile
from rtof_kin.batch.work import DISK_FULL, Command, Task, process
from rtof_kin.core.errors import RtofError, WritingError
from rtof_kin.core.files.manifest import fingerprint
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs.engine import Engine
from rtof_kin.core.jobs.results import Progress

TABLE: Final = "batch.csv"


@dataclass(frozen=True)
class Batch:
    """What is to be done."""

    source: Path
    """Folder or manifest of the recordings."""
    entries: Sequence[Entry]
    """All of them, of all shards."""
    chain: tuple[Step, ...]
    out: Path
    version: str
    """Of the package; results of another one are made again."""
    shard: Shard = field(default_factory=Shard)


def run_batch(
    batch: Batch, command: Command, engine: Engine, overwrite: bool = False, progress: Progress | None = None
) -> list[Row]:
    """Run a batch, or what is left of it.

    Args:
        command: runs one command line; at the top level of a module.

    Returns:
        Rows of this shard's recordings, in their order.

    Raises:
        OutputExistsError: see `rtof_kin.batch.place.claim`. WritingError: the folder cannot be written, or
            the disk is full.
    """
    try:
        with claim(batch.out, batch.source, batch.shard, overwrite) as place:
            return _run(batch, place, command, engine, progress or (lambda done, total, text: None))
    except RtofError:
        raise
    except OSError as error:
        raise WritingError(f"{batch.out}: cannot be written ({error}); make room and go on") from error


def _run(batch: Batch, place: Place, command: Command, engine: Engine, report: Progress) -> list[Row]:
    own = [entry for entry in batch.entries if batch.shard.has(entry.name)]
    steps = {entry.name: steps_of(batch.chain, entry) for entry in own}
    names = {entry.name for entry in own}
    before = {name: row for name, row in place.rows().items() if name in names}
    rows = RowFile(place.rows_file, place.run, before)
    ended = {name for name, (_, row) in before.items() if row.verdict != ERROR}
    own.sort(key=lambda entry: entry.name in ended)  # what is new comes first
    title = batch.source.resolve().name
    tables = Tables(batch.out, title, frozenset(entry.name for entry in batch.entries), place)
    tables.write()
    report(0, len(own), f"{len(ended)} of {len(own)} have a result; it is checked" if ended else "")
    done = 0
    try:
        with closing(engine.run(partial(process, command), _tasks(batch, place, own, steps))) as results:
            for result in results:
                row = Row.of_plain(result.answer) or Row(result.key, error=str(result.lost))
                rows.add(row)
                done += 1
                failed = f"{row.recording} failed: {row.step + ': ' if row.step else ''}{row.error}"
                report(done, len(own), failed if row.verdict == ERROR else row.recording)
                if result.answer and result.answer.get(DISK_FULL):
                    raise WritingError(
                        f"{batch.out}: the disk is full ({failed}); make room, and the same command goes on"
                    )
                tables.write_if_due()
    finally:
        tables.write()
    return [rows.rows[entry.name][1] for entry in batch.entries if entry.name in names]


def _tasks(
    batch: Batch, place: Place, entries: Iterable[Entry], steps: dict[str, tuple[Step, ...]]
) -> Iterator[tuple[str, Task]]:
    """Yield the recordings with all that a worker needs; what options have in common is read once."""
    known: dict[tuple[Step, ...], tuple[tuple[Step, ...], tuple[str, ...]]] = {}
    for entry in entries:
        own = steps[entry.name]
        if own not in known:
            marks = [
                fingerprint(batch.version, place.generation, own[:k], files_in(own[:k])) for k in range(1, len(own) + 1)
            ]
            known[own] = tuple(map(with_absolute_files, own)), tuple(marks)
        absolute, made_from = known[own]
        yield (
            entry.name,
            Task(
                entry.name, entry.folder.resolve(), batch.out.resolve(), place.token, absolute, made_from, batch.version
            ),
        )


class Tables:
    """The table and the index, which are written now and then and at the end."""

    PAUSE: Final = 10.0
    """[s] between two writings."""
    SHARE: Final = 0.05
    """Share of the time that writing may take at most, so that long tables are written less often."""

    def __init__(self, out: Path, title: str, names: frozenset[str], place: Place):
        """Take the folder of the batch, the names of its source and of all its recordings, and its books."""
        self.out, self.title, self.names, self.place = out, title, names, place
        self._next = time.monotonic() + self.PAUSE

    def write_if_due(self) -> None:
        """Write them unless they were written a moment ago."""
        if time.monotonic() >= self._next:
            self.write()

    def write(self) -> None:
        """Write them with the rows of all shards."""
        began = time.monotonic()
        with self.place.table_lock():
            found = self.place.rows()
            rows = [row for name, (_, row) in sorted(found.items()) if name in self.names]
            write_text(self.out / TABLE, _csv(rows), overwrite=True)
            worst_first = sorted(rows, key=lambda row: row.severity)
            write_index(self.out, worst_first, len(self.names), self.title)
        took = time.monotonic() - began
        self._next = time.monotonic() + max(self.PAUSE, took / self.SHARE)


def _csv(rows: Iterable[Row]) -> str:
    text = io.StringIO(newline="")
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow([column.name for column in fields(Row)])
    lines.writerows(astuple(row) for row in rows)
    return text.getvalue()


Check = Callable[[list[str]], object]
"""Raises an error of the package for a command line that is wrong."""


def check_chain(batch: Batch, check: Check) -> None:
    """Check the command lines of all recordings before the first of them is run; equal ones once.

    Raises:
        RtofError: a command line is wrong; the message names the recording.
    """
    seen = set()
    for entry in batch.entries:
        if (steps := steps_of(batch.chain, entry)) in seen:
            continue
        seen.add(steps)
        for step in steps:
            try:
                check(step.line(entry.folder, batch.out / entry.name, overwrite=True))
            except RtofError as error:
                raise type(error)(f"{entry.name}, {step.command}: {error}") from error
