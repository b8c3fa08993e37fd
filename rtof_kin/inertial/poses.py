"""Poses that people hold to calibrate sensors, as orientations of the segments of somebody facing x."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import checked_rotations, readonly
from rtof_kin.core.errors import ShapeError, UnknownNameError

Array = NDArray[np.float64]
POSES: Mapping[str, str] = {
    "T": "standing upright, feet and palms as in the skeleton's table: arms sideways, palms down",
    "N": "standing upright, arms hanging, palms towards the thighs",
    "seated": "sitting upright, hips and knees at right angles, feet flat, arms hanging",
}
"""Named poses, and how they are held."""
_SEATED_DEG = {"hip flexion": 90.0, "knee flexion": 90.0}


def pose_rotations(pose: str | ArrayLike, skeleton: SkeletonModel) -> Array:
    """R_world_bone (J, 3, 3) of a calibration pose, of all segments.

    Args:
        pose: one of `POSES`, which face world x; or measured orientations (J, 3, 3) in world, of the
            skeleton's joints in their order, e.g. ``poses.R_world_bone[frame]``.
        skeleton: whose segments.

    Raises:
        UnknownNameError: there is no such pose. ShapeError: not (J, 3, 3), or not rotations.
    """
    if not isinstance(pose, str):
        R = readonly("calibration pose", pose, (len(skeleton.names), 3, 3))
        if np.isnan(R).any():
            bad = skeleton.names[int(np.argwhere(np.isnan(R))[0][0])]
            raise ShapeError(f"calibration pose: {bad} is not known; give a frame in which all are")
        checked_rotations("calibration pose", R)
        return np.asarray(R)
    if pose not in POSES:
        raise UnknownNameError("calibration pose", [pose], list(POSES))
    q = skeleton.t_pose() if pose == "T" else skeleton.n_pose()
    if pose == "seated":
        for joint in skeleton.table.joints:
            for dof in joint.dofs:
                sign = -1.0 if dof.clinical.startswith("-") else 1.0
                for movement, angle in _SEATED_DEG.items():
                    if dof.clinical.endswith(movement):
                        q[7 + skeleton.dof_names.index(dof.urdf)] = sign * np.radians(angle)
    return np.asarray(skeleton.forward_kinematics(q[None])[1][0])


def facing_of(R_world_bone: Array) -> float:
    """Heading, rad about z from x, in which a pose (J, 3, 3) faces: of the root's forward axis.

    Raises:
        ShapeError: the root's forward axis is vertical, so it has no heading.
    """
    forward = R_world_bone[0, :, 0]
    if np.hypot(forward[0], forward[1]) < np.sin(np.radians(10.0)):
        raise ShapeError("calibration pose: the root's forward axis is vertical, so it faces nowhere")
    return float(np.arctan2(forward[1], forward[0]))


def turned_to(R_world_bone: Array, facing: float) -> Array:
    """The same pose (J, 3, 3), facing a given heading, rad about z from x."""
    turn = so3.about_axis("z", facing - facing_of(R_world_bone))
    return np.asarray(turn @ R_world_bone)
