"""Validation of the arrays and names that data classes hold: shapes, times, names, rotations.

Results of plausibility checks, which are reported to the user, are in `plausibility`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, ShapeError, UnknownNameError

Shape = Sequence[int | str]
"""Lengths of the axes; a letter matches any length."""


def readonly(field: str, value: ArrayLike, shape: Shape, dtype: Any = float) -> Any:
    """Return a read-only copy of an array whose shape is checked against e.g. ``("T", 21, 3)``.

    Raises:
        ShapeError: the value is not numeric or its shape differs.
    """
    try:
        array = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{field}: not an array of numbers ({error})") from error
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ShapeError(f"{field}: expected shape ({', '.join(map(str, shape))}), got {array.shape}")
    array.setflags(write=False)
    return array


def freeze(record: object, name: str, **shapes: Shape) -> None:
    """Replace array fields of a frozen dataclass by read-only copies of checked shape.

    Args:
        record: the instance, in its ``__post_init__``. shapes: expected shape of each field.

    Raises:
        ShapeError: see `readonly`.
    """
    for field, shape in shapes.items():
        object.__setattr__(record, field, readonly(f"{name} {field}", getattr(record, field), shape))


def checked_times(field: str, times: ArrayLike) -> Array:
    """Return read-only times (T,) in seconds.

    Args:
        times: (T,) s.

    Raises:
        InvalidInputError: they are empty, not finite or not strictly increasing.
    """
    array: Array = readonly(field, times, ("T",))
    if len(array) == 0:
        raise InvalidInputError(f"{field}: empty; at least one sample is needed")
    if not np.all(np.isfinite(array)):
        first = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InvalidInputError(f"{field}: not finite at index {first}; every sample needs a time")
    steps = np.diff(array)
    if np.any(steps <= 0):
        first = int(np.flatnonzero(steps <= 0)[0])
        raise InvalidInputError(
            f"{field}: time does not increase from index {first} ({array[first]:g} s) to "
            f"{first + 1} ({array[first + 1]:g} s); sort the samples and drop duplicates"
        )
    return array


def indices_of(kind: str, wanted: Sequence[str], known: Sequence[str]) -> list[int]:
    """Return the positions of names in a list.

    Raises:
        UnknownNameError: names that are not in the list.
    """
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise UnknownNameError(kind, unknown, known)
    return [list(known).index(name) for name in wanted]


def checked_names(field: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return unique names as a tuple.

    Raises:
        InvalidInputError: a name occurs more than once.
    """
    names = tuple(map(str, names))
    double = sorted(name for name, count in Counter(names).items() if count > 1)
    if double:
        raise InvalidInputError(f"{field}: {', '.join(double)} occurs more than once")
    return names


def checked_rotations(field: str, R: Array) -> None:
    """Check that each matrix is a rotation or NaN as a whole.

    Args:
        R: (..., 3, 3).

    Raises:
        InvalidInputError: a matrix is neither.
    """
    unknown = np.isnan(R)
    if not unknown.any() and so3.is_rotation(R, tolerance=1e-5):
        return
    missing = unknown.any(axis=(-2, -1))
    if np.any(missing & ~unknown.all(axis=(-2, -1))):
        raise InvalidInputError(f"{field}: a matrix is partly NaN; missing ones are NaN as a whole")
    if not so3.is_rotation(R[~missing], tolerance=1e-5):
        given = np.argwhere(~missing)
        first = next(i for i in given if not so3.is_rotation(R[tuple(i)], tolerance=1e-5))
        at = ", ".join(map(str, first))
        raise InvalidInputError(f"{field}: not a rotation matrix at index ({at}); normalise quaternions before use")
