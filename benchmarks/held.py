"""Motion that begins with a calibration pose, as people record it."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.inertial.poses import turned_to
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import PoseSequence

Array = NDArray[np.float64]
HELD, MOVING = 2.0, 1.5


def held_then_moving(poses: PoseSequence, R_pose: Array, skeleton: SkeletonModel) -> PoseSequence:
    """Two seconds of a pose, facing where the motion begins, 1.5 s on the way to it, then the motion.

    Args:
        poses: the motion. R_pose: (J, 3, 3) R_world_bone of the pose. skeleton: of the motion's offsets.
    """
    rate, parents = poses.rate_hz, skeleton.parents
    forward = poses.R_world_bone[0, 0, :, 0]
    R_pose = turned_to(R_pose, float(np.arctan2(forward[1], forward[0])))
    held, first = (kinematics.local_rotations(parents, R) for R in (R_pose, poses.R_world_bone[0]))
    s = np.clip((np.arange(round((HELD + MOVING) * rate)) / rate - HELD) / MOVING, 0, 1)
    share = s**3 * (10 - 15 * s + 6 * s**2)  # minimum jerk
    step = so3.log(np.swapaxes(held, -1, -2) @ first)
    R = kinematics.world_rotations(parents, held @ so3.exp(share[:, None, None] * step))
    R = np.concatenate([R, poses.R_world_bone])
    p_root = np.concatenate([np.tile(poses.p_world_joint[0, 0], (len(s), 1)), poses.p_world_joint[:, 0]])
    p = kinematics.positions(parents, skeleton.joint_offsets, p_root, R)
    return PoseSequence(np.arange(len(R)) / rate, p, R, poses.names)


def held_wrongly(rng: Generator, R_pose: Array, skeleton: SkeletonModel, degrees: float) -> Array:
    """A pose (J, 3, 3) as a person holds it: every segment but the root off by some degrees in the mean,
    neighbours alike.

    Every joint but those of hands and feet is turned by a normal vector; the root is tilted less.
    """
    parents, names = skeleton.parents, skeleton.names
    local = kinematics.local_rotations(parents, R_pose)
    off = rng.standard_normal((len(names), 3))
    off[0] *= np.array([0.5, 0.5, 0.0])
    spine = [i for i, name in enumerate(names) if name.startswith(("Spine", "Neck"))]
    off[spine] /= 2  # several in a row
    R = kinematics.world_rotations(parents, local @ so3.exp(off))
    mean = np.mean(so3.angle_between(R[1:], R_pose[1:]))
    # The angle grows in proportion for the small turns that are meant; two rounds bring it there.
    scale = np.radians(degrees) / mean
    for _ in range(8):
        R = kinematics.world_rotations(parents, local @ so3.exp(scale * off))
        scale *= np.radians(degrees) / np.mean(so3.angle_between(R[1:], R_pose[1:]))
    return np.asarray(R)
