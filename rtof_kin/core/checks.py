"""Checks that the records of data make when they are built: shapes, times, names, rotations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import ShapeError, UnknownNameError

Array = NDArray[np.float64]


def readonly(field: str, value: ArrayLike, shape: Sequence[int | str], dtype: Any = float) -> Any:
    """A read-only copy of an array whose shape is checked against e.g. ``("T", 21, 3)``.

    Raises:
        ShapeError: the value is not numeric or its shape differs; letters match any length.
    """
    try:
        array = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{field}: not an array of numbers ({error})") from error
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        want = ", ".join(map(str, shape))
        raise ShapeError(f"{field}: expected shape ({want}), got {array.shape}")
    array.setflags(write=False)
    return array


def checked_times(field: str, times: ArrayLike) -> Array:
    """Read-only times (T,) in seconds, finite and strictly increasing."""
    array: Array = readonly(field, times, ("T",))
    if len(array) == 0:
        raise ShapeError(f"{field}: empty; at least one sample is needed")
    if not np.all(np.isfinite(array)):
        first = int(np.flatnonzero(~np.isfinite(array))[0])
        raise ShapeError(f"{field}: not finite at index {first}; every sample needs a time")
    steps = np.diff(array)
    if np.any(steps <= 0):
        first = int(np.flatnonzero(steps <= 0)[0])
        raise ShapeError(
            f"{field}: time does not increase from index {first} ({array[first]:g} s) to "
            f"{first + 1} ({array[first + 1]:g} s); sort the samples and drop duplicates"
        )
    return array


def indices_of(kind: str, wanted: Sequence[str], known: Sequence[str]) -> list[int]:
    """Positions of names in a list; `UnknownNameError` names those that are not there."""
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise UnknownNameError(kind, unknown, known)
    return [list(known).index(name) for name in wanted]


def checked_names(field: str, names: Sequence[str]) -> tuple[str, ...]:
    """Names as a tuple, none of them twice."""
    names = tuple(map(str, names))
    double = sorted(name for name, count in Counter(names).items() if count > 1)
    if double:
        raise ShapeError(f"{field}: {', '.join(double)} stands there more than once")
    return names


def checked_rotations(field: str, R: Array) -> None:
    """Check that each matrix (..., 3, 3) is a rotation, or NaN as a whole."""
    missing = np.isnan(R).any(axis=(-2, -1))
    if np.any(missing & ~np.isnan(R).all(axis=(-2, -1))):
        raise ShapeError(f"{field}: a matrix is partly NaN; missing ones are NaN as a whole")
    if not so3.is_rotation(R[~missing], tolerance=1e-5):
        known = np.argwhere(~missing)
        first = next(i for i in known if not so3.is_rotation(R[tuple(i)], tolerance=1e-5))
        at = ", ".join(map(str, first))
        raise ShapeError(f"{field}: not a rotation matrix at index ({at}); normalise quaternions before use")
