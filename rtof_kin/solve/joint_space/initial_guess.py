"""Initial guess of a recording: poses with the root on its rays and with unobserved intervals bridged.

A fragment without any landmark has no information about the position and speed of the root except its
initial guess. So segments turn as their sensors measure (`inertial.initial_poses`), the root follows
standing feet and accelerations (`inertial.root_path`), and the differences from the observed poses at the
two ends of an interval are distributed over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.initial_poses import refit_root as refitted
from rtof_kin.inertial.root_path import path_through_gaps


@dataclass(frozen=True)
class InitialGuess:
    """Poses that the fragment solver and the self-calibration start from."""

    poses: PoseSequence
    """(T, J) rigid poses, the root refitted to its rays, unobserved intervals bridged by the sensors."""
    sigma_root: Array
    """(T,) m, standard deviation of the root in bridged frames; 0 where the person was observed."""


def initial_guess(
    start: PoseSequence,
    keypoints: KeypointSequence | None,
    bone_imus: BoneImuSequence | None,
    skeleton: SkeletonModel,
    *,
    refit_root: bool = True,
    views: Sequence[KeypointSequence] = (),
) -> InitialGuess:
    """Return the initial guess for poses of a recording.

    Args:
        start: (T, J) rigid, evenly spaced poses, usually those after SF2.
        keypoints: at the times of `start`. None, without a camera, leaves the poses unchanged.
        bone_imus: any subset of the sensors, at any times; those on shanks and feet determine the root.
        refit_root: whether the root is moved onto the rays of its landmarks.
    """
    sigma = np.zeros(len(start))
    if keypoints is None:
        return InitialGuess(start, sigma)
    if refit_root:
        start = refitted(start, keypoints, views)
    seen = np.any([k.select(skeleton.names).seen.any(axis=1) for k in (keypoints, *views)], axis=0)
    silent = bone_imus is None or not np.isfinite(bone_imus.R_world_bone).any()
    if bone_imus is None or silent or seen.all() or not seen.any():
        return InitialGuess(start, sigma)
    bone_imus = bone_imus.resample(start.times)
    sensed = poses_from_sensors(skeleton, bone_imus).R_world_bone
    start = _posed(start, ~seen, skeleton, start.p_world_joint[:, 0], _turned(start, seen, sensed))
    path = path_through_gaps(start, seen, bone_imus, skeleton)
    if path is None:
        return InitialGuess(start, sigma)
    return InitialGuess(_posed(start, ~seen, skeleton, path.p_world, start.R_world_bone), path.sigma)


def _turned(start: PoseSequence, seen: Mask, sensed: Array) -> Array:
    """Measured orientations (T, J, 3, 3) with their offset at both ends of a gap interpolated over it."""
    offset = np.swapaxes(sensed, -1, -2) @ start.R_world_bone
    offset[~seen] = np.nan
    at = np.clip(start.times, *start.times[seen][[0, -1]])
    return np.asarray(sensed @ signals.interpolate_rotations(start.times, offset, at))


def _posed(start: PoseSequence, frames: Mask, skeleton: SkeletonModel, root: Array, R: Array) -> PoseSequence:
    """Poses with other roots (T, 3) and orientations (T, J, 3, 3) in the frames chosen."""
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, root, R)
    p = np.where(frames[:, None, None], p, start.p_world_joint)
    R = np.where(frames[:, None, None, None], R, start.R_world_bone)
    return replace(start, p_world_joint=p, R_world_bone=R)
