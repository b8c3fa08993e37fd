"""Which points of a body are hidden by its own trunk and legs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.rotations import unit

_TRUNK = ("Hips", "Neck", 0.11, 0.12)
"""Joints at the ends of a capsule; its radius and the depth behind its axis that hides points, m."""
_LEG_RADIUS, _LEG_MARGIN = 0.06, 0.08
_SPHERES = 6
"""Spheres that make a capsule."""


def self_occluded(p_camera_joint: Array, p_camera_point: Array, limb: Index, skeleton: SkeletonModel) -> Mask:
    """Return which points (T, K) stand behind the trunk, or behind the other leg if they are of a leg.

    Args:
        p_camera_joint: (T, J, 3) joints in camera axes, m. p_camera_point: (T, K, 3) likewise.
        limb: (K,) 3 for points of the right leg, 4 for those of the left.
    """

    def joint(name: str) -> Array:
        return p_camera_joint[:, skeleton.index(name)[0]]

    hips, neck, radius, margin = _TRUNK
    hidden = _behind(p_camera_point, joint(hips), joint(neck), radius, margin)
    for own, other in ((3, "Left"), (4, "Right")):
        points = np.flatnonzero(limb == own)
        leg = [joint(f"{other}{name}") for name in ("UpLeg", "Leg", "Foot")]
        for start, stop in pairwise(leg):
            hidden[:, points] |= _behind(p_camera_point[:, points], start, stop, _LEG_RADIUS, _LEG_MARGIN)
    return hidden


def _behind(points: Array, start: Array, stop: Array, radius: float, margin: float) -> Mask:
    """Return which points (T, K) a capsule from `start` to `stop` (T, 3) hides."""
    share = np.linspace(0, 1, _SPHERES)[:, None]
    centre = start[:, None] + share * (stop - start)[:, None]
    along = unit(points) @ np.swapaxes(centre, -1, -2)  # of the foot of the perpendicular from the centre
    off = np.sum(centre**2, axis=-1)[:, None] - along**2
    near = (off < radius**2) & (along < np.linalg.norm(points, axis=-1, keepdims=True) - margin)
    return np.asarray(near.any(axis=-1))
