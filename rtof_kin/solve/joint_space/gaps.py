"""Where nobody was seen: a start by the sensors, between what the camera saw before and after.

A fragment of frames in which nobody was in the picture knows nothing of the root's place and speed but
where it starts. So the start must be right: segments turn as sensors have it (`inertial.initial_poses`), the root
goes where standing feet and accelerations carry it (`inertial.root_path`), and what both differ by from the poses
seen at the two ends is spread over the gap.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.root_path import path_through_gaps

Array = NDArray[np.float64]


def through_gaps(
    start: PoseSequence, seen: NDArray[np.bool_], bone_imus: BoneImuSequence, skeleton: SkeletonModel
) -> tuple[PoseSequence, Array]:
    """A start that moves on where nobody was seen.

    Args:
        start: (T, J) rigid, evenly spaced. seen: (T,) whether anything of the person was.
        bone_imus: the sensors; those on shanks or feet tell of the root.

    Returns:
        The start, with other poses where it was not seen; and how far the root may be off there: (T,) m,
        0 where it was seen or no sensor tells.
    """
    unknown = np.zeros(len(start))
    if seen.all() or not seen.any() or not np.isfinite(bone_imus.R_world_bone).any():
        return start, unknown
    bone_imus = bone_imus.resample(start.times)
    sensed = poses_from_sensors(skeleton, bone_imus).R_world_bone
    start = _posed(start, ~seen, skeleton, start.p_world_joint[:, 0], _turned(start, seen, sensed))
    path = path_through_gaps(start, seen, bone_imus, skeleton)
    if path is None:
        return start, unknown
    return _posed(start, ~seen, skeleton, path.p_world, start.R_world_bone), path.sigma


def _turned(start: PoseSequence, seen: NDArray[np.bool_], sensed: Array) -> Array:
    """(T, J, 3, 3) of the sensors' poses, each segment turned against that as it is seen to be at both
    ends of a gap, on the geodesic between.
    """
    off = np.swapaxes(sensed, -1, -2) @ start.R_world_bone
    off[~seen] = np.nan
    at = np.clip(start.times, *start.times[seen][[0, -1]])
    return np.asarray(sensed @ signals.interpolate_rotations(start.times, off, at))


def _posed(
    start: PoseSequence, frames: NDArray[np.bool_], skeleton: SkeletonModel, root: Array, R: Array
) -> PoseSequence:
    """The start with other roots (T, 3) and orientations (T, J, 3, 3) in some frames."""
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, root, R)
    p = np.where(frames[:, None, None], p, start.p_world_joint)
    return replace(
        start, p_world_joint=p, R_world_bone=np.where(frames[:, None, None, None], R, start.R_world_bone)
    )
