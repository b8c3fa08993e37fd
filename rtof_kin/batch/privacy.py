"""Search of files for what tells who, where or when: names, paths, addresses, dates, wall-clock times.

It finds words that it is given and patterns that it knows. It cannot know a name that nobody told it.
"""

from __future__ import annotations

import getpass
import json
import platform
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.files.arrays import npz_names, read_npz_as_saved
from rtof_kin.core.files.text import load_json, read_text

_PATTERNS: Final = {
    "an absolute path": r"(?<![\w.:/\\])/(?=[A-Za-z_.])[\w.+@ -]+/[\w.+@-]+"
    r"|(?<![\w./])/(?:home|root|Users|mnt|media|tmp|var|opt|private|Volumes|data)\b(?:/\S*)?"
    r"|(?<!\w)[A-Za-z]:[\\/][\w.]|\\\\[\w.-]+\\\w|(?<![\w~])~[\w.-]*/\w|\bfile://",
    "a path of a file": r"(?<![\w./\\+-])(?!(?:docs|benchmarks|models|rtof_kin)/)"
    r"(?:[\w.+-]+[/\\])+[\w.+-]+\.[A-Za-z]\w{1,4}\b",
    "a video or picture": r"(?<![\w.+-])[\w.+-]+\.(?:mp4|mov|avi|mkv|m4v|webm|mts|jpe?g|png|heic|gif)\b",
    "an address": r"(?<![\w.+-])[\w.+-]+@[\w-]+\.\w+",
    "a date": r"(?<!\d)(?:19|20)\d\d-[01]\d-[0-3]\d(?!\d)|(?<!\d)[0-3]?\d\.[01]?\d\.(?:19|20)\d\d(?!\d)",
}
_KNOWN: Final = tuple((what, re.compile(pattern, re.IGNORECASE)) for what, pattern in _PATTERNS.items())
_TIMES: Final = re.compile(r"(?:.*_)?times")
_WALL_CLOCK: Final = 1e8
"""[s] Times beyond three years after their zero count from a date."""
_SHORTEST: Final = 3
"""Characters of a word that is searched for."""
_GENERIC: Final = {"root", "user", "users", "home", "admin", "guest", "test", "localhost", "ubuntu", "debian"}
"""Names of accounts and machines that are nobody's."""
_PRINTABLE: Final = re.compile(rb"[\x20-\x7e]{4,}")


@dataclass(frozen=True)
class Finding:
    """Something that identifies, and where it is."""

    where: str
    """Member, and the place in it."""
    what: str
    text: str
    """What was found."""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}, {self.text[:60]!r}"


class Search:
    """Search for words and for what looks like a path, an address, a date or a video."""

    def __init__(self, names: Iterable[str], phrases: Iterable[str] = (), allowed: Iterable[str] = ()) -> None:
        """Compile the search.

        Args:
            names: that must not be found, nor one of their words, in any case. phrases: that must not be
                found as a whole. allowed: words that may.
        """
        free = {word.casefold() for word in allowed}
        parts = [part for name in names for part in (name, *re.split(r"[\W_]+", name))]
        folded = {part.casefold() for part in (*parts, *phrases)}
        wanted = sorted(part for part in folded if len(part) >= _SHORTEST and part not in free)
        inner = "|".join(map(re.escape, wanted))
        self._words = re.compile(rf"(?<![^\W_])(?:{inner})(?![^\W_])", re.IGNORECASE) if inner else None
        self._free = free

    def allow(self, found: Iterable[str]) -> None:
        """Let what the patterns find be, from now on."""
        self._free |= {one.casefold() for one in found}

    def in_text(self, where: str, text: str, known: bool = True) -> list[Finding]:
        """Return what is found in a text."""
        found = []
        if self._words is not None and (word := self._words.search(text)):
            found.append(Finding(where, "a name", word.group()))
        for what, pattern in _KNOWN if known else ():
            hits = (hit.group() for hit in pattern.finditer(text))
            found += [Finding(where, what, hit) for hit in hits if hit.casefold() not in self._free][:1]
        return found

    def in_data(self, where: str, data: Any) -> Iterator[Finding]:
        """Yield what is found in plain data, its keys included."""
        for place, text in texts(data):
            yield from self.in_text(f"{where}, {place}" if place else where, text)

    def in_file(self, name: str, path: Path) -> list[Finding]:
        """Return what is found in a file.

        Args:
            name: for the findings; its ending tells the kind.
        """
        if name.endswith(".json"):
            return list(self.in_data(name, load_json(path)))
        if name.endswith(".npz"):
            return list(self._in_npz(name, path))
        if name.endswith(".pt"):
            return list(self._in_weights(name, path))
        lines = enumerate(read_text(path, "text").splitlines(), start=1)
        return [one for i, line in lines for one in self.in_text(f"{name}, line {i}", line)]

    def _in_weights(self, name: str, path: Path) -> Iterator[Finding]:
        """Yield what is found in the texts of a file of weights, not in its numbers."""
        if not zipfile.is_zipfile(path):
            yield Finding(name, "a file that cannot be searched", path.suffix)
            return
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                yield from self.in_text(f"{name}, name of a member", member, known=False)
                if "/data/" not in member:
                    for run in _PRINTABLE.findall(archive.read(member)):
                        yield from self.in_text(f"{name}, {member}", run.decode("ascii"))

    def _in_npz(self, name: str, path: Path) -> Iterator[Finding]:
        for key in npz_names(path):
            yield from self.in_text(f"{name}, name of an array", key)
        for key, array in read_npz_as_saved(path, kinds="fiubcU").items():
            where = f"{name}, {key}"
            if array.dtype.kind == "U":
                for text in array.ravel().tolist():
                    yield from self.in_data(where, _loaded(text))
            elif _TIMES.fullmatch(key) and np.any(np.abs(array[np.isfinite(array)]) > _WALL_CLOCK):
                first = f"{array.ravel()[0]:.0f}"
                yield Finding(where, "times that count from a date, not from the recording's start", first)


def texts(data: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Yield every text in plain data with its place, keys too."""
    if isinstance(data, str):
        yield place, data
    elif isinstance(data, dict):
        for key, value in data.items():
            yield place, str(key)
            yield from texts(value, f"{place}.{key}" if place else str(key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            yield from texts(value, f"{place}[{i}]")


def of_this_machine() -> list[str]:
    """Return the names of this user and machine that may tell who or where."""
    names = [platform.node().partition(".")[0], Path.home().name]
    with suppress(OSError, KeyError):  # a user without a name
        names.append(getpass.getuser())
    return [name for name in names if name.casefold() not in _GENERIC]


def _loaded(text: str) -> Any:
    """Return what a text in JSON says, else the text."""
    try:
        return json.loads(text) if text[:1] in "{[" else text
    except ValueError:
        return text
