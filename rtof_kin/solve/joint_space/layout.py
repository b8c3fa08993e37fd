"""What the energy of a frame has, apart from its expressions: its terms, energies, paths, and numbers to be bound."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, Final, Self

from rtof_kin.solve.terms import Shapes, Term

LAGS: Final = 4  #: Frames from 0 to 3 apart are coupled


@dataclass(frozen=True)
class FrameLayout:
    """Layout of the energy of a frame."""

    terms: tuple[Term, ...]
    names: tuple[str, ...]  #: Of the energies of a frame
    paths: tuple[str, ...]  #: Term of each point whose derivative is measured
    observation: Shapes  #: What is observed in a frame, in the order in which the functions have it
    constant: Shapes  #: What is constant over a fragment, the same

    @classmethod
    def of(cls, terms: tuple[Term, ...], names: Iterable[str], paths: Iterable[str], *shapes: Shapes) -> Self:
        """Return a layout; shapes: of what is observed, and of what is constant."""
        observation, constant = ({name: tuple(shape) for name, shape in given.items()} for given in shapes)
        return cls(terms, tuple(names), tuple(paths), observation, constant)

    def __getitem__(self, name: str) -> Any:
        """Return a term by its name."""
        return next(term for term in self.terms if term.name == name)

    @cached_property
    def rows(self) -> dict[str, slice]:
        """Rows of each name in what is observed."""
        stops = [sum(map(prod, list(self.observation.values())[: k + 1])) for k in range(len(self.observation))]
        return dict(zip(self.observation, map(slice, [0, *stops], stops), strict=False))

    @property
    def constant_errors(self) -> tuple[str, ...]:
        """Weights of observations whose errors are constant over a fragment."""
        return sum((term.constant_errors for term in self.terms), ())
