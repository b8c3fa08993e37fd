"""Soles of the feet: heel and ball of each foot, and the height of the floor under them.

The ball is under the joint of the toes, at the height of the heel while the foot is flat.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array

FEET: Final = ("LeftFoot", "RightFoot")
SLOW: Final = 0.3  #: [m/s] Largest speed of a point of the sole that tells how high the floor is


def sole_offsets(skeleton: SkeletonModel) -> Array:
    """Return heel and ball (2, 2, 3) of both `FEET` in the frame of the foot, m; `UnknownNameError` without feet."""
    skeleton.index(*FEET)
    out = np.empty((2, 2, 3))
    for foot, side in enumerate(("Left", "Right")):
        heel, ball = (skeleton.landmarks[f"{side}{point}"][1] for point in ("Heel", "ToeBase"))
        out[foot] = heel, [ball[0], ball[1], heel[2]]
    return out


def sole_points(skeleton: SkeletonModel, p: Array, R: Array) -> Array:
    """Return heel and ball of both feet (T, 2, 2, 3) in world, m; p, R: (T, J, 3), m, and (T, J, 3, 3) R_world_bone."""
    feet = skeleton.index(*FEET)
    turned = np.einsum("tfij,fkj->tfki", R[:, feet], sole_offsets(skeleton))
    return np.asarray(p[:, feet, None] + turned)


def floor_levels(motion: MotionSource) -> tuple[float, float]:
    """Return the floor's height, m: the median of the lowest of the soles' points while it is slow; and the height of
    the lowest point of all. The first is the second where nothing is slow; NaN where no pose is known.
    """
    slow, lowest = [], np.nan
    for block in motion.blocks(margin=1):
        poses = block.motion.poses
        points = sole_points(motion.skeleton, poses.p_world_joint, poses.R_world_bone).reshape(len(poses), 4, 3)
        height = points[..., 2].min(axis=1)
        lowest = float(np.fmin(lowest, np.fmin.reduce(height[block.own], initial=np.nan)))
        if len(poses) < 2:
            continue
        speed = np.linalg.norm(np.gradient(points, poses.times, axis=0), axis=-1)
        rests = speed[np.arange(len(poses)), np.argmin(points[..., 2], axis=1)] < SLOW  # NaN is not
        slow.append(height[block.own][rests[block.own]])
    known = np.concatenate(slow) if slow else np.empty(0)
    return (float(np.median(known)) if len(known) else lowest), lowest
