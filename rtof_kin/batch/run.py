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

import json
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import astuple, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

from rtof_kin.batch.recordings import Entry, Shard, Step, files_in, steps_of, with_absolute_files
from rtof_kin.batch.rows import ERROR, Numbered, Row, RowFile, read_rows, write_index
from rtof_kin.batch.work import DISK_FULL, Command, Task, mark_of, process
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError, WritingError
from rtof_kin.core.files.folder import is_held, only_one
from rtof_kin.core.files.manifest import fingerprint, make_folders
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs.engine import Engine
from rtof_kin.core.jobs.results import Progress
from rtof_kin.reporting.document import Table, write_csv

BOOKS: Final = ".batch"  #: Folder of the bookkeeping in the output


@dataclass(frozen=True)
class Place:
    """A folder of a batch that this process has a shard of."""

    out: Path
    shard: Shard
    run: int  #: Number of this run; later runs have larger ones
    generation: int  #: Number of times that everything was to be done again
    token: str  #: Content of the folder's mark

    @property
    def rows_file(self) -> Path:
        """File of this shard's rows."""
        return self.out / BOOKS / f"{_name(self.shard)}.jsonl"

    def rows(self) -> dict[str, Numbered]:
        """Return the latest row of every recording, of all shards."""
        return read_rows(sorted((self.out / BOOKS).glob("*.jsonl")))


@contextmanager
def claim(out: Path, source: Path, shard: Shard, overwrite: bool) -> Iterator[Place]:
    """Make or reopen the folder of a batch, and keep other processes from the same shard. `OutputExistsError`: it holds
    other files or results of another source, or another process is at work; `WritingError`: it cannot be written;
    `InvalidInputError`: a shard cannot overwrite.
    """
    if overwrite and shard.count > 1:
        raise InvalidInputError("a shard does not overwrite what others may just have made; name a new folder")
    books = out / BOOKS
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"{out}: is a file; name a folder")
    if out.is_dir() and not mark_of(out).is_file() and {path.name for path in out.iterdir()} - {BOOKS}:
        raise OutputExistsError(f"{out}: contains files that no batch wrote; name a new folder")
    try:
        make_folders(books)
    except OSError as error:
        raise WritingError(f"{out}: cannot be written ({error}); name another folder") from error
    with ExitStack() as held:
        held.enter_context(only_one(books / f"{_name(shard)}.lock", f"{out}, shard {shard}"))
        with FileLock(books / "table.lock"):
            _check_others(books, out, shard)
            mark = mark_of(out)
            if not mark.is_file():
                write_text(mark, json.dumps({"batch": secrets.token_hex(16)}) + "\n", overwrite=True)
            run, generation = _count(books / "runs.json", source, overwrite)
        yield Place(out, shard, run, generation, mark.read_text(encoding="utf-8"))


def _name(shard: Shard) -> str:
    return f"shard-{shard.number}-of-{shard.count}"


def _check_others(books: Path, out: Path, shard: Shard) -> None:
    """Raise if another process has shards of another number, which would share recordings with this one."""
    for lock in books.glob("shard-*.lock"):
        if lock.stem.endswith(f"-of-{shard.count}"):
            continue
        if (holder := is_held(lock)) is not None:
            raise OutputExistsError(
                f"{out}: {holder} works on {lock.stem.replace('-', ' ')}, which has recordings of shard "
                f"{shard}; wait until it ends, or divide by the same number"
            )


def _count(file: Path, source: Path, overwrite: bool) -> tuple[int, int]:
    """Return the numbers of this run and of its generation, and keep them."""
    before: dict[str, Any] = {"run": 0, "generation": 0, "source": str(source.resolve())}
    if file.is_file():
        try:
            before = json.loads(file.read_text(encoding="utf-8"))
            numbers = int(before["run"]), int(before["generation"])
        except (ValueError, KeyError, TypeError) as error:
            raise OutputExistsError(f"{file}: damaged ({error}); name a new folder") from error
        if before["source"] != str(source.resolve()) and not overwrite:
            raise OutputExistsError(
                f"{file.parent.parent}: holds results of {before['source']}; name another folder, or add "
                "--overwrite to do everything again"
            )
    else:
        numbers = 0, 0
    run, generation = numbers[0] + 1, numbers[1] + overwrite
    content = {"run": run, "generation": generation, "source": str(source.resolve())}
    write_text(file, json.dumps(content) + "\n", overwrite=True)
    return run, generation


TABLE: Final = "batch.csv"


@dataclass(frozen=True)
class Batch:
    """What is to be done."""

    source: Path  #: Folder or manifest of the recordings
    entries: Sequence[Entry]  #: All of them, of all shards
    chain: tuple[Step, ...]
    out: Path
    version: str  #: Of the package; results of another one are made again
    shard: Shard = field(default_factory=Shard)


def run_batch(
    batch: Batch, command: Command, engine: Engine, overwrite: bool = False, progress: Progress | None = None
) -> list[Row]:
    """Run a batch, or what is left of it, and return the rows of this shard's recordings, in their order.

    `command` runs one command line and stands at the top level of a module. `OutputExistsError`: see `claim`;
    `WritingError`: the folder cannot be written, or the disk is full.
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
    write = partial(
        write_tables, batch.out, batch.source.resolve().name, {entry.name for entry in batch.entries}, place
    )
    due = write()
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
                if time.monotonic() >= due:
                    due = write()
    finally:
        write()
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
        folder, out = entry.folder.resolve(), batch.out.resolve()
        yield entry.name, Task(entry.name, folder, out, place.token, absolute, made_from, batch.version)


PAUSE: Final = 10.0  #: [s] between two writings of the tables
SHARE: Final = 0.05  #: Share of the time that writing may take at most, so that long tables are written less often


def write_tables(out: Path, title: str, names: Collection[str], place: Place) -> float:
    """Write the table and the index of some recordings with the rows of all shards; return when they are due again."""
    began = time.monotonic()
    with FileLock(place.out / BOOKS / "table.lock"):  # shards wait for each other
        rows = [row for name, (_, row) in sorted(place.rows().items()) if name in names]
        columns = [column.name for column in fields(Row)]
        write_csv(out / TABLE, Table(columns, [astuple(row) for row in rows]))
        write_index(out, sorted(rows, key=lambda row: row.severity), len(names), title)
    now = time.monotonic()
    return now + max(PAUSE, (now - began) / SHARE)


Check = Callable[[list[str]], object]  #: Raises an error of the package for a command line that is wrong


def check_chain(batch: Batch, check: Check) -> None:
    """Check the command lines of all recordings before the first of them is run; equal ones once. `RtofError`: a
    command line is wrong; the message names the recording.
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
