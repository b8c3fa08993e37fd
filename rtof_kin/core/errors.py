"""The error types of the package.

Every error a caller can cause derives from `RtofError`; its message says what was wrong, where,
and what to do about it. The command line turns them into one line and exit code 2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path


class RtofError(Exception):
    """Base of all errors raised on purpose by this package."""


class InvalidInputError(RtofError, ValueError):
    """An argument, a setting or a field of data has a value that it cannot have."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape."""


class ViewError(InvalidInputError):
    """A camera as declared cannot have seen what it is said to have seen."""


class UnitError(RtofError, ValueError):
    """Numbers are plausible only in another unit than the one declared."""


class UnknownNameError(RtofError, KeyError):
    """A joint, landmark, sensor or setting is named that does not exist."""

    def __init__(self, kind: str, unknown: Iterable[str], known: Sequence[str]):
        unknown = list(unknown)
        hints = [match for name in unknown for match in get_close_matches(name, known, n=1)]
        hint = f" Did you mean {', '.join(map(repr, hints))}?" if hints else ""
        super().__init__(f"unknown {kind} {', '.join(map(repr, unknown))}.{hint} Known: {', '.join(known)}")

    def __str__(self) -> str:
        return str(self.args[0])


class FileFormatError(RtofError, ValueError):
    """A file cannot be read as what it claims to be."""

    def __init__(self, path: str | Path, problem: str, line: int | None = None):
        self.path, self.line = Path(path), line
        where = f"{path}, line {line}" if line is not None else str(path)
        super().__init__(f"{where}: {problem}")


class OutputExistsError(RtofError, FileExistsError):
    """Something stands where output would be written, and overwriting was not asked for."""

    @classmethod
    def of(cls, path: str | Path) -> OutputExistsError:
        """The error about a file or folder that would be replaced if that were asked for."""
        remedy = "ask to overwrite it (--overwrite; overwrite=True in Python) or name another one"
        return cls(f"{path}: is there already; {remedy}")


class WritingError(RtofError):
    """Output cannot be written, for example because the disk is full."""


class CalibrationError(RtofError, ValueError):
    """A calibration does not fit the sensors it is applied to."""


class SolverError(RtofError, RuntimeError):
    """An optimisation problem cannot be posed with what was given."""
