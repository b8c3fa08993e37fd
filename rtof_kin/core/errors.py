"""Error types of the package.

Every error that a caller can cause derives from `RtofError`. Its message names what is wrong, where, and the
remedy. The command line prints it as one line and exits with code 2.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Final

_CONTROL: Final = re.compile(
    r"\x1b\[[0-?]*[ -/]*[@-~]?|\x1b\][^\x07\x1b]*(\x07|\x1b\\)?|[\x00-\x08\x0b-\x1f\x7f-\x9f]"
)
"""Escape sequences (ECMA-48) and other control characters but tab and newline."""


def plain(text: str) -> str:
    """Return a text without what a terminal would obey.

    Args:
        text: maybe of another package, or with names of files.
    """
    return _CONTROL.sub("", text)


def too_long(path: object) -> str:
    """Return the sentence about a path that the system does not take.

    Args:
        path: of the error.
    """
    return (
        f"{str(path)[:60]}...: the path is longer than the system allows (usually 255 bytes a name, 4,096 in "
        "all); name a shorter one"
    )


class RtofError(Exception):
    """Base of all errors raised on purpose by this package; its message has no control characters."""

    def __init__(self, *arguments: object):
        """Take the message."""
        super().__init__(*(plain(one) if isinstance(one, str) else one for one in arguments))


class InvalidInputError(RtofError, ValueError):
    """An argument, a setting or a field of data has an invalid value."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape."""


class ViewError(InvalidInputError):
    """The declared camera is inconsistent with the keypoints."""


class UnitError(RtofError, ValueError):
    """Numbers are plausible only in another unit than the declared one."""


class UnknownNameError(RtofError, KeyError):
    """A joint, landmark, sensor or setting of this name does not exist."""

    def __init__(self, kind: str, unknown: Iterable[str], known: Sequence[str]):
        """Take the kind of names, the unknown names and all valid ones."""
        unknown = list(unknown)
        hints = [match for name in unknown for match in get_close_matches(name, known, n=1)]
        hint = f" Did you mean {', '.join(map(repr, hints))}?" if hints else ""
        super().__init__(f"unknown {kind} {', '.join(map(repr, unknown))}.{hint} Known: {', '.join(known)}")

    def __str__(self) -> str:
        return str(self.args[0])


class FileFormatError(RtofError, ValueError):
    """A file cannot be read in its declared format."""

    def __init__(self, path: str | Path, problem: str, line: int | None = None):
        """Take the file, the problem and the line where it is, if any."""
        self.path, self.line = Path(path), line
        where = f"{path}, line {line}" if line is not None else str(path)
        super().__init__(f"{where}: {problem}")


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
