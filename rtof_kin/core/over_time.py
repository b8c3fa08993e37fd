"""`Sampled` and `OverTime`: bases of what is known, and has a row, at each of T times; `Stream`, rows not in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Final, Generic, Self, TypeVar

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.environment import return_free_memory

ALL: Final = slice(None)
BLOCK: Final = 2048  #: Rows that are read at once


class Sampled:
    """What is known at `times` (T,), s."""

    times: Array

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def rate_hz(self) -> float:
        """Rate, Hz, from the median step; 60 for a single row."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0


class OverTime(Sampled):
    """Frozen dataclasses with fields `rows` that have a row for each of the times, or are None."""

    rows: ClassVar[tuple[str, ...]] = ()

    def __getitem__(self, frames: slice | Index) -> Self:
        whole = isinstance(frames, slice) and frames.indices(len(self)) == (0, len(self), 1)
        return self if whole else replace(self, **self.cut(frames))  # type: ignore[type-var]

    def cut(self, frames: slice | Index) -> dict[str, Any]:
        """Return some rows of the fields by name."""
        own = {name: getattr(self, name) for name in ("times", *self.rows)}
        return {name: value if value is None else value[frames] for name, value in own.items()}


Part = TypeVar("Part", bound=OverTime)


@dataclass(frozen=True)
class Stream(Sampled, Generic[Part]):
    """Samples of one kind, made row by row, so that they need not be in memory."""

    times: Array  #: (T,) s
    part: Callable[[slice], Part]  #: Samples of some rows, at least one; of `ALL` they are checked as a whole

    @classmethod
    def of(cls, whole: Part | Stream[Part]) -> Stream[Part]:
        """Return the stream of samples in memory; a stream is returned as it is."""
        if isinstance(whole, Stream):
            return whole
        return Stream(whole.times, whole.__getitem__)

    def between(self, start_s: float, stop_s: float) -> Part | None:
        """Return the samples in a closed interval, s; None where there are none."""
        rows = signals.within(self.times, start_s, stop_s)
        return self.part(rows) if rows.start < rows.stop else None

    def blocks(self, after: int = 0) -> Iterator[Part]:
        """Yield all samples in order, `BLOCK` at a time and so many after them."""
        for start in range(0, len(self), BLOCK):
            yield self.part(slice(start, min(start + BLOCK + after, len(self))))
            return_free_memory()
