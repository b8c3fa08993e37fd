"""`CovarianceInflation`: what errors that last add to what the Hessian knows.

A Hessian takes residuals for independent draws. A detector's bias, a sensor that sits askew or a
landmark that is no joint centre stay for seconds: they do not average out, and no weight of a fragment
knows of them. So every covariance C of the Hessian becomes

::

    K C K + B^2 + a^2 D      K = k0 + m (k - k0)      B = m d b

with diagonal matrices of a factor k and a floor b for every joint and every pair of segments, the same
for right and left, which hold for a detector as they are. In what frames something is wrong, *D* says:
mean squares of the difference between the solution and the start that it was solved from
(`rtof_kin.solve.uncertainty.disagreement`), with one share a for all joints of a kind. Three things of the recording itself
(`ResidualStatistics`) say how much of that is in it:

- *m*: how far residuals of its keypoints last. Where they are white they average out as the Hessian
  says, and only the sensors' errors are left, which k0 stands for.
- *d*: how sure the lifter is of the trunk, against what is usual; only of what no sensor holds.
- who saw what:

=======  ==========================================================================================
camera   there is no sensor anywhere; of positions in world, no limb has one on both of its
         bones, and the solver leaves the root about where the lifter has it
fused    there are sensors, but not where the next row says
sensed   both segments of a pair carry one (or the one that is told against the world); of positions
         relative to the root, the root's segment does
=======  ==========================================================================================

The numbers were fitted on recordings of other people (``python -m benchmarks.confidence --fit``).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.limbs import both_bones_sensed
from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import FileFormatError, ShapeError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.solve.uncertainty.disagreement import Disagreement

Array = NDArray[np.float64]
UNITS = {"position": "m", "relative": "m", "turn": "rad"}
"""Covariances of a `Confidence`, and the unit of their floors."""
SEEN = {"camera": tuple(UNITS), "fused": tuple(UNITS), "sensed": ("relative", "turn")}
"""Who saw it, and of which covariances that is told apart."""
OTHER = "other"
"""Name of the widening of what has none of its own."""
USUAL_TORSO_SIGMA = 0.09
"""[rad] of pelvis and upper trunk as the lifter tells it of a usual recording."""
_SHARES = "apart"
"""Table of the shares in a file."""
_WHITE_FACTOR = 1.2
"""k0: errors in such of the Hessian's standard deviations with white 2D and eight real sensors, of
people of the fit; the same of positions and turns."""


@dataclass(frozen=True)
class ResidualStatistics:
    """What a recording tells of its own errors; by default as a usual one without sensors."""

    sensors: tuple[str, ...] = ()
    """Joints whose segments carry one."""
    lasting: float = 1.0
    """m, 0 to 1: how far residuals of the keypoints last, from white to a detector's."""
    torso_sigma: float = USUAL_TORSO_SIGMA
    """[rad] how sure the lifter is of pelvis and upper trunk."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", checked_names("circumstances sensors", self.sensors))
        if not 0 <= self.lasting <= 1:
            raise ShapeError(f"circumstances lasting: {self.lasting} is not in [0, 1]")
        if not 0 < self.torso_sigma < np.inf:
            raise ShapeError(f"circumstances torso_sigma: {self.torso_sigma} must be positive and finite")

    def doubt(self, kind: str, seen: str) -> float:
        """D of a covariance of `UNITS` by who saw it."""
        held = kind == "position" or seen == "sensed"
        return 1.0 if held else self.torso_sigma / USUAL_TORSO_SIGMA


@dataclass(frozen=True)
class Widening:
    """Of one covariance."""

    factor: Array
    """(3,) by axis: world's of positions, the child segment's of turns. At least 1: nobody knows more
    than the Hessian."""
    floor: Array
    """(3,) standard deviation, m or rad."""

    def __post_init__(self) -> None:
        for name, least in (("factor", 1.0), ("floor", 0.0)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape not in ((), (3,)) or not np.all(np.isfinite(value) & (value >= least)):
                raise ShapeError(
                    f"widening {name}: {value} must be one or three numbers, none below {least:g}"
                )
            object.__setattr__(self, name, np.broadcast_to(value, 3))


@dataclass(frozen=True)
class CovarianceInflation:
    """Widenings of all covariances of a skeleton."""

    widenings: Mapping[str, Mapping[str, Mapping[str, Widening]]]
    """By who saw it (`SEEN`), kind (`UNITS`) and `unsided` name of the joint, or of parent and child."""
    shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """a, by who saw it and kind: standard deviations per distance from the start; 0 where not given."""

    def __post_init__(self) -> None:
        for seen, shares in self.shares.items():
            for kind, share in shares.items():
                if kind not in SEEN.get(seen, ()) or not 0 <= share < np.inf:
                    raise ShapeError(f"inflation: the share {share} of {seen}.{kind} cannot be")
        for seen, kinds in SEEN.items():
            for kind in kinds:
                if OTHER not in self.widenings.get(seen, {}).get(kind, {}):
                    raise ShapeError(f"inflation: no widening {OTHER!r} of {seen}.{kind}")

    @classmethod
    def shipped(cls) -> CovarianceInflation:
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
                seen: {
                    kind: {name: Widening(**entry) for name, entry in data[seen][kind].items()}
                    for kind in kinds
                }
                for seen, kinds in SEEN.items()
            }, data.get(_SHARES, {}))  # fmt: skip
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise FileFormatError(path, f"no table of widenings: {error}") from error

    def text(self) -> str:
        """As TOML."""
        lines = [f"[{_SHARES}]  # of the distance between solution and start"]
        for seen, shares in self.shares.items():
            told = ", ".join(f"{kind} = {share:.3g}" for kind, share in shares.items())
            lines.append(f"{seen} = {{ {told} }}")
        lines.append("")
        for seen, kinds in SEEN.items():
            for kind in kinds:
                lines.append(f"[{seen}.{kind}]  # floor in {UNITS[kind]}")
                for name, w in self.widenings[seen][kind].items():
                    lines.append(f'"{name}" = {{ factor = {_text(w.factor)}, floor = {_text(w.floor)} }}')
                lines.append("")
        return "\n".join(lines)

    def apply(
        self, confidence: Confidence, circumstances: ResidualStatistics, apart: Disagreement | None = None
    ) -> Confidence:
        """A confidence of the Hessian alone, widened.

        Args:
            apart: the solution from its start, at the same times; none counts where not given.
        """
        names = confidence.names
        pairs = [" ".join(pair) for pair in confidence.pairs]

        def widened(kind: str, entries: Sequence[str], covariance: Array) -> Array:
            factor, floor = self._of(kind, entries, names[0], circumstances)
            scale = factor[:, :, None] * factor[:, None, :]
            wide = covariance * scale + np.eye(3) * floor[:, :, None] ** 2
            if apart is not None:
                wide += self._shares(kind, entries, names[0], circumstances) ** 2 * getattr(apart, kind)
            return np.asarray(wide)

        relative = widened("relative", names, confidence.relative_covariance)
        relative[:, 0] = 0.0  # the root less itself
        return replace(
            confidence,
            position_covariance=widened("position", names, confidence.position_covariance),
            relative_covariance=relative,
            turn_covariance=widened("turn", pairs, confidence.turn_covariance),
        )

    def _of(
        self, kind: str, names: Sequence[str], root: str, circumstances: ResidualStatistics
    ) -> tuple[Array, Array]:
        """K and B (n, 3) of some entries of a kind of covariance."""
        factors, floors = [], []
        for name in names:
            seen = seen_by(kind, name, root, circumstances.sensors)
            known = self.widenings[seen][kind]
            widening = known.get(unsided(name), known[OTHER])
            factors.append(factor_where(widening.factor, circumstances.lasting))
            floors.append(widening.floor * circumstances.lasting * circumstances.doubt(kind, seen))
        return np.array(factors), np.array(floors)

    def _shares(self, kind: str, names: Sequence[str], root: str, circumstances: ResidualStatistics) -> Array:
        """A (n, 1, 1) of some entries of a kind of covariance."""
        seen = [seen_by(kind, name, root, circumstances.sensors) for name in names]
        return np.array([self.shares.get(who, {}).get(kind, 0.0) for who in seen])[:, None, None]


def factor_where(factor: ArrayLike, lasting: ArrayLike) -> Array:
    """K of factors k where residuals last as far as `lasting` says, 0 to 1."""
    k = np.asarray(factor, dtype=float)
    white = np.minimum(k, _WHITE_FACTOR)
    return np.asarray(white + (k - white) * lasting)


def factor_rate(factor: float, lasting: ArrayLike) -> Array:
    """Derivative of `factor_where` by the factor."""
    return np.asarray(1.0 + (factor > _WHITE_FACTOR) * (np.asarray(lasting, dtype=float) - 1.0))


def seen_by(kind: str, name: str, root: str, sensors: Collection[str]) -> str:
    """Who saw what a covariance is of: a key of `SEEN`.

    Args:
        kind: of `UNITS`. name: the joint, or parent and child. root: the root joint's name.
        sensors: joints whose segments carry one.
    """
    if not sensors:
        return "camera"
    if kind == "position":
        return "fused" if both_bones_sensed(sensors) else "camera"
    needs = {root} if kind == "relative" else {*name.split()} - {WORLD}
    return "sensed" if needs <= {*sensors} else "fused"


def unsided(name: str) -> str:
    """A joint's name, or those of a pair, without its side: what is symmetric is fitted once."""
    return " ".join(word.removeprefix("Right").removeprefix("Left") for word in name.split())


def _text(value: Array) -> str:
    rounded = [f"{max(float(f'{v:.3g}'), 0.0):g}" for v in value]
    return rounded[0] if len(set(rounded)) == 1 else f"[{', '.join(rounded)}]"


@cache
def _shipped() -> CovarianceInflation:
    return CovarianceInflation.read(model_path("confidence.toml"))
