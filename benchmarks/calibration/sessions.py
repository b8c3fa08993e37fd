"""Longer recordings than the corpus has: motions of one person, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.mocap_families import PARENTS

BETWEEN = 1.5
"""[s] from the end of a motion to the beginning of the next; its path is a cubic."""


def joined(clips: Sequence[MocapClip], seconds: float, name: str) -> MocapClip:
    """Motions of one person at one rate, where and as they were captured, until there are enough.

    From one to the next the person glides in `BETWEEN` seconds, without a jump in speed.
    """
    rate, first = clips[0].poses.rate_hz, clips[0]
    root, R = first.poses.p_world_joint[:, 0], first.poses.R_world_bone
    wanted = round(seconds * rate)
    for clip in clips[1:]:
        if len(root) >= wanted:
            break
        other = clip.poses
        root = _continued(root, other.p_world_joint[:, 0], rate)
        R = _continued(R, other.R_world_bone, rate)
    R, root = so3.nearest_rotation(R[:wanted]), root[:wanted]
    p = kinematics.positions(PARENTS, first.joint_offsets, root, R)
    poses = PoseSequence(np.arange(len(root)) / rate, p, R, first.poses.names)
    return replace(first, name=name, poses=poses)


def _continued(before: Array, after: Array, rate_hz: float) -> Array:
    """Two stretches of a signal with a cubic between that keeps value and slope at both ends."""
    count = round(BETWEEN * rate_hz)
    slopes = [(before[-1] - before[-2]) * rate_hz, (after[1] - after[0]) * rate_hz]
    path = CubicHermiteSpline([0.0, BETWEEN], [before[-1], after[0]], slopes)
    return np.concatenate([before, path(np.arange(1, count) / rate_hz), after])
