"""`Confidence`: how well each joint's position and each segment's orientation is known, as covariances.

Errors are vectors: of a position in world, m; of an orientation between two segments the rotation vector
that turns the true one into the estimate, in the child's own axes, rad:
``R_parent_child = R_parent_child_true @ exp(error)``. A standard deviation per axis is the root of a
covariance's mean diagonal, and +-1.96 of them are a 95 % band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.checks import checked_names, checked_times, readonly
from rtof_kin.core.errors import ShapeError, UnknownNameError

Array = NDArray[np.float64]
WORLD = "world"
"""What stands in the place of a parent where a segment is told against the world."""
BAND_95 = 1.959964
"""Standard deviations from the middle of a band to its edge."""
_ROUNDING = 1e-5
"""Share of the largest variance by which a covariance may be off from a symmetric, positive one."""


@dataclass(frozen=True)
class Confidence:
    """Covariances of a motion's errors in every frame; NaN as a whole where nobody knows anything."""

    times: Array
    """(T,) seconds, strictly increasing."""
    names: tuple[str, ...]
    """J joint names."""
    position_covariance: Array
    """(T, J, 3, 3) m^2, of each joint's position in world."""
    relative_covariance: Array
    """(T, J, 3, 3) m^2, of its position less the root's, in world's axes; zero for the root."""
    pairs: tuple[tuple[str, str], ...]
    """P pairs of a parent segment (or `WORLD`) and a child segment, each by its joint."""
    turn_covariance: Array
    """(T, P, 3, 3) rad^2, of the child's orientation as seen from the parent, in the child's axes: what
    the two have in common does not count."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("confidence times", self.times))
        set_(self, "names", checked_names("confidence names", self.names))
        pairs = tuple((str(parent), str(child)) for parent, child in self.pairs)
        unknown = sorted({name for pair in pairs for name in pair} - {*self.names, WORLD})
        if unknown:
            raise UnknownNameError("segment in confidence pairs", unknown, (WORLD, *self.names))
        if len(set(pairs)) < len(pairs):
            raise ShapeError("confidence pairs: one stands there more than once")
        set_(self, "pairs", pairs)
        for field, count in (
            ("position_covariance", len(self.names)), ("relative_covariance", len(self.names)),
            ("turn_covariance", len(pairs)),
        ):  # fmt: skip
            shape = (len(self.times), count, 3, 3)
            covariance: Array = readonly(f"confidence {field}", getattr(self, field), shape)
            _check_covariance(f"confidence {field}", covariance)
            set_(self, field, covariance)

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return replace(
            self,
            times=self.times[frames],
            position_covariance=self.position_covariance[frames],
            relative_covariance=self.relative_covariance[frames],
            turn_covariance=self.turn_covariance[frames],
        )

    @property
    def position_sigma(self) -> Array:
        """(T, J) standard deviation per axis of positions in world, m."""
        return per_axis(self.position_covariance)

    @property
    def relative_sigma(self) -> Array:
        """(T, J) standard deviation per axis of positions relative to the root, m."""
        return per_axis(self.relative_covariance)

    @property
    def orientation_sigma(self) -> Array:
        """(T, J) standard deviation per axis of segments' orientations in world, rad; NaN where that is
        not among the pairs.
        """
        return np.stack([per_axis(self.turn(WORLD, name)) for name in self.names], axis=1)

    def turn(self, parent: str, child: str) -> Array:
        """(T, 3, 3) rad^2 of one pair's `turn_covariance`; NaN where it is not among them."""
        if (parent, child) not in self.pairs:
            return np.full((len(self), 3, 3), np.nan)
        return np.asarray(self.turn_covariance[:, self.pairs.index((parent, child))])


def per_axis(covariance: Array) -> Array:
    """Standard deviations (...) per axis of covariances (..., 3, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariance, axis1=-2, axis2=-1), 0.0) / 3))


def joined(parts: Sequence[Confidence]) -> Confidence:
    """Stretches of one motion, one after the other."""
    return replace(
        parts[0],
        times=np.concatenate([part.times for part in parts]),
        position_covariance=np.concatenate([part.position_covariance for part in parts]),
        relative_covariance=np.concatenate([part.relative_covariance for part in parts]),
        turn_covariance=np.concatenate([part.turn_covariance for part in parts]),
    )


def _check_covariance(field: str, covariance: Array) -> None:
    """Raise where a matrix is partly NaN, infinite, not symmetric, or has a negative variance."""
    missing = np.isnan(covariance).all(axis=(-2, -1))
    known = covariance[~missing]
    if not np.isfinite(known).all():
        raise ShapeError(f"{field}: not finite; write NaN as a whole where nothing is known")
    size = np.abs(known).max(axis=(-2, -1), initial=0.0)
    off = np.abs(known - np.swapaxes(known, -1, -2)).max(axis=(-2, -1), initial=0.0)
    if np.any(off > _ROUNDING * size):
        raise ShapeError(f"{field}: a matrix is not symmetric")
    if np.any(_least_minors(known / np.maximum(size, 1e-300)[:, None, None]) < -_ROUNDING):
        raise ShapeError(f"{field}: a variance is negative")


def _least_minors(matrices: Array) -> Array:
    """(n,) smallest principal minor of symmetric matrices (n, 3, 3), negative where one is not positive
    semidefinite (Sylvester).
    """
    a, b, c = (matrices[:, i, i] for i in range(3))
    d, e, f = matrices[:, 1, 2], matrices[:, 0, 2], matrices[:, 0, 1]
    pairs = b * c - d * d, a * c - e * e, a * b - f * f
    whole = a * pairs[0] - f * (f * c - d * e) + e * (f * d - b * e)
    return np.asarray(np.min([a, b, c, *pairs, whole], axis=0, initial=0.0))
