"""Validation of the arrays and names that data classes hold, and `Check`, the result of a plausibility check."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, ShapeError, UnknownNameError

Shape = Sequence[int | str]  #: Lengths of the axes; a letter matches any length


def readonly(field: str, value: ArrayLike, shape: Shape, dtype: Any = float) -> Any:
    """Return a read-only copy of an array whose shape is checked against e.g. ``("T", 21, 3)``, or the array itself
    where nobody can write to it and it is whole; `ShapeError` where the value is not numeric or its shape differs.
    """
    shared = isinstance(value, np.ndarray) and not value.flags.writeable
    if isinstance(value, np.ndarray) and (whole := value.base) is not None:
        shared &= isinstance(whole, np.ndarray) and not whole.flags.writeable and whole.size == value.size
    try:
        array = np.asarray(value, dtype=dtype) if shared else np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{field}: not an array of numbers ({error})") from error
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ShapeError(f"{field}: expected shape ({', '.join(map(str, shape))}), got {array.shape}")
    array.setflags(write=False)
    return array


def shared(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return arrays to which nobody writes from now on, so that `readonly` keeps them without a copy."""
    for array in arrays:
        array.setflags(write=False)
    return arrays


def some(names: Sequence[str], most: int = 3, separator: str = ", ") -> str:
    """Return the first names, and how many more there are."""
    return separator.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def freeze(record: object, name: str, **shapes: Shape) -> None:
    """Replace array fields of a frozen dataclass, in its ``__post_init__``, by `readonly` copies of these shapes."""
    for own, shape in shapes.items():
        object.__setattr__(record, own, readonly(f"{name} {own}", getattr(record, own), shape))


def checked_times(field: str, times: ArrayLike) -> Array:
    """Return read-only times (T,), s; `InvalidInputError` where empty, not finite or not strictly increasing."""
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
    """Return the positions of names in a list; names that are not in it raise `UnknownNameError`."""
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise UnknownNameError(kind, unknown, known)
    return [list(known).index(name) for name in wanted]


def checked_names(field: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return unique names as a tuple; a name that occurs more than once raises `InvalidInputError`."""
    names = tuple(map(str, names))
    double = sorted(name for name, count in Counter(names).items() if count > 1)
    if double:
        raise InvalidInputError(f"{field}: {', '.join(double)} occurs more than once")
    return names


def checked_rotations(field: str, R: Array) -> None:
    """Check that each of the matrices (..., 3, 3) is a rotation or NaN as a whole, or raise `InvalidInputError`."""
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


class Verdict(Enum):
    """Outcome of a check."""

    PASSED = "holds"
    FAILED = "does not hold"
    NOT_POSSIBLE = "cannot be checked"


@dataclass(frozen=True)
class Check:
    """One value against its limit."""

    name: str  #: Checked quantity
    subject: str  #: Take, sensor, camera or bone that is checked
    value: float  #: NaN if it cannot be computed; such a check neither passes nor fails
    limit: float  #: Largest value that passes
    unit: str  #: Unit of value and limit
    advice: str = ""  #: Possible meaning of a failure; of a NaN value, the reason
    likely: Mapping[str, Any] = field(default_factory=dict)
    """Change of the declaration with which the check would pass. It is only reported."""
    cause: str = ""
    """Most likely cause of a failure as a headline, e.g. 'the focal length is too short'; may be empty."""

    @classmethod
    def unknown(cls, name: str, subject: str, unit: str, why: str) -> Self:
        """Return a check that the data do not allow; `why` is its advice."""
        return cls(name, subject, math.nan, math.nan, unit, why)

    @property
    def verdict(self) -> Verdict:
        """Outcome by value and limit."""
        if math.isnan(self.value):
            return Verdict.NOT_POSSIBLE
        return Verdict.PASSED if self.value <= self.limit else Verdict.FAILED

    @property
    def passed(self) -> bool:
        """True if the value is finite and within its limit."""
        return self.verdict is Verdict.PASSED

    @property
    def failed(self) -> bool:
        """True if the value exceeds its limit."""
        return self.verdict is Verdict.FAILED

    @property
    def message(self) -> str:
        """One line: subject, name, value, limit and, unless passed, the advice."""
        text = f"{self.subject}: {self.name} is {self.value:.3g} {self.unit} (limit {self.limit:g})"
        text = f"{self.cause}: {text}" if self.failed and self.cause else text
        return text if self.passed else f"{text}. {self.advice}"
