"""Headings that a pose leaves open, from the movement after it.

A sensor that was calibrated in a pose is right in that pose whatever the heading h of its reference: with
R_world_bone = R_pose at the time 0 of the pose,

    R_world_bone(t; h) = Rz(h) R_inertial_sensor(t) R_inertial_sensor(0)^T Rz(-h) R_pose.

What h changes is the axis, in the body, about which the segment turns afterwards: with a heading that
is off by 90 degrees a bow forward is read as a bow to the side. `MotionLikelihood` judges that. On the tree of
pairs that it compares, the best set of headings is found exactly on a grid (max-product, Pearl 1988),
then refined. An axis that is vertical in the pose tells nothing about the heading: of an elbow stretched
in a T-pose much less is known than of one in an N-pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.inertial.likelihood import MotionLikelihood
from rtof_kin.inertial.segment_motion import SegmentMotion

Array = NDArray[np.float64]
GRID = 18
"""Headings tried in the first round: every 20 degrees."""
_BELIEF = 0.2
"""Share of the evidence that standard deviations are made of: all of it suffers from the same errors of
pose and soft tissue, so that it is worth fewer nats than it counts."""
_REFINEMENTS_DEG = (5.0, 1.5, 0.5)


@dataclass(frozen=True)
class Headings:
    """Headings of sensors, and how sure they are."""

    angles: Array
    """(S,) rad about z, to be added to those of the motions."""
    sigmas: Array
    """(S,) rad, standard deviation of each with the others as they are; up to 1.8, that of all directions
    alike."""
    margin: float
    """Nats by which the best set on the grid stands above the best one with every heading more than 45
    degrees off; above about 3 it is not mistaken for a quarter or half turn."""


def own_headings(evidence: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """A heading for each sensor.

    Args:
        motions: S, calibrated in the pose as if every heading was 0. R_pose: (S, 3, 3) R_world_bone of
            their segments in the pose.
    """
    turned = _Turned(evidence, motions, R_pose)
    grid = _grid()
    angles = grid[turned.best_on_grid(grid)]
    for step in np.radians(_REFINEMENTS_DEG):
        angles = turned.refined(angles, step)
    sigmas, margins = zip(*(_spread(turned.along(angles, s)) for s in range(len(motions))), strict=True)
    return Headings(wrapped(angles), np.array(sigmas), float(min(margins)))


def shared_heading(evidence: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """One heading for all sensors; arguments as for `own_headings`."""
    turned = _Turned(evidence, motions, R_pose)
    everyone = np.ones(len(motions))

    def score(angle: float) -> float:
        return turned.total(angle * everyone)

    sigma, margin = _spread(score)
    best = float(_grid()[int(np.argmax([score(h) for h in _grid()]))])
    for step in np.radians(_REFINEMENTS_DEG):
        around = best + step * np.arange(-2, 3)
        best = float(around[int(np.argmax([score(h) for h in around]))])
    return Headings(wrapped(best * everyone), sigma * everyone, margin)


def wrapped(angles: ArrayLike) -> Array:
    """Angles in (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - np.asarray(angles, dtype=float)) % (2 * np.pi))


def _grid() -> Array:
    return np.asarray(2 * np.pi / GRID * np.arange(GRID), dtype=np.float64)


def _spread(score: Callable[[float], float]) -> tuple[float, float]:
    """Circular standard deviation of exp(score) over all headings, and the margin over far ones."""
    angles = 2 * np.pi / (2 * GRID) * np.arange(2 * GRID)
    values = np.array([score(h) for h in angles])
    best = int(np.argmax(values))
    weights = np.exp(_BELIEF * (values - values[best]))
    length = np.abs(np.sum(weights * np.exp(1j * angles))) / weights.sum()
    far = np.abs(wrapped(angles - angles[best])) > np.radians(45.0)
    sigma = np.sqrt(-2 * np.log(np.clip(length, 0.2, 1.0)) + (np.pi / len(angles)) ** 2)
    return float(sigma), float(values[best] - values[far].max())


class _Turned:
    """Motions under other headings, and what the evidence says of them."""

    def __init__(self, evidence: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> None:
        self.evidence, self.R_pose = evidence, R_pose
        self.motions = list(motions)
        joints = [r.joint for r in motions]
        self.pairs = [(joints.index(a), joints.index(b)) for a, b in evidence.tree(joints)]

    def motion(self, s: int, angle: float) -> SegmentMotion:
        """One sensor as it is with this heading."""
        turn, own = so3.about_axis("z", angle), self.motions[s]
        R_bone_new = self.R_pose[s].T @ turn.T @ self.R_pose[s]
        return own.turned(turn).moved(own.joint, R_bone_new, own.p_bone_sensor)

    def total(self, angles: Array) -> float:
        """Nats of all."""
        motions = [self.motion(s, float(h)) for s, h in enumerate(angles)]
        out = sum(self.evidence.pair(motions[a], motions[b]) for a, b in self.pairs)
        return float(out + sum(self.evidence.single(r) for r in motions))

    def along(self, angles: Array, s: int) -> Callable[[float], float]:
        """Nats of what concerns sensor s, by its heading, the others as they are."""
        others = {i: self.motion(i, float(angles[i])) for pair in self.pairs if s in pair for i in pair}

        def score(angle: float) -> float:
            own = {**others, s: self.motion(s, angle)}
            near = (pair for pair in self.pairs if s in pair)
            single = self.evidence.single(own[s])
            return single + sum(self.evidence.pair(own[a], own[b]) for a, b in near)

        return score

    def refined(self, angles: Array, step: float) -> Array:
        """Each heading in turn moved by up to two steps to where it fits best."""
        angles = angles.copy()
        for s in range(len(angles)):
            score = self.along(angles, s)
            around = angles[s] + step * np.arange(-2, 3)
            angles[s] = around[int(np.argmax([score(float(h)) for h in around]))]
        return angles

    def best_on_grid(self, grid: Array) -> NDArray[np.intp]:
        """Indices (S,) of the set of grid headings with the highest total, by messages up the tree."""
        motions = [[self.motion(s, float(h)) for h in grid] for s in range(len(self.motions))]
        belief = np.array([[self.evidence.single(r) for r in own] for own in motions])
        tables = {
            (a, b): np.array([[self.evidence.pair(x, y) for y in motions[b]] for x in motions[a]])
            for a, b in self.pairs
        }
        tables |= {(b, a): table.T for (a, b), table in list(tables.items())}
        order = _from_first(len(motions), list(tables))
        choices = {}
        for parent, child in reversed(order):
            message = tables[parent, child] + belief[child]
            choices[parent, child] = message.argmax(axis=1)
            belief[parent] += message.max(axis=1)
        best = np.zeros(len(motions), dtype=np.intp)
        best[0] = int(belief[0].argmax())
        for parent, child in order:
            best[child] = choices[parent, child][best[parent]]
        return best


def _from_first(count: int, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Edges (parent, child) of a tree on 0 ... count - 1, from node 0 outwards."""
    reached, order = [0], []
    for node in reached:
        for a, b in pairs:
            if a == node and b not in reached:
                reached.append(b)
                order.append((a, b))
    assert len(reached) == count
    return order
