"""Recordings of a batch: all below a folder, or those that a manifest lists.

A manifest is a CSV file with a header. Column ``recording`` has the folder of each, relative to the
manifest's own. Optional: ``name``, its folder in the output (default: its path below the manifest's
folder), and columns named like commands of the chain, with more options of that command for this recording.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.manifest import fingerprint
from rtof_kin.core.files.text import csv_rows

INDEX: Final = "recording.toml"  #: File that makes a folder a recording
_OWN_COLUMNS: Final = ("recording", "name")


@dataclass(frozen=True)
class Entry:
    """One recording of a batch."""

    name: str  #: Its folder in the output: a relative path with slashes
    folder: Path
    options: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  #: More options by command


@dataclass(frozen=True)
class Shard:
    """One of several parts of a batch, which are disjoint whatever recordings each of them finds."""

    number: int = 1  #: From 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise InvalidInputError(f"shard {self}: the first number is from 1 to the second, as 3/10")

    @classmethod
    def of(cls, text: str) -> Shard:
        """Read a shard from a text such as 3/10; `InvalidInputError` if it is none."""
        if not (found := re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())):
            raise InvalidInputError(f"shard {text!r}: write its number and how many there are, as 3/10")
        return cls(int(found.group(1)), int(found.group(2)))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def has(self, name: str) -> bool:
        """Return whether a recording belongs to this shard."""
        digest = hashlib.sha256(name.encode()).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.number - 1


def find_recordings(source: Path, out: Path) -> list[Entry]:
    """Return the recordings of a folder or a manifest, sorted by name; none are looked for in `out`.
    `FileFormatError`: there is no such source, or the manifest has an error; `InvalidInputError`: there are no
    recordings, or the outputs of two would mix.
    """
    if not source.exists():
        raise FileFormatError(source, "there is no such folder or manifest")
    if source.is_dir():
        entries = list(_below(source, out.resolve()))
    else:
        rows = csv_rows(source, "a manifest; its first line names the columns", ("recording",))
        entries = [_entry(source, line, row) for line, row in rows]
    if not entries:
        raise InvalidInputError(f"{source}: no recordings; each is a folder with {INDEX}")
    entries.sort(key=lambda entry: entry.name.split("/"))
    _check_names(source, entries)
    return entries


def _below(root: Path, out: Path) -> Iterator[Entry]:
    """Find recordings; folders in a recording and hidden ones are not searched."""
    if (root / INDEX).is_file():
        yield Entry(root.resolve().name, root)
        return
    for place, folders, _ in os.walk(root):
        for name in sorted(folders):
            folder = Path(place, name)
            own = not name.startswith(".") and folder.resolve() != out
            found = own and (folder / INDEX).is_file()
            if found:
                yield Entry(folder.relative_to(root).as_posix(), folder)
            if found or not own:
                folders.remove(name)


def _entry(manifest: Path, line: int, row: Mapping[str, str]) -> Entry:
    if not row["recording"]:
        raise FileFormatError(manifest, "no recording in this line", line)
    folder = manifest.parent / row["recording"]
    name = row.get("name") or (
        Path(row["recording"]).as_posix() if path_inside(manifest.parent, row["recording"]) else folder.name
    )
    try:
        options = {c: tuple(shlex.split(t)) for c, t in row.items() if t and c not in _OWN_COLUMNS}
    except ValueError as error:
        raise FileFormatError(manifest, f"options: {error}", line) from error
    return Entry(Path(name).as_posix(), folder, options)


def _check_names(source: Path, entries: Iterable[Entry]) -> None:
    """Raise unless every recording has an output folder of its own."""
    before = ""
    for entry in entries:
        path = Path(entry.name)
        if path.is_absolute() or any(part.startswith(".") for part in path.parts) or not path.parts:
            raise InvalidInputError(
                f"{source}: {entry.name!r} is no name of an output folder; a name is a relative path without "
                "parts that begin with a point"
            )
        if entry.name == before:
            raise InvalidInputError(f"{source}: two recordings are named {before}; give names of their own")
        if before and entry.name.startswith(before + "/"):
            raise InvalidInputError(f"{source}: {entry.name} would lie in the output of {before}; rename one")
        before = entry.name


RECORDING, OUT = "{recording}", "{out}"  #: Stand for the folder of the recording and for that of its output
MOTION, PAGE = "motion", "report.html"
_FILES: Final = {
    "inspect": (RECORDING,),
    "reconstruct": (RECORDING, "-o", f"{OUT}/{MOTION}"),
    "evaluate": (f"{OUT}/{MOTION}", "--truth", RECORDING),
    "report": (f"{OUT}/{MOTION}", "-o", f"{OUT}/{PAGE}", "--analysis", f"{OUT}/angles"),
    "export": (f"{OUT}/{MOTION}", "-o", f"{OUT}/export"),
    "study": (RECORDING, "-o", f"{OUT}/study"),
}
"""What each command reads and writes."""


@dataclass(frozen=True)
class Step:
    """One command of a chain."""

    command: str
    arguments: tuple[str, ...]  #: All of them, with `RECORDING` and `OUT`

    @property
    def output(self) -> str | None:
        """File or folder that it writes below `OUT`; None if it only prints."""
        for option, value in zip(self.arguments, self.arguments[1:], strict=False):
            if option in ("-o", "--output") and value.startswith(f"{OUT}/"):
                return value.removeprefix(f"{OUT}/")
        return None

    def line(self, recording: Path, out: Path, overwrite: bool) -> list[str]:
        """Return the command line, with which an output is replaced if wanted."""
        own = [a.replace(RECORDING, str(recording)).replace(OUT, str(out)) for a in self.arguments]
        return [self.command, *own, *(["--overwrite"] if overwrite and self.output else [])]


def read_chain(text: str, commands: Collection[str]) -> tuple[Step, ...]:
    """Return the steps of a chain, see the top of this module. `InvalidInputError`: a command does not exist or needs
    its files named, or two write the same.
    """
    parts: list[str] = []
    for piece in text.split(","):
        if parts and (not piece.split() or piece.split()[0] not in commands):
            parts[-1] += f",{piece}"  # a comma in an option
        else:
            parts.append(piece)
    try:
        steps = tuple(_step(shlex.split(part), commands) for part in parts)
    except ValueError as error:
        raise InvalidInputError(f"chain: {error}") from error
    names = [output_name(step) for step in steps]
    if double := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInputError(f"chain: two commands write {double[0]}; name outputs of their own, -o {OUT}/...")
    return steps


def output_name(step: Step) -> str:
    """Return what identifies the result of a step: what it writes, else its command."""
    return step.output or step.command


def _step(words: list[str], commands: Collection[str]) -> Step:
    if not words or words[0] not in commands:
        raise InvalidInputError(
            f"chain: {words[0] if words else 'an empty part'} is no command; e.g. {', '.join(_FILES)}"
        )
    command, *options = words
    if any(RECORDING in word or OUT in word for word in options):
        return Step(command, tuple(options))
    if command not in _FILES:
        raise InvalidInputError(
            f"chain: what {command} reads and writes is not known; write it with {RECORDING} and {OUT}, "
            f"such as 'overlay {OUT}/motion {RECORDING}/video.mp4 -o {OUT}/overlay.mp4'"
        )
    return Step(command, (*_FILES[command], *options))


def steps_of(chain: Iterable[Step], entry: Entry) -> tuple[Step, ...]:
    """Return the steps for one recording, with its own options. `InvalidInputError`: it has options of a command that
    is not in the chain.
    """
    chain = tuple(chain)
    unknown = sorted(set(entry.options) - {step.command for step in chain})
    if unknown:
        raise InvalidInputError(f"{entry.name}: options of {unknown[0]}, which is not in the chain")
    more = entry.options
    return tuple(Step(step.command, (*step.arguments, *more.get(step.command, ()))) for step in chain)


def files_in(steps: Iterable[Step]) -> tuple[tuple[str, str], ...]:
    """Return the files that options name, such as a model, with fingerprints of their contents."""
    words = {word for step in steps for word in step.arguments if "{" not in word}
    values = {value for word in words for value in (word, word.partition("=")[2]) if value}
    return tuple((value, fingerprint(Path(value))) for value in sorted(values) if Path(value).is_file())


def with_absolute_files(step: Step) -> Step:
    """Return a step whose options name files by absolute paths, for a worker with another current folder."""
    words = (str(Path(word).resolve()) if Path(word).is_file() else word for word in step.arguments)
    return Step(step.command, tuple(words))
