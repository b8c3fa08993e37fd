"""`Inflation`: what errors that last add to what the Hessian knows.

A Hessian takes residuals for independent draws. A detector's bias, a sensor that sits askew or a foot that
is no joint centre stay for seconds: they do not average out, and no weight of a fragment knows them. So
every covariance C of the Hessian becomes

::

    K C K + diag(b)^2

with a factor K and a floor b for every joint and every pair of segments, the same for right and left, that
were fitted on recordings of other people (``python -m benchmarks.confidence --fit``): the numbers with
which errors are likeliest under normal distributions of that width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.confidence import Confidence
from rtof_kin.errors import FileFormatError, ShapeError
from rtof_kin.io.text import load_toml
from rtof_kin.resources import model_path

Array = NDArray[np.float64]
KINDS = {"position": "m", "relative": "m", "turn": "rad"}
"""Covariances of a `Confidence` and the unit of their floors."""
OTHER = "other"


@dataclass(frozen=True)
class Widening:
    """Of one covariance."""

    factor: Array
    """(3,) by axis: world's of positions, the child segment's of turns."""
    floor: Array
    """(3,) standard deviation, m or rad."""

    def __post_init__(self) -> None:
        for field in ("factor", "floor"):
            value = np.broadcast_to(np.asarray(getattr(self, field), dtype=float), 3)
            if not (np.isfinite(value).all() and (value >= 0).all()):
                raise ShapeError(f"widening {field}: {value} must be three finite numbers, not negative")
            object.__setattr__(self, field, value)


@dataclass(frozen=True)
class Inflation:
    """Widenings of all covariances of a skeleton, by `unsided` name."""

    widenings: Mapping[str, Mapping[str, Widening]]
    """Kind of `KINDS` -> joint, or parent and child -> widening; `OTHER` is for what has none."""

    def __post_init__(self) -> None:
        missing = [kind for kind in KINDS if OTHER not in self.widenings.get(kind, {})]
        if missing:
            raise ShapeError(f"inflation: no widening {OTHER!r} of {', '.join(missing)}")

    @classmethod
    def shipped(cls) -> Inflation:
        """That of ``models/confidence.toml``, read once."""
        return _shipped()

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a file that `text` wrote.

        Raises:
            FileFormatError: it is not one.
        """
        data = load_toml(Path(path))
        try:
            return cls({
                kind: {name: Widening(**entry) for name, entry in data[kind].items()} for kind in KINDS
            })  # fmt: skip
        except (KeyError, TypeError, AttributeError, ShapeError) as error:
            raise FileFormatError(path, f"no table of widenings: {error}") from error

    def text(self) -> str:
        """As TOML."""
        lines = []
        for kind, unit in KINDS.items():
            lines += [f"[{kind}]  # floor in {unit}"]
            for name, w in self.widenings[kind].items():
                factor, floor = ([float(f"{v:.3g}") for v in value] for value in (w.factor, w.floor))
                lines.append(f'"{name}" = {{ factor = {factor}, floor = {floor} }}')
            lines.append("")
        return "\n".join(lines)

    def apply(self, confidence: Confidence) -> Confidence:
        """The confidence with every covariance widened."""
        names, pairs = confidence.names, [f"{parent} {child}" for parent, child in confidence.pairs]
        relative = self._widened("relative", names, confidence.relative_covariance)
        relative[:, 0] = 0.0  # the root, less itself
        return replace(
            confidence,
            position_covariance=self._widened("position", names, confidence.position_covariance),
            relative_covariance=relative,
            turn_covariance=self._widened("turn", pairs, confidence.turn_covariance),
        )

    def _widened(self, kind: str, names: Sequence[str], covariance: Array) -> Array:
        known = self.widenings[kind]
        chosen = [known.get(unsided(name), known[OTHER]) for name in names]
        factor = np.reshape([widening.factor for widening in chosen], (-1, 3))
        floor = np.reshape([widening.floor for widening in chosen], (-1, 3))
        scale = factor[:, :, None] * factor[:, None, :]
        return np.asarray(covariance * scale + np.eye(3) * floor[:, :, None] ** 2)


def unsided(name: str) -> str:
    """A joint's name, or those of a pair, without its side: what is symmetric is fitted once."""
    return " ".join(word.removeprefix("Right").removeprefix("Left") for word in name.split())


@cache
def _shipped() -> Inflation:
    return Inflation.read(model_path("confidence.toml"))
