"""Names of array types, and blocks of rows; docstrings give shapes and units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


def blocks_of(count: int, size: int = 8192) -> Iterator[slice]:
    """Yield slices of at most `size` rows that follow one another and cover `count`."""
    return (slice(start, min(start + size, count)) for start in range(0, count, size))
