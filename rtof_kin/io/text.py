"""Text files, read whole without trusting them."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.errors import FileFormatError

LARGEST_TEXT = 2**30
"""Files of more bytes than this are refused."""


def read_text(path: Path, what: str, limit: int = LARGEST_TEXT) -> str:
    """The text of a file in UTF-8, without a byte order mark.

    Args:
        what: what the file should be, for the message, e.g. "a BVH file, which begins with HIERARCHY".
        limit: largest size, bytes.

    Raises:
        FileFormatError: no such file, unreadable, larger than the limit, not UTF-8, or empty.
    """
    try:
        if path.stat().st_size > limit:
            raise FileFormatError(path, f"larger than {limit / 2**20:.0f} MiB, so not {what}")
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise FileFormatError(path, "there is no such file") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"not a text file in UTF-8, so not {what}") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    if not text.strip():
        raise FileFormatError(path, f"empty; expected {what}", 1)
    return text
