"""Covariances at some frames, the nodes, between which they are interpolated linearly.

A mean of two covariances is one, so every interpolated matrix is valid. The nodes are at most `SPACING`
frames apart and so close that the standard deviation per axis is within `TOLERANCE` of its value in every
frame; where a matrix begins or ends to be known, both frames are nodes. They depend on the covariances alone,
not on the blocks that these come in. Of each matrix six entries are kept, those at `ROWS`, `COLUMNS`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.hdf5 import short_floats
from rtof_kin.data.confidence import valid_covariances

SPACING: Final = 16  #: [frames] Largest distance of nodes
TOLERANCE: Final = 0.05  #: Largest relative error of a standard deviation between nodes
ROWS: Final = (0, 1, 2, 0, 0, 1)
COLUMNS: Final = (0, 1, 2, 1, 2, 2)  #: xx, yy, zz, xy, xz, yz
_BITS: Final = 8  #: Of the mantissa of an entry: a relative error of 0.2 %
_WIDER: Final = 1 + 2.0**-7
"""Factor of variances with which a matrix that rounding made indefinite becomes definite again."""


class NodeFinder:
    """Chooses nodes of covariances that arrive by blocks."""

    def __init__(self) -> None:
        self._first = 0
        self._rest: Array | None = None

    def add(self, entries: Array) -> tuple[Index, Array]:
        """Return the nodes that are certain by now, and the entries at them. entries: (n, M, 6) of the next frames."""
        known = entries if self._rest is None else np.concatenate([self._rest, entries])
        whole = (len(known) - 1) // SPACING * SPACING
        found = nodes(known[: whole + 1])[:-1]  # the last one begins the rest
        self._rest, first = known[whole:].copy(), self._first
        self._first += whole
        return first + found, known[found]

    def end(self) -> tuple[Index, Array]:
        """Return the remaining nodes; the last frame is one."""
        if self._rest is None:
            raise InvalidInputError("covariances: none were given")
        found = nodes(self._rest)
        return self._first + found, self._rest[found]


def nodes(entries: Array) -> Index:
    """Return the frames (K,) of the nodes, of which the first and the last frame are two. entries: (T, M, 6)."""
    frames = np.arange(len(entries))
    found = np.union1d(frames[::SPACING], frames[-1:])
    variance: Array = np.maximum(entries[..., :3].sum(axis=-1, keepdims=True), 0.0)
    while len(frames):
        exact, near = np.sqrt(variance[frames]), np.sqrt(interpolated(found, variance[found], frames))
        off = ~((np.abs(near - exact) <= TOLERANCE * exact) | (np.isnan(near) & np.isnan(exact)))
        between = np.searchsorted(found, frames, side="right") - 1
        wrong = np.unique(between[off.any(axis=(1, 2))])
        frames = frames[np.isin(between, wrong)]
        found = np.union1d(found, (found[wrong] + found[wrong + 1]) // 2)
    return found


def interpolated(found: Index, entries: Array, frames: Index) -> Array:
    """Return entries (n, M, k) in `frames` (n,), from the first to the last node; `found` (K,): the nodes' frames."""
    before = np.searchsorted(found, frames, side="right") - 1
    after = np.minimum(before + 1, len(found) - 1)
    share = (frames - found[before]) / np.maximum(found[after] - found[before], 1)
    out: Array = np.array(entries[before], dtype=float)
    inside = share > 0
    weight = share[inside, None, None]
    out[inside] = (1 - weight) * out[inside] + weight * entries[after[inside]]
    return out


def packed(entries: Array) -> NDArray[np.float32]:
    """Return entries with 8 bits of mantissa, of matrices that are still valid. entries: (K, M, 6)."""
    rounded = short_floats(entries, _BITS)
    wrong: Mask = ~valid_covariances(matrices(rounded))
    wider = entries[wrong]
    wider[:, :3] *= _WIDER
    rounded[wrong] = short_floats(wider, _BITS)
    return rounded


def matrices(entries: Array | NDArray[np.float32]) -> Array:
    """Return matrices (..., 3, 3). entries: (..., 6)."""
    out = np.empty((*entries.shape[:-1], 3, 3))
    out[..., ROWS, COLUMNS] = out[..., COLUMNS, ROWS] = entries
    return out


def checked_nodes(field: str, value: NDArray[np.generic], frames: int) -> Index:
    """Return the frames of nodes of a file.

    Raises:
        InvalidInputError: they do not increase from the first to the last frame.
    """
    found: Index = readonly(field, value, ("K",), np.intp)
    if not len(found) or found[0] != 0 or found[-1] != frames - 1 or np.any(np.diff(found) <= 0):
        raise InvalidInputError(f"{field}: do not increase from 0 to {frames - 1}, the last frame")
    return found
