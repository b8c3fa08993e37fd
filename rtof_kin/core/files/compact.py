"""Numbers with no more digits than needed, whose zero bytes vanish in a compressed file."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

_MANTISSA: Final = 23
"""[bits] of a 32-bit float."""


def multiples(values: ArrayLike, bits: int) -> Array:
    """Return the nearest multiples of ``2^-bits``; zero is positive, so that equal numbers are equal bits.

    Args:
        values: of any shape.
    """
    return np.asarray(np.ldexp(np.round(np.ldexp(np.asarray(values, dtype=float), bits)), -bits) + 0.0)


def short_floats(values: ArrayLike, bits: int) -> NDArray[np.float32]:
    """Return 32-bit floats with a shorter mantissa: a relative error of at most ``2^-(bits + 1)``.

    Args:
        values: of any shape. bits: of the mantissa, 22 or fewer.
    """
    exact = np.array(values, dtype=np.float32)
    cut = _MANTISSA - bits
    whole = exact.view(np.uint32)
    rounded = (whole + np.uint32(1 << (cut - 1))) >> np.uint32(cut) << np.uint32(cut)
    return np.where(np.isfinite(exact), rounded.view(np.float32), exact)


def rotation_vectors(R: Array, bits: int) -> NDArray[np.float32]:
    """Return rotation vectors (..., 3), rad, shorter than quaternions; NaN where a matrix is not finite.

    Args:
        R: rotation matrices (..., 3, 3).
    """
    return multiples(so3.known_log(R), bits).astype(np.float32)
