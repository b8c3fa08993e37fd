"""Soles of the feet: heel and ball, under the joint of the toes and as low as the heel, and the floor under them."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array

FEET: Final = ("LeftFoot", "RightFoot")
SLOW: Final = 0.3  #: [m/s] Largest speed of a point of the sole that tells how high the floor is


def sole_offsets(skeleton: SkeletonModel) -> Array:
    """Return heel and ball (2, 2, 3) of both `FEET` in their frames, m; `UnknownNameError` without such feet."""
    skeleton.index(*FEET)
    ends = [[skeleton.landmarks[f"{foot[:-4]}{end}"][1] for end in ("Heel", "ToeBase")] for foot in FEET]
    return np.array([[heel, [*ball[:2], heel[2]]] for heel, ball in ends])


def sole_points(skeleton: SkeletonModel, p: Array, R: Array, radius: float = 0.0) -> Array:
    """Return heel and ball of both feet (T, 2, 2, 3) in world, m, or the lowest points of spheres of a radius, m, that
    touch the sole there; p, R: (T, J, 3), m, and (T, J, 3, 3) R_world_bone.
    """
    offsets, up, feet = sole_offsets(skeleton), np.array([0.0, 0.0, radius]), skeleton.index(*FEET)
    return np.asarray(p[:, feet, None] + np.einsum("tfij,fkj->tfki", R[:, feet], offsets + up) - up)


def floor_levels(motion: MotionSource, radius: float = 0.0) -> tuple[float, float]:
    """Return the floor's height, m: the median of the lowest of `sole_points` while it is slow; and the height of the
    lowest of all, which is both where nothing is slow. NaN where no pose is known.
    """
    slow, lowest = [], np.nan
    for block in motion.blocks(margin=1):
        poses, own = block.motion.poses, block.own
        points = sole_points(motion.skeleton, poses.p_world_joint, poses.R_world_bone, radius).reshape(-1, 4, 3)
        rates = np.asarray(np.gradient(points, poses.times, axis=0)) if len(poses) > 1 else np.zeros_like(points)
        at = np.arange(len(poses)), np.argmin(points[..., 2], axis=1)
        height, speed = points[at][own, 2], np.linalg.norm(rates[at][own], axis=-1)
        lowest = float(np.fmin.reduce(height, initial=lowest))
        slow.append(height[speed < SLOW])
    known = np.concatenate(slow)
    return (float(np.median(known)) if len(known) else lowest), lowest
