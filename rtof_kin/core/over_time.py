"""`Sampled` and `OverTime`: bases of what is known, and has a row, at each of T times."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from rtof_kin.core.array_types import Array, Index


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
        return replace(self, **self.cut(frames))  # type: ignore[type-var]

    def cut(self, frames: slice | Index) -> dict[str, Any]:
        """Return some rows of the fields by name."""
        own = {name: getattr(self, name) for name in ("times", *self.rows)}
        return {name: value if value is None else value[frames] for name, value in own.items()}
