"""`Confidence`: covariances of joint positions and segment orientations.

The error of a position is in world, m. The error of an orientation between two segments is a rotation vector
in the child's axes, rad: ``R_parent_child = R_parent_child_true @ exp(error)``. The standard deviation per
axis is the root of the mean diagonal of a covariance; +-1.96 of it is a 95 % band.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, checked_times, freeze
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.over_time import OverTime

WORLD = "world"  #: Parent of a segment whose orientation is relative to world
BAND_95 = 1.959964  #: Half width of a 95 % band in standard deviations
_COVARIANCES = ("position_covariance", "relative_covariance", "turn_covariance")
_ROUNDING = 1e-5  #: Tolerance of symmetry and positive definiteness, relative to the largest variance


@dataclass(frozen=True)
class Confidence(OverTime):
    """Covariances of the errors of a motion in every frame; NaN as a whole where unobserved."""

    times: Array  #: (T,) seconds, strictly increasing
    names: tuple[str, ...]  #: J joint names
    position_covariance: Array  #: (T, J, 3, 3) of joint positions in world, m^2
    relative_covariance: Array
    """(T, J, 3, 3) of joint positions relative to the root, world axes, m^2; zero for the root."""
    pairs: tuple[tuple[str, str], ...]  #: P pairs of a parent segment (or `WORLD`) and a child segment, by their joints
    turn_covariance: Array  #: (T, P, 3, 3) of the child's orientation relative to the parent, child axes, rad^2
    rows = _COVARIANCES

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("confidence times", self.times))
        set_(self, "names", checked_names("confidence names", self.names))
        pairs = tuple((str(parent), str(child)) for parent, child in self.pairs)
        unknown = sorted({name for pair in pairs for name in pair} - {*self.names, WORLD})
        if unknown:
            raise UnknownNameError("segment in confidence pairs", unknown, (WORLD, *self.names))
        if len(set(pairs)) < len(pairs):
            raise InvalidInputError("confidence pairs: one occurs more than once")
        set_(self, "pairs", pairs)
        T, J = len(self.times), len(self.names)
        shapes = {name: (T, len(pairs) if name == "turn_covariance" else J, 3, 3) for name in _COVARIANCES}
        freeze(self, "confidence", **shapes)
        for name in _COVARIANCES:
            _check_covariance(f"confidence {name}", getattr(self, name))

    def scaled(self, factor: float) -> Self:
        """Return the covariances times a factor; NaN stays."""
        return self.changed(**{name: factor * getattr(self, name) for name in _COVARIANCES})

    def plus(self, other: Self) -> Self:
        """Return the sum with the covariances of independent errors of the same motion; NaN counts as 0."""
        return self.changed(**{n: getattr(self, n) + np.nan_to_num(getattr(other, n)) for n in _COVARIANCES})

    def changed(self, **fields: Array) -> Self:
        """Return it with other fields, which are not checked: sums, parts or K C K of those of valid ones."""
        out = copy(self)
        for name, value in fields.items():
            value.setflags(write=False)
            object.__setattr__(out, name, value)
        return out

    @property
    def position_sigma(self) -> Array:
        """Standard deviation (T, J) per axis of positions in world, m."""
        return per_axis(self.position_covariance)

    @property
    def relative_sigma(self) -> Array:
        """Standard deviation (T, J) per axis of positions relative to the root, m."""
        return per_axis(self.relative_covariance)

    @property
    def orientation_sigma(self) -> Array:
        """Standard deviation (T, J) per axis of orientations in world, rad; NaN unless among the pairs."""
        return np.stack([per_axis(self.turn(WORLD, name)) for name in self.names], axis=1)

    def turn(self, parent: str, child: str) -> Array:
        """Return `turn_covariance` (T, 3, 3) of a pair; NaN unless among the pairs."""
        if (parent, child) not in self.pairs:
            return np.full((len(self), 3, 3), np.nan)
        return np.asarray(self.turn_covariance[:, self.pairs.index((parent, child))])


def per_axis(covariance: Array) -> Array:
    """Return standard deviations (...) per axis; covariance: (..., 3, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariance, axis1=-2, axis2=-1), 0.0) / 3))


def joined(parts: Sequence[Confidence]) -> Confidence:
    """Concatenate consecutive parts of one motion."""
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("times", *_COVARIANCES)}
    checked_times("confidence times", whole["times"])
    return parts[0].changed(**whole)


def valid_covariances(matrices: Array) -> Mask:
    """Return a mask (...) of symmetric matrices (..., 3, 3) without a negative variance, to rounding, or NaN."""
    entries = np.ascontiguousarray(matrices.reshape(-1, 9).T)
    return _without_negative(entries, np.abs(entries).max(axis=0)).reshape(matrices.shape[:-2])


def _check_covariance(field: str, covariance: Array) -> None:
    """Raise if a matrix is partly NaN, infinite, not symmetric, or has a negative variance."""
    entries = np.ascontiguousarray(covariance.reshape(-1, 9).T)  # rows of one entry each
    known = ~np.isnan(entries).all(axis=0)
    if not known.all():
        entries = entries[:, known]
    if not np.isfinite(entries).all():
        raise InvalidInputError(f"{field}: not finite; write NaN as a whole where it is unknown")
    size = np.abs(entries).max(axis=0)
    if (np.abs(entries[[1, 2, 5]] - entries[[3, 6, 7]]) > _ROUNDING * size).any():
        raise InvalidInputError(f"{field}: a matrix is not symmetric")
    if not _without_negative(entries, size).all():
        raise InvalidInputError(f"{field}: a variance is negative")


def _without_negative(entries: Array, size: Array) -> Mask:
    """Return whether principal minors of symmetric matrices (9, n) of a size (n,) are not negative (Sylvester)."""
    a, f, e, _, b, d, _, _, c = entries / np.maximum(size, 1e-300)
    pairs = b * c - d * d, a * c - e * e, a * b - f * f
    whole = a * pairs[0] - f * (f * c - d * e) + e * (f * d - b * e)
    return np.asarray(~(np.minimum.reduce([a, b, c, *pairs, whole]) < -_ROUNDING))
