"""Error types of the package.

Every error that a caller can cause derives from `RtofError`. Its message names what is wrong, where, and the
remedy. The command line prints it as one line and exits with code 2.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Final

_CONTROL: Final = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]?|\x1b\][^\x07\x1b]*(\x07|\x1b\\)?|[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Escape sequences (ECMA-48) and other control characters but tab and newline."""


def plain(text: str) -> str:
    """Return a text without what a terminal would obey."""
    return _CONTROL.sub("", text)


def too_long(path: object) -> str:
    """Return the sentence about a path that the system does not take."""
    return (
        f"{str(path)[:60]}...: the path is longer than the system allows (usually 255 bytes a name, 4,096 in "
        "all); name a shorter one"
    )


def did_you_mean(unknown: Iterable[str], known: Iterable[str]) -> str:
    """Return a question about the nearest valid names, ' Did you mean ...?'; '' if there is none near."""
    near = nearest(unknown, known)
    return f" Did you mean {', '.join(map(repr, near))}?" if near else ""


def nearest(unknown: Iterable[str], known: Iterable[str]) -> list[str]:
    """Return the nearest valid name of each name that is not valid, where one is near."""
    lower = {name.lower(): name for name in known}
    return [lower[match] for name in unknown for match in get_close_matches(name.lower(), lower, n=1)]


def line_of(path: str | Path, word: str, field: str = "") -> int | None:
    """Return the first line, from 1, with a word outside of comments, after the table of a field '[table] field'; or
    None.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return None
    whole = re.compile(rf"(?<![\w-]){re.escape(word)}(?![\w-])")
    found = [n for n, line in enumerate(lines, 1) if whole.search(line.partition("#")[0])]
    table = field.partition("]")[0] + "]"
    begins = next((n for n, line in enumerate(lines, 1) if field and line.strip().startswith(table)), 0)
    return next((n for n in found if n > begins), found[0] if found else None)


class RtofError(Exception):
    """Base of all errors raised on purpose by this package; its message has no control characters."""

    def __init__(self, *arguments: object):
        super().__init__(*(plain(one) if isinstance(one, str) else one for one in arguments))


class InvalidInputError(RtofError, ValueError):
    """An argument, a setting or a field of data has an invalid value."""


class UndecidedError(InvalidInputError):
    """The files do not tell of which person a recording is, or where the sensors are: the user must choose."""

    def __init__(self, message: str, places: Mapping[str, tuple[str, float]] | None = None):
        """Take the message and, where it is about sensors, the likeliest segment of each, '' where there is none, and
        its probability.
        """
        super().__init__(message)
        self.places = dict(places or {})


class ShapeError(InvalidInputError):
    """An array has the wrong shape."""


class ViewError(InvalidInputError):
    """The declared camera is inconsistent with the keypoints."""


class UnitError(RtofError, ValueError):
    """Numbers are plausible only in another unit than the declared one."""


class UnknownNameError(RtofError, KeyError):
    """A joint, landmark, sensor or setting of this name does not exist."""

    def __init__(
        self,
        kind: str,
        unknown: Iterable[str],
        known: Sequence[str],
        path: str | Path | None = None,
        field: str = "",
        also: Iterable[str] = (),
    ):
        """Take the kind of names, the unknown names, all valid ones, the text file and its field where the
        unknown ones stand, and further words that may be meant.
        """
        unknown = list(unknown)
        where = ""
        if path is not None:
            line = line_of(path, unknown[0], field)
            where = ", ".join(filter(None, (f" in {path}", f"line {line}" if line else "", field)))
        hint = did_you_mean(unknown, [*known, *also])
        names = ", ".join(map(repr, unknown))
        super().__init__(f"unknown {kind}{where} {names}.{hint} Known: {', '.join(known)}")

    def __str__(self) -> str:
        return str(self.args[0])


class FileFormatError(RtofError, ValueError):
    """A file cannot be read in its declared format."""

    def __init__(self, path: str | Path, problem: str, line: int | None = None):
        """Take the file, the problem and the line where it is, if any."""
        self.path, self.line = Path(path), line
        where = f"{path}, line {line}" if line is not None else str(path)
        super().__init__(f"{where}: {problem}")


@contextmanager
def reading(path: str | Path, problem: str = "{}", *kinds: type[Exception]) -> Iterator[None]:
    """Turn errors of some kinds, by default `InvalidInputError`, into a `FileFormatError` about a file, whose problem
    has the error's message in place of ``{}``; errors about a file stay as they are.
    """
    caught = kinds or (InvalidInputError,)
    try:
        yield
    except FileFormatError:
        raise
    except caught as error:
        raise FileFormatError(path, problem.replace("{}", str(error))) from error


class OutputExistsError(RtofError, FileExistsError):
    """Output exists already, and overwriting was not requested."""

    @classmethod
    def of(cls, path: str | Path) -> OutputExistsError:
        """Return the error about a file or folder that may be replaced on request."""
        remedy = "ask to overwrite it (--overwrite; overwrite=True in Python) or name another one"
        return cls(f"{path}: is there already; {remedy}")


class MissingPackageError(RtofError, ImportError):
    """A package that only some features need is not installed."""


class WritingError(RtofError):
    """Output cannot be written, for example because the disk is full."""


class CalibrationError(RtofError, ValueError):
    """A calibration does not fit the sensors it is applied to."""


class SolverError(RtofError, RuntimeError):
    """An optimisation problem cannot be posed or solved."""


class SourceError(RtofError, RuntimeError):
    """A live stream does not exist, does not exist once, or gives what cannot be used."""


class ExtensionError(RtofError):
    """An installed package adds to this one what cannot be used."""
