"""Folder of a batch: what marks it, who works on it, and the numbers of its runs."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

from rtof_kin.batch.recordings import Shard
from rtof_kin.batch.rows import Numbered, read_rows
from rtof_kin.batch.work import mark_of
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, WritingError
from rtof_kin.core.files.folder import is_held, only_one
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.files.text import write_text

BOOKS: Final = ".batch"
"""Folder of the bookkeeping in the output."""


@dataclass(frozen=True)
class Place:
    """A folder of a batch that this process has a shard of."""

    out: Path
    shard: Shard
    run: int
    """Number of this run; later runs have larger ones."""
    generation: int
    """Number of times that everything was to be done again."""
    token: str
    """Content of the folder's mark."""

    @property
    def rows_file(self) -> Path:
        """File of this shard's rows."""
        return self.out / BOOKS / f"{_name(self.shard)}.jsonl"

    def rows(self) -> dict[str, Numbered]:
        """Return the latest row of every recording, of all shards."""
        return read_rows(sorted((self.out / BOOKS).glob("*.jsonl")))

    def table_lock(self) -> FileLock:
        """Return the lock of the table and the index, for which shards wait."""
        return FileLock(self.out / BOOKS / "table.lock")


@contextmanager
def claim(out: Path, source: Path, shard: Shard, overwrite: bool) -> Iterator[Place]:
    """Make or reopen the folder of a batch, and keep other processes from the same shard.

    Raises:
        OutputExistsError: it holds other files or results of another source, or another process is at work.
        WritingError: it cannot be written. InvalidInputError: a shard cannot overwrite.
    """
    if overwrite and shard.count > 1:
        raise InvalidInputError("a shard does not overwrite what others may just have made; name a new folder")
    books = out / BOOKS
    _check_own(out)
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


def _check_own(out: Path) -> None:
    """Raise unless the folder is new, empty or that of a batch."""
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"{out}: is a file; name a folder")
    if out.is_dir() and not mark_of(out).is_file() and {path.name for path in out.iterdir()} - {BOOKS}:
        raise OutputExistsError(f"{out}: contains files that no batch wrote; name a new folder")


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
