"""Pose that the online estimator begins with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import poses_from_sensors, refit_root
from rtof_kin.inertial.root_path import FEET
from rtof_kin.live.estimation.sensor_buffer import SensorBuffer

if TYPE_CHECKING:
    from lifting.streaming import StreamedPose


def first_lifted(
    skeleton: SkeletonModel, pose: StreamedPose, sensed: Mapping[str, Array], keypoints: KeypointSequence
) -> PoseSequence:
    """Return a lifted pose with measured orientations, its root on the rays of its landmarks.

    Args:
        skeleton: the subject's. sensed: orientations (3, 3) in world by joint.
    """
    parents, offsets = skeleton.parents, skeleton.joint_offsets
    p = pose.p_world_joint[None]
    R = kinematics.rotations_from_positions(parents, offsets, p)
    R = np.where(np.isfinite(pose.R_world_bone), pose.R_world_bone, R)
    for joint, own in sensed.items():
        R[0, skeleton.names.index(joint)] = own
    p = kinematics.positions(parents, offsets, p[:, 0], R)
    return refit_root(PoseSequence(keypoints.times, p, R, skeleton.names), keypoints)


def first_sensed(
    skeleton: SkeletonModel, sensors: SensorBuffer, time: float, ankle_height: float
) -> PoseSequence | None:
    """Return the pose that sensors show, above the origin with the lower ankle at a height.

    Args:
        skeleton: the subject's. time: s. ankle_height: in world, m.

    Returns:
        One frame; None where no sensor has data.
    """
    q, known, a, _ = sensors.at(np.array([time]))
    if not known.any():
        return None
    R = np.where(known[..., None, None], so3.from_quat_wxyz(q), np.nan)
    measured = BoneImuSequence(np.array([time]), R, a, sensors.levers, sensors.joints)
    poses = poses_from_sensors(skeleton, measured)
    lowest = float(poses.p_world_joint[0, skeleton.index(*FEET), 2].min())
    return poses.with_poses(
        slice(None), poses.p_world_joint + np.array([0.0, 0.0, ankle_height - lowest]), poses.R_world_bone
    )
