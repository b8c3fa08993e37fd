"""Headings that a calibration pose leaves open, estimated from the movement after it.

A sensor calibrated in a pose is right in that pose for any heading h of its reference: with R_world_bone =
R_pose at the time 0 of the pose,

    R_world_bone(t; h) = Rz(h) R_inertial_sensor(t) R_inertial_sensor(0)^T Rz(-h) R_pose.

h changes the axis in the body about which the segment rotates afterwards. The likelihood of the movement
is maximised exactly on a grid of headings and the tree of compared pairs (max-product, Pearl 1988), then
refined. An axis that is vertical in the pose does not determine the heading.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import breadth_first_order

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.inertial.likelihood import MotionLikelihood, SegmentMotion

Score = Callable[[float], float]
_GRID = 18  # headings of the grid: every 20 degrees
_BELIEF = 0.2  # [-] weight of the log-likelihood in standard deviations, as errors of pose are common to all
_REFINEMENTS = np.radians([5.0, 1.5, 0.5])


@dataclass(frozen=True)
class Headings:
    """Headings of sensors and their uncertainty."""

    angles: Array
    """(S,) rad about z, to be added to those of the motions."""
    sigmas: Array
    """(S,) rad, standard deviation of each with the others fixed; up to 1.8 (uniform)."""
    margin: float
    """Log-likelihood ratio, nats, to the best heading more than 45 degrees away."""


def own_headings(likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """Estimate a heading for each sensor.

    Args:
        motions: S, calibrated in the pose with headings 0.
        R_pose: (S, 3, 3) R_world_bone of their segments in the pose.
    """
    turned = _Turned(likelihood, motions, R_pose)
    angles = turned.best_on_grid()
    for step in _REFINEMENTS:
        for s in range(len(angles)):
            angles[s] = _refined(turned.along(angles, s), float(angles[s]), step)
    sigmas, margins = zip(*(_spread(turned.along(angles, s)) for s in range(len(motions))), strict=True)
    return Headings(wrapped(angles), np.array(sigmas), float(min(margins)))


def shared_heading(likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> Headings:
    """Estimate one heading for all sensors.

    Args:
        likelihood, motions, R_pose: as in `own_headings`.
    """
    score, everyone = _Turned(likelihood, motions, R_pose).total, np.ones(len(motions))
    sigma, margin = _spread(score)
    best = float(_grid(_GRID)[int(np.argmax([score(h) for h in _grid(_GRID)]))])
    for step in _REFINEMENTS:
        best = _refined(score, best, step)
    return Headings(wrapped(best * everyone), sigma * everyone, margin)


def wrapped(angles: ArrayLike) -> Array:
    """Return angles in (-pi, pi].

    Args:
        angles: rad, any shape.
    """
    return np.asarray(np.pi - (np.pi - np.asarray(angles, dtype=float)) % (2 * np.pi))


def _grid(count: int) -> Array:
    return np.asarray(2 * np.pi / count * np.arange(count), dtype=np.float64)


def _refined(score: Score, angle: float, step: float) -> float:
    """Return the best angle within two steps."""
    around = angle + step * np.arange(-2, 3)
    return float(around[int(np.argmax([score(float(h)) for h in around]))])


def _spread(score: Score) -> tuple[float, float]:
    """Return the circular standard deviation of exp(score) and the margin over distant headings."""
    angles = _grid(2 * _GRID)
    values = np.array([score(h) for h in angles])
    best = int(np.argmax(values))
    weights = np.exp(_BELIEF * (values - values[best]))
    length = np.abs(np.sum(weights * np.exp(1j * angles))) / weights.sum()
    far = np.abs(wrapped(angles - angles[best])) > np.radians(45.0)
    sigma = np.sqrt(-2 * np.log(np.clip(length, 0.2, 1.0)) + (np.pi / len(angles)) ** 2)
    return float(sigma), float(values[best] - values[far].max())


class _Turned:
    """Motions under other headings, and their log-likelihood."""

    def __init__(self, likelihood: MotionLikelihood, motions: Sequence[SegmentMotion], R_pose: Array) -> None:
        self._likelihood, self._motions, self._R_pose = likelihood, list(motions), R_pose
        joints = [motion.joint for motion in motions]
        self._pairs = [(joints.index(a), joints.index(b)) for a, b in likelihood.tree(joints)]

    def _motion(self, s: int, angle: float) -> SegmentMotion:
        turn, own, R = so3.about_axis("z", angle), self._motions[s], self._R_pose[s]
        return own.turned(turn).moved(own.joint, R.T @ turn.T @ R, own.p_bone_sensor)

    def total(self, angle: float) -> float:
        """Return the log-likelihood of one heading for all sensors."""
        motions = [self._motion(s, angle) for s in range(len(self._motions))]
        out = sum(self._likelihood.pair(motions[a], motions[b]) for a, b in self._pairs)
        return float(out + sum(self._likelihood.single(motion) for motion in motions))

    def along(self, angles: Array, s: int) -> Score:
        """Return the terms of sensor s as a function of its heading, the others fixed."""
        near = [pair for pair in self._pairs if s in pair]
        others = {i: self._motion(i, float(angles[i])) for pair in near for i in pair}

        def score(angle: float) -> float:
            own = {**others, s: self._motion(s, angle)}
            pairs = sum(self._likelihood.pair(own[a], own[b]) for a, b in near)
            return self._likelihood.single(own[s]) + pairs

        return score

    def best_on_grid(self) -> Array:
        """Return the best set of headings (S,) on the grid, by messages up the tree."""
        grid, S, pair = _grid(_GRID), len(self._motions), self._likelihood.pair
        motions = [[self._motion(s, float(h)) for h in grid] for s in range(S)]
        belief = np.array([[self._likelihood.single(motion) for motion in own] for own in motions])
        tables = {(a, b): np.array([[pair(x, y) for y in motions[b]] for x in motions[a]]) for a, b in self._pairs}
        tables |= {(b, a): table.T for (a, b), table in tables.items()}
        graph = np.zeros((S, S))
        for edge in tables:
            graph[edge] = 1.0
        nodes, parents = breadth_first_order(graph, 0)
        choices = {}
        for child in nodes[:0:-1]:
            message = tables[int(parents[child]), int(child)] + belief[child]
            choices[child] = message.argmax(axis=1)
            belief[parents[child]] += message.max(axis=1)
        best = np.zeros(S, dtype=np.intp)
        best[0] = int(belief[0].argmax())
        for child in nodes[1:]:
            best[child] = choices[child][best[parents[child]]]
        return np.asarray(grid[best])
