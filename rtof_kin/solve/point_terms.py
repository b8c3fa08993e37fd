"""Further residuals of the solvers: functions of a joint's position and of numbers observed in a frame.

A `PointTerm` is all that the energies of both spaces need: value, gradient and Hessian follow from the
residual by CasADi, with the plain code, the compiled code and IPOPT. The guide is CONTRIBUTING.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.solve.residuals import Matrix

OBSERVED, WEIGHT = "point_", "w_point_"
"""What the names of a term's observation and weight begin with."""


@dataclass(frozen=True)
class PointTerm:
    """A residual that is added to the energy of every frame."""

    name: str
    """Name in reports, a Python identifier."""
    joint: str
    """Joint of the skeleton that it acts on."""
    residual: Callable[[Matrix, Matrix], Matrix]
    """(position (3, 1) in world, m; observation (size, 1)) -> plain difference (k, 1) with a unit, as in
    `rtof_kin.solve.residuals`; finite where the observation is 0. A function of a module: the energy is
    built, and compiled, once for each function."""
    size: int
    """Numbers observed in a frame."""
    robust: float = 3.0
    """[sigma] Threshold of the pseudo-Huber loss."""

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise InvalidInputError(f"term {self.name!r}: the name must be letters, digits and underscores")
        if not (self.size >= 1 and self.robust > 0):
            raise InvalidInputError(f"term {self.name!r}: size and robust must be positive")

    @property
    def observed(self) -> str:
        """Name of its observation in the energy."""
        return OBSERVED + self.name

    @property
    def weight(self) -> str:
        """Name of its weight, 1 / sigma^2, in the energy."""
        return WEIGHT + self.name

    def symbols(self, frames: int = 1) -> dict[str, Matrix]:
        """Return observation (size, frames) and weight (frames) as symbols, by name."""
        return {self.observed: ca.SX.sym(self.observed, self.size, frames), self.weight: ca.SX.sym(self.weight, frames)}


@dataclass(frozen=True)
class PointData:
    """Observations of a term, one for each of T frames."""

    values: Array
    """(T, size), in the units of the residual; NaN where nothing was observed."""
    sigma: Array | float
    """Standard deviation of the residual per component, in its unit: of all frames, or (T,)."""


def check_terms(terms: Sequence[PointTerm], joints: Sequence[str], built_in: Sequence[str]) -> None:
    """Check that the terms can stand beside those of an energy.

    Raises:
        UnknownNameError: no such joint. InvalidInputError: a name is taken.
    """
    names = [*built_in, *(term.name for term in terms)]
    if double := [name for name in names if names.count(name) > 1]:
        raise InvalidInputError(f"term {double[0]!r}: there is one of this name; choose another")
    if unknown := [term.joint for term in terms if term.joint not in joints]:
        raise UnknownNameError("joint of a term", unknown, joints)


def point_rows(terms: Sequence[PointTerm], data: Mapping[str, PointData], frames: int) -> dict[str, Array]:
    """Return observations (T, size) and weights (T,) of all terms by name, 0 where nothing was observed.

    Raises:
        UnknownNameError: data of an unknown term. InvalidInputError: wrong shapes, or sigma is not positive.
    """
    known = [term.name for term in terms]
    if unknown := [name for name in data if name not in known]:
        raise UnknownNameError("term", unknown, known)
    out: dict[str, Array] = {}
    for term in terms:
        values, weight = np.zeros((frames, term.size)), np.zeros(frames)
        if term.name in data:
            what = f"observations of the term {term.name}"
            values = readonly(what, data[term.name].values, (frames, term.size))
            sigma = np.asarray(data[term.name].sigma, dtype=float)
            if sigma.shape not in ((), (frames,)):
                raise InvalidInputError(f"{what}: sigma is of {len(sigma)} frames, not of {frames}")
            sigma = np.broadcast_to(sigma, frames)
            seen = np.isfinite(values).all(axis=1)
            if not (sigma[seen] > 0).all():
                raise InvalidInputError(f"{what}: sigma must be positive")
            weight[seen] = 1 / sigma[seen] ** 2
            values = np.where(seen[:, None], values, 0.0)
        out |= {term.observed: values, term.weight: weight}
    return out
