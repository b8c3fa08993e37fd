"""Calibration poses as orientations of all segments of a person who faces x."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_rotations, readonly
from rtof_kin.core.errors import InvalidInputError, UnknownNameError

POSES: Final[Mapping[str, str]] = {
    "T": "standing upright, feet and palms as in the skeleton's table: arms sideways, palms down",
    "N": "standing upright, arms hanging, palms towards the thighs",
    "seated": "sitting upright, hips and knees at right angles, feet flat, arms hanging",
}
_RIGHT_ANGLES = ("hip flexion", "knee flexion")  # of the seated pose


def pose_rotations(pose: str | ArrayLike, skeleton: SkeletonModel) -> Array:
    """Return R_world_bone (J, 3, 3) of a calibration pose.

    Args:
        pose: one of `POSES`, or measured orientations (J, 3, 3), e.g. ``poses.R_world_bone[frame]``.

    Raises:
        UnknownNameError: unknown pose. InvalidInputError: not (J, 3, 3), or not rotations.
    """
    if not isinstance(pose, str):
        R = readonly("calibration pose", pose, (len(skeleton.names), 3, 3))
        if np.isnan(R).any():
            bad = skeleton.names[int(np.argwhere(np.isnan(R))[0][0])]
            raise InvalidInputError(f"calibration pose: {bad} is missing; give a complete frame")
        checked_rotations("calibration pose", R)
        return np.asarray(R)
    if pose not in POSES:
        raise UnknownNameError("calibration pose", [pose], list(POSES))
    q = skeleton.t_pose() if pose == "T" else skeleton.n_pose()
    for joint in skeleton.table.joints if pose == "seated" else ():
        for dof in joint.dofs:
            if dof.clinical.endswith(_RIGHT_ANGLES):
                sign = -1.0 if dof.clinical.startswith("-") else 1.0
                q[7 + skeleton.dof_names.index(dof.urdf)] = sign * np.pi / 2
    return np.asarray(skeleton.forward_kinematics(q[None])[1][0])


def facing_of(R_world_bone: Array) -> float:
    """Return the heading of the root's forward axis, rad about z from x.

    Args:
        R_world_bone: (J, 3, 3) of a pose.

    Raises:
        InvalidInputError: the axis is vertical.
    """
    forward = R_world_bone[0, :, 0]
    if np.hypot(forward[0], forward[1]) < np.sin(np.radians(10.0)):
        raise InvalidInputError("calibration pose: the root's forward axis is vertical")
    return float(np.arctan2(forward[1], forward[0]))


def turned_to(R_world_bone: Array, facing: float) -> Array:
    """Return a pose with another heading.

    Args:
        R_world_bone: (J, 3, 3). facing: new heading, rad about z from x.
    """
    turn = so3.about_axis("z", facing - facing_of(R_world_bone))
    return np.asarray(turn @ R_world_bone)
