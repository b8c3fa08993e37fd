"""A confidence for motions that have none, for the tests of long ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtof_kin.body.skeleton import Motion
from rtof_kin.data.confidence import WORLD, Confidence


def with_confidence(motion: Motion, degrees: float = 2.0) -> Motion:
    """The motion with the same standard deviation of every segment, in world and relative to its parent."""
    names, parents = motion.skeleton.names, motion.skeleton.parents
    pairs = [(WORLD, name) for name in names] + [
        (names[parent], name) for name, parent in zip(names, parents, strict=True) if parent >= 0
    ]
    T, J = motion.poses.valid.shape
    turns = np.tile(np.radians(degrees) ** 2 * np.eye(3), (T, len(pairs), 1, 1))
    points = np.tile(1e-4 * np.eye(3), (T, J, 1, 1))
    found = Confidence(motion.times, names, points, points, tuple(pairs), turns)
    return replace(motion, confidence=found)
