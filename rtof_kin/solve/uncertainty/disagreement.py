"""Difference between a solution and its initial guess, frame by frame, as covariances.

The initial guess (SF2; without sensors the lifter) and the solution are two estimates of the same pose.
Where they differ more than usual one of them is wrong, which the Hessian at the solution does not show.
`CovarianceInflation` adds a share of the difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.data.confidence import WORLD
from rtof_kin.data.poses import PoseSequence

WINDOW: Final = 0.15
"""[s] averaged before and after a frame."""


@dataclass(frozen=True)
class Disagreement:
    """Mean squares of differences between two estimates of a motion; zero where one is missing."""

    position: Array
    """(T, J, 3, 3) m^2, of joints' positions in world."""
    relative: Array
    """(T, J, 3, 3) m^2, of positions less the root's, in world's axes."""
    turn: Array
    """(T, P, 3, 3) rad^2, of pairs' orientations, in the child's axes."""

    def __post_init__(self) -> None:
        for field in ("position", "relative", "turn"):
            value = readonly(f"disagreement {field}", getattr(self, field), ("T", "n", 3, 3))
            object.__setattr__(self, field, value)

    def __getitem__(self, frames: slice) -> Self:
        return type(self)(self.position[frames], self.relative[frames], self.turn[frames])


def disagreement(
    solved: PoseSequence, start: PoseSequence, pairs: Sequence[tuple[str, str]], window: float = WINDOW
) -> Disagreement:
    """Return the difference of two estimates.

    Args:
        pairs: of segments, as `Confidence.pairs`. window: averaged before and after a frame, s.
    """
    off = solved.p_world_joint - start.p_world_joint
    names = (*solved.names, WORLD)
    R = [_with_world(poses.R_world_bone) for poses in (solved, start)]
    parents, children = np.array([[names.index(name) for name in pair] for pair in pairs]).T
    seen = [np.swapaxes(r[:, parents], -1, -2) @ r[:, children] for r in R]
    between = np.swapaxes(seen[1], -1, -2) @ seen[0]
    known = np.isfinite(between).all(axis=(2, 3))
    turn = np.full(between.shape[:3], np.nan)
    turn[known] = so3.log(between[known])
    reach = round(window * solved.rate_hz)
    return Disagreement(*(_mean_square(d, reach) for d in (off, off - off[:, :1], turn)))


def _with_world(R: Array) -> Array:
    """Orientations (T, J + 1, 3, 3), the world's last."""
    world = np.broadcast_to(np.eye(3), (len(R), 1, 3, 3))
    return np.concatenate([R, world], axis=1)


def _mean_square(d: Array, reach: int) -> Array:
    """(T, n, 3, 3) mean of the outer products of vectors (T, n, 3) over frames up to `reach` away."""
    d = np.where(np.isfinite(d).all(axis=-1, keepdims=True), d, 0.0)
    square = d[..., :, None] * d[..., None, :]
    total = np.concatenate([np.zeros((1, *square.shape[1:])), np.cumsum(square, axis=0)])
    i = np.arange(len(d))
    first, stop = np.maximum(i - reach, 0), np.minimum(i + reach + 1, len(d))
    mean = (total[stop] - total[first]) / (stop - first)[:, None, None, None]
    return np.asarray((mean + np.swapaxes(mean, -1, -2)) / 2)
