"""Soles of the feet: heel and ball, under the joint of the toes and as low as the heel, and the floor under them."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of

SIDES: Final = ("Left", "Right")
SLOW: Final = 0.3  #: [m/s] Largest speed of a point of the sole that tells how high the floor is


def sole_offsets(skeleton: SkeletonModel) -> Array:
    """Return heel and ball (2, 2, 3) of the left and right foot in its frame, m; `UnknownNameError`: it has none."""
    names, known = [[f"{side}Heel", f"{side}ToeBase"] for side in SIDES], list(skeleton.landmarks)
    ends = [[skeleton.landmarks[known[i]][1] for i in indices_of("landmark", pair, known)] for pair in names]
    return np.array([[heel, [*ball[:2], heel[2]]] for heel, ball in ends])


def sole_points(skeleton: SkeletonModel, p: Array, R: Array, radius: float = 0.0) -> Array:
    """Return heel and ball of both feet (T, 2, 2, 3) in world, m, or the lowest points of spheres that touch the sole
    there; p, R: (T, J, 3), m, and (T, J, 3, 3) R_world_bone. radius: of the spheres, m.
    """
    feet, up = skeleton.index(*(f"{side}Foot" for side in SIDES)), np.array([0.0, 0.0, radius])
    turned = np.einsum("tfij,fkj->tfki", R[:, feet], sole_offsets(skeleton) + up)
    return np.asarray(p[:, feet, None] + turned - up)


def floor_levels(motion: MotionSource, radius: float = 0.0) -> tuple[float, float]:
    """Return the floor's height, m: the median of the lowest of `sole_points` while it is slow; and the height of the
    lowest of all, which is both where nothing is slow. NaN where no pose is known.
    """
    slow, lowest = [], np.nan
    for block in motion.blocks(margin=1):
        poses, own = block.motion.poses, block.own
        points = sole_points(motion.skeleton, poses.p_world_joint, poses.R_world_bone, radius)
        points = points.reshape(len(poses), 4, 3)
        height, at = points[..., 2].min(axis=1), np.argmin(points[..., 2], axis=1)
        lowest = float(np.fmin.reduce(height[own], initial=lowest))
        if len(poses) > 1:
            speed = np.linalg.norm(np.gradient(points, poses.times, axis=0), axis=-1)[np.arange(len(poses)), at]
            slow.append(height[own][speed[own] < SLOW])
    known = np.concatenate(slow) if slow else np.empty(0)
    return (float(np.median(known)) if len(known) else lowest), lowest
