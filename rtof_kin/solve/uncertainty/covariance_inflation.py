"""`CovarianceInflation`: covariances inflated for autocorrelated errors.

A Hessian assumes independent residuals. A detector's bias, a misaligned sensor, a landmark beside the
joint centre, a neutral posture or a camera that is not where it is said to be are constant for seconds or
for the whole recording: they do not average out. So every covariance C becomes

::

    K C K + B^2 + a^2 D + (m f)^2 r r^T      K = k0 + m (k - k0)      B = m d b

with diagonal matrices of a factor k and a floor b for every joint and every pair of segments, equal for right and
left. D are mean squares of the difference between solution and initial guess (`disagreement`), with one factor a for
all joints of a kind. r is the vector from the camera to a joint, of positions in world only: how far a person is away
follows from the apparent size, and is known to a share f of it. `ResidualStatistics` of the recording give the rest:

- m: autocorrelation of the keypoints' residuals, 0 (white) to 1 (a detector's). k0 stands for the errors
  of the sensors alone.
- d: the lifter's sigma of the trunk over the usual one; only without sensors there.
- the class of the observation:

=======  ==========================================================================================
camera   no sensors; for positions in world, no limb has sensors on both of its bones
fused    with sensors, but not as in the next row
sensed   both segments of a pair (the one of a pair with the world) have a sensor; for positions
         relative to the root, the root's segment has one
=======  ==========================================================================================

The numbers were fitted on recordings of other people (``python -m benchmarks confidence --fit``).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body.limbs import both_bones_sensed
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.solve.uncertainty.disagreement import Disagreement

UNITS: Final = {"position": "m", "relative": "m", "turn": "rad"}
"""Kinds of covariances of a `Confidence`, and the unit of their floors."""
SEEN: Final = {"camera": tuple(UNITS), "fused": tuple(UNITS), "sensed": ("relative", "turn")}
"""Classes of observations, and the kinds of covariances that have them."""
OTHER: Final = "other"
"""Name of the default widening."""
USUAL_TORSO_SIGMA: Final = 0.09
"""[rad] Usual sigma of pelvis and upper trunk by the lifter."""
_SHARES: Final = "apart"
"""Table of the factors a in a file."""
_DEPTHS: Final = "depth"
"""Table of the shares f in a file."""
WHITE_FACTOR: Final = 1.2
"""k0, fitted with white 2D errors and eight real sensors."""


@dataclass(frozen=True)
class ResidualStatistics:
    """Statistics of a recording's errors; the defaults are those of a usual one without sensors."""

    sensors: tuple[str, ...] = ()
    """Joints whose segments carry one."""
    autocorrelation: float = 1.0
    """m, 0 to 1: autocorrelation of the keypoints' residuals, from white to a detector's."""
    torso_sigma: float = USUAL_TORSO_SIGMA
    """[rad] The lifter's standard deviation of pelvis and upper trunk."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", checked_names("residual statistics sensors", self.sensors))
        if not 0 <= self.autocorrelation <= 1:
            raise InvalidInputError(f"autocorrelation: {self.autocorrelation} is not in [0, 1]")
        if not 0 < self.torso_sigma < np.inf:
            raise InvalidInputError(f"torso_sigma: {self.torso_sigma} must be positive and finite")

    def torso_factor(self, kind: str, seen: str) -> float:
        """Return d.

        Args:
            kind: of `UNITS`. seen: of `SEEN`.
        """
        return 1.0 if kind == "position" or seen == "sensed" else self.torso_sigma / USUAL_TORSO_SIGMA


@dataclass(frozen=True)
class Widening:
    """Factor and floor of one covariance."""

    factor: Array
    """k (3,) by axis: world's for positions, the child segment's for turns. At least 1."""
    floor: Array
    """b (3,) standard deviation, m or rad."""

    def __post_init__(self) -> None:
        for name, least in (("factor", 1.0), ("floor", 0.0)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape not in ((), (3,)) or not np.all(np.isfinite(value) & (value >= least)):
                raise InvalidInputError(f"widening {name}: {value} must be one or three numbers, none below {least:g}")
            object.__setattr__(self, name, np.broadcast_to(value, 3))


@dataclass(frozen=True)
class CovarianceInflation:
    """Widenings of all covariances of a skeleton."""

    widenings: Mapping[str, Mapping[str, Mapping[str, Widening]]]
    """By class (`SEEN`), kind (`UNITS`) and `unsided` name of the joint, or of parent and child."""
    shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """a, by class and kind; 0 where not given."""
    depths: Mapping[str, float] = field(default_factory=dict)
    """f, by class; 0 where not given."""

    def __post_init__(self) -> None:
        for seen, share in self.depths.items():
            if "position" not in SEEN.get(seen, ()) or not 0 <= share < np.inf:
                raise InvalidInputError(f"inflation: the share {share} of {seen}.depth cannot be")
        for seen, shares in self.shares.items():
            for kind, share in shares.items():
                if kind not in SEEN.get(seen, ()) or not 0 <= share < np.inf:
                    raise InvalidInputError(f"inflation: the share {share} of {seen}.{kind} cannot be")
        for seen, kinds in SEEN.items():
            for kind in kinds:
                if OTHER not in self.widenings.get(seen, {}).get(kind, {}):
                    raise InvalidInputError(f"inflation: no widening {OTHER!r} of {seen}.{kind}")

    @classmethod
    @cache
    def shipped(cls) -> CovarianceInflation:
        """Return that of ``models/confidence.toml``, read once."""
        return cls.read(model_path("confidence.toml"))

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a file that `text` wrote.

        Raises:
            FileFormatError: it is not one.
        """
        data = load_toml(Path(path))
        try:
            widenings = {
                seen: {kind: {name: Widening(**entry) for name, entry in data[seen][kind].items()} for kind in kinds}
                for seen, kinds in SEEN.items()
            }
            return cls(widenings, data.get(_SHARES, {}), data.get(_DEPTHS, {}))
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise FileFormatError(path, f"no table of widenings: {error}") from error

    def text(self) -> str:
        """Return it as TOML."""
        lines = [f"[{_SHARES}]  # of the distance between solution and start"]
        for seen, shares in self.shares.items():
            entries = ", ".join(f"{kind} = {share:.3g}" for kind, share in shares.items())
            lines.append(f"{seen} = {{ {entries} }}")
        lines += ["", f"[{_DEPTHS}]  # of the distance from the camera"]
        lines += [f"{seen} = {share:.3g}" for seen, share in self.depths.items()]
        lines.append("")
        for seen, kinds in SEEN.items():
            for kind in kinds:
                lines.append(f"[{seen}.{kind}]  # floor in {UNITS[kind]}")
                for name, w in self.widenings[seen][kind].items():
                    lines.append(f'"{name}" = {{ factor = {_text(w.factor)}, floor = {_text(w.floor)} }}')
                lines.append("")
        return "\n".join(lines)

    def apply(
        self,
        confidence: Confidence,
        statistics: ResidualStatistics,
        apart: Disagreement | None = None,
        p_camera_joint: Array | None = None,
    ) -> Confidence:
        """Return inflated covariances.

        Args:
            apart: of solution and initial guess, at the same times; None: D = 0.
            p_camera_joint: (T, J, 3) m, joints as seen from the camera, world axes; None: f = 0.
        """
        names, root = confidence.names, confidence.names[0]
        pairs = [" ".join(pair) for pair in confidence.pairs]

        def widened(kind: str, entries: Sequence[str], covariance: Array) -> Array:
            seen = [seen_by(kind, name, root, statistics.sensors) for name in entries]
            factor, floor = self._scales(kind, entries, seen, statistics)
            scale = factor[:, :, None] * factor[:, None, :]
            wide = covariance * scale + np.eye(3) * floor[:, :, None] ** 2
            if apart is not None:
                shares = np.array([self.shares.get(who, {}).get(kind, 0.0) for who in seen])
                wide += shares[:, None, None] ** 2 * getattr(apart, kind)
            return np.asarray(wide)

        relative = widened("relative", names, confidence.relative_covariance)
        relative[:, 0] = 0.0  # the root relative to itself
        position = widened("position", names, confidence.position_covariance)
        if p_camera_joint is not None:
            depth = self.depths.get(seen_by("position", root, root, statistics.sensors), 0.0)
            position += (statistics.autocorrelation * depth) ** 2 * outer_squares(p_camera_joint)
        return replace(
            confidence,
            position_covariance=position,
            relative_covariance=relative,
            turn_covariance=widened("turn", pairs, confidence.turn_covariance),
        )

    def _scales(
        self, kind: str, names: Sequence[str], seen: Sequence[str], statistics: ResidualStatistics
    ) -> tuple[Array, Array]:
        """K and B (n, 3)."""
        factors, floors, m = [], [], statistics.autocorrelation
        for name, who in zip(names, seen, strict=True):
            known = self.widenings[who][kind]
            widening = known.get(unsided(name), known[OTHER])
            factors.append(correlated_factor(widening.factor, m))
            floors.append(widening.floor * m * statistics.torso_factor(kind, who))
        return np.array(factors), np.array(floors)


def correlated_factor(factor: ArrayLike, autocorrelation: ArrayLike) -> Array:
    """Return K.

    Args:
        autocorrelation: m, 0 to 1.
    """
    k = np.asarray(factor, dtype=float)
    white = np.minimum(k, WHITE_FACTOR)
    return np.asarray(white + (k - white) * autocorrelation)


def seen_by(kind: str, name: str, root: str, sensors: Collection[str]) -> str:
    """Return the class of the observation of a covariance, a key of `SEEN`.

    Args:
        kind: of `UNITS`. root: the root joint's name.
    """
    if not sensors:
        return "camera"
    if kind == "position":
        return "fused" if both_bones_sensed(sensors) else "camera"
    needs = {root} if kind == "relative" else {*name.split()} - {WORLD}
    return "sensed" if needs <= {*sensors} else "fused"


def outer_squares(vectors: Array) -> Array:
    """Return the matrices ``v v^T`` (..., 3, 3) of vectors (..., 3)."""
    return np.asarray(vectors[..., :, None] * vectors[..., None, :])


def unsided(name: str) -> str:
    """Return a joint's name, or those of a pair, without their side.

    Args:
        name: of a joint, or of two joints separated by a space.
    """
    return " ".join(word.removeprefix("Right").removeprefix("Left") for word in name.split())


def _text(value: Array) -> str:
    rounded = [f"{max(float(f'{v:.3g}'), 0.0):g}" for v in value]
    return rounded[0] if len(set(rounded)) == 1 else f"[{', '.join(rounded)}]"
