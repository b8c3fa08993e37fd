"""Memory of the process."""

from __future__ import annotations

import ctypes
from contextlib import suppress


def return_free_memory() -> None:
    """Return memory that was freed to the system, where the C library (glibc) keeps it in pieces; elsewhere
    nothing. A loop with large arrays of changing sizes otherwise grows.
    """
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
