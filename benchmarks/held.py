"""Motion that begins with a calibration pose, as people record it."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.pose_calibration import pose_rotations, turned_to

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


EXERCISES = (
    ("LeftLeg", {"LeftLeg": 1.3, "LeftUpLeg": 0.5}),
    ("RightLeg", {"RightLeg": 1.3, "RightUpLeg": 0.5}),
    ("LeftForeArm", {"LeftForeArm": 1.8, "LeftArm": 0.5}),
    ("RightForeArm", {"RightForeArm": 1.8, "RightArm": 0.5}),
    ("Spine3", {"Spine": 0.3, "Spine1": 0.3, "Hips": 0.4}),
)
"""The joint a movement is named by, and how far segments flex in it, rad."""


def exercise(skeleton: SkeletonModel, rng: Generator, seconds: float) -> PoseSequence:
    """A person who stands for two seconds, and then flexes one joint after another.

    Each movement takes `seconds` and is done three times, not quite about one axis: other axes move too,
    and other joints a little.
    """
    rate, J = 60.0, len(skeleton.names)
    R_pose = pose_rotations("N", skeleton)
    axes = {name: R_pose[j].T @ _flexion_axis(j, skeleton, R_pose) for j, name in enumerate(skeleton.names)}
    count, still = round(seconds * rate), round(HELD * rate)
    T = still + count * len(EXERCISES)
    rotvec = np.zeros((T, J, 3))
    phase = np.arange(count) / count
    for i, (_, flexed) in enumerate(EXERCISES):
        own = slice(still + i * count, still + (i + 1) * count)
        for joint, angle in flexed.items():
            j = skeleton.names.index(joint)
            slow = np.sin(np.pi * phase) ** 0.5
            rotvec[own, j] += (angle * slow * np.sin(3 * np.pi * phase) ** 2)[:, None] * axes[joint]
            rotvec[own, j] += (
                0.05 * slow[:, None] * np.sin(2 * np.pi * (np.outer(phase, rng.uniform(2, 5, 3)) + rng.uniform(size=3)))
            )
    rotvec += 0.01 * np.sin(np.arange(T)[:, None, None] / rate * rng.uniform(1, 3, (J, 3)))
    local = kinematics.local_rotations(skeleton.parents, R_pose) @ so3.exp(rotvec)
    R = kinematics.world_rotations(skeleton.parents, local)
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.tile([0.0, 0, 0.95], (T, 1)), R)
    return PoseSequence(np.arange(T) / rate, p, R, skeleton.names)


def _flexion_axis(j: int, skeleton: SkeletonModel, R_pose: Array) -> Array:
    """Axis (3,) in world about which a segment flexes; an upper arm is raised forwards, the root bows."""
    own = skeleton.table.joints[j]
    for axis, dof in zip(own.axes, own.dofs, strict=True):
        if dof.clinical.endswith("flexion"):
            sign = -1.0 if dof.clinical.startswith("-") else 1.0
            return np.asarray(sign * R_pose[j][:, "xyz".index(axis)])
    left = R_pose[0, :, 1]
    return np.asarray(left if j == 0 else -left)
