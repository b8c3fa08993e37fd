"""Text files, TOML and JSON, read whole without trusting them; text, written without replacing anything
unasked; and how large a number may be.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.folder import new_file

LARGEST_TEXT = 2**30
"""Files of more bytes than this are refused."""
LARGEST_TOML = 32 * 2**20
"""A TOML file of more bytes is not one that people or this package write."""
_BETWEEN_KEYS, _MOST_DOTS = re.compile(r"[^\w.\"' \t-]"), 1000
"""What ends a key; tomllib takes memory with the square of the number of a key's parts."""
LARGEST_NUMBER = 1e20
"""Nothing that is measured counts further; squares of what is read stay finite."""


def check_file(path: str | Path, what: str, limit: float = math.inf) -> None:
    """Refuse what is no file, and devices and pipes, which could go on for ever.

    Args:
        what: as for `read_text`. limit: largest size, bytes.

    Raises:
        FileFormatError: it is not there, of another kind, or larger.
        OSError: it cannot be looked at.
    """
    path = Path(path)
    if not path.is_file():
        problem = f"a folder, not {what}" if path.is_dir() else "there is no such file"
        raise FileFormatError(path, problem)
    if path.stat().st_size > limit:
        raise FileFormatError(path, f"larger than {limit / 2**20:.0f} MiB, so not {what}")


def read_text(path: str | Path, what: str, limit: int = LARGEST_TEXT) -> str:
    """The text of a file in UTF-8, without a byte order mark.

    Args:
        what: what the file should be, for the message, e.g. "a BVH file, which begins with HIERARCHY".
        limit: largest size, bytes.

    Raises:
        FileFormatError: no such file, unreadable, larger than the limit, not UTF-8, or empty.
    """
    path = Path(path)
    try:
        check_file(path, what, limit)
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"not a text file in UTF-8, so not {what}") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    if not text.strip():
        raise FileFormatError(path, f"empty; expected {what}", 1)
    return text


def load_toml(path: str | Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises:
        FileFormatError: as `read_text`, or not TOML.
    """
    text = read_text(path, "TOML", LARGEST_TOML)
    if max(part.count(".") for part in _BETWEEN_KEYS.split(text)) > _MOST_DOTS:
        raise FileFormatError(path, f"a key of more than {_MOST_DOTS} parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"not readable as TOML: {str(error)[:200]}") from error


def load_json(path: str | Path, limit: int = LARGEST_TEXT, what: str = "JSON") -> Any:
    """What a JSON file holds; the arguments are those of `read_text`.

    Raises:
        FileFormatError: as `read_text`, or not JSON.
    """
    text = read_text(path, what, limit)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(path, f"not readable as JSON: {error.msg}", error.lineno) from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"not readable as JSON: {str(error)[:200]}") from error


def measurable(array: NDArray[np.float64]) -> bool:
    """Whether an array's finite numbers are such as measurements have."""
    with np.errstate(invalid="ignore"):
        return not np.any((np.abs(array) > LARGEST_NUMBER) & np.isfinite(array))


def write_text(path: Path, text: str, overwrite: bool = False) -> None:
    """Write a file in UTF-8, which appears whole or not at all.

    Raises:
        OutputExistsError: it exists and overwriting was not asked for. RtofError: it cannot be written.
    """
    with new_file(path, overwrite) as file:
        file.write_text(text, encoding="utf-8", newline="\n")
