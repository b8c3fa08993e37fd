"""Residuals between the exported motion and the keypoints and sensor data."""

from __future__ import annotations

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.reconstruction import quality
from rtof_kin.reconstruction.result import Reconstruction


def reprojection_errors(result: Reconstruction) -> Array:
    """Return reprojection errors (T, L) of the landmarks, px; NaN where unknown.

    Raises:
        InvalidInputError: there are no keypoints.
    """
    keypoints = result.keypoints or result.recording.video
    return quality.reprojection_errors(keypoints, result.motion.skeleton, result.motion.poses)


def orientation_residuals(result: Reconstruction) -> tuple[Array, Array]:
    """Return orientation residuals (T, S) rad across the bone and about it, NaN where unknown.

    The residual of a segment with several children or none is all across.
    """
    skeleton, imus = result.motion.skeleton, result.bone_imus
    assert imus is not None
    index = skeleton.index(*imus.joints)
    R = result.motion.poses.R_world_bone[:, index]
    known = np.isfinite(R).all(axis=(2, 3)) & np.isfinite(imus.R_world_bone).all(axis=(2, 3))
    off = np.full((*known.shape, 3), np.nan)
    off[known] = so3.log(np.swapaxes(R[known], -1, -2) @ imus.R_world_bone[known])
    about = np.zeros(known.shape)
    for s, j in enumerate(index):
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) == 1:
            bone = so3.unit(skeleton.joint_offsets[children[0]])
            about[:, s] = off[:, s] @ bone
            off[:, s] -= about[:, s, None] * bone
    return np.linalg.norm(off, axis=-1), np.where(known, np.abs(about), np.nan)


def acceleration_residuals(result: Reconstruction) -> Array:
    """Return residuals (T, S) m/s^2 between sensors and the second difference of the motion at their lever
    arms; NaN at the ends and where unknown.
    """
    imus, poses = result.bone_imus, result.motion.poses
    assert imus is not None
    index = result.motion.skeleton.index(*imus.joints)
    lever = np.einsum("tsij,sj->tsi", poses.R_world_bone[:, index], imus.p_bone_sensor)
    out = np.full(imus.a_world.shape[:2], np.nan)
    if len(poses) < 3:
        return out
    a = np.diff(poses.p_world_joint[:, index] + lever, n=2, axis=0) * poses.rate_hz**2
    out[1:-1] = np.linalg.norm(a - imus.a_world[1:-1], axis=-1)
    return out
