"""Mapping of a motion from a source skeleton to the package's.

* A segment's orientation is its source's rotation from the T-pose, in axes x forward, y left, z up:
  ``R_world_bone(t) = R_world_source(t) R_world_source(T-pose)^T``. Where the file's rest pose spreads legs
  or lowers arms, a constant minimal rotation first brings thighs and shanks to -z, arms to +-y.
* Joint offsets are those of the T-pose, and constant: positions are forward kinematics. A segment with one
  child is then turned, by the smallest rotation or a share of it, towards the source's child.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.simulation.mocap_families import NAMES, PARENTS, Between, Family, restored_offsets

_R_WORLD_FILE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Files are y up and face z in their rest pose; world is z up, and the T-pose faces x."""
_DOWN, _LEFT = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
_CANONICAL = {
    "RightUpLeg": _DOWN,
    "RightLeg": _DOWN,
    "LeftUpLeg": _DOWN,
    "LeftLeg": _DOWN,
    "RightArm": -_LEFT,
    "RightForeArm": -_LEFT,
    "LeftArm": _LEFT,
    "LeftForeArm": _LEFT,
}
"""Direction of a segment's child in its link frame."""


@dataclass(frozen=True)
class MocapClip:
    """Motion of the package's skeleton, with rigid bones."""

    name: str
    """File name without its ending, with the range of source frames if it is a piece."""
    poses: PoseSequence
    """Positions and orientations in world (z up, m), joints named `NAMES`; from time 0."""
    joint_offsets: Array
    """(J, 3) position of each joint in its parent's link frame, m; zero for the root."""
    subject: str = ""
    """Name of the subject in an index."""
    category: str = ""
    """walking, running, acting, freestyle, rom or other, from an index."""
    quality: str = ""
    """Remark of an index; contains GLITCH where the original has spikes."""
    rig: str = ""
    """Family of the source's skeleton, see `mocap_families`."""

    def __post_init__(self) -> None:
        offsets = readonly("clip joint_offsets", self.joint_offsets, (len(self.poses.names), 3))
        object.__setattr__(self, "joint_offsets", offsets)


def map_motion(motion: ArticulatedMotion, family: Family, unit_m: float, rate_hz: float, name: str) -> MocapClip:
    """Map a motion to the package's joints, at the source's rate.

    Args:
        motion: source frames without artificial ones. unit_m: length unit of the source, m.
        rate_hz: its sampling rate, Hz.
    """
    offsets = restored_offsets(motion, family)
    rigid = replace(motion, offsets=offsets, p_parent_joint=None)
    p_source, R_source = rigid.forward_kinematics()
    p_source = p_source @ _R_WORLD_FILE.T * unit_m
    R_source = _R_WORLD_FILE @ R_source @ _R_WORLD_FILE.T
    p_t_pose, R_t_pose = _t_pose(motion, family, offsets @ _R_WORLD_FILE.T * unit_m)
    p_wanted, p_rest = (_points(motion, family.at, p) for p in (p_source, p_t_pose))
    R_turned, R_rest = (_turns(motion, family.turns, R) for R in (R_source, R_t_pose))
    R_canonical = _canonical_rotations(family, p_rest[0])
    joint_offsets = np.zeros((len(NAMES), 3))
    for m, parent in enumerate(PARENTS):
        if parent >= 0:
            joint_offsets[m] = R_canonical[parent] @ (p_rest[0, m] - p_rest[0, parent])
    R_world_bone = R_turned @ np.swapaxes(R_canonical @ R_rest, -1, -2)
    p, R = _aimed(R_world_bone, joint_offsets, p_wanted, family.aim)
    times = np.arange(len(motion)) / rate_hz
    return MocapClip(name, PoseSequence(times, p, R, NAMES), joint_offsets, rig=family.name)


def _t_pose(motion: ArticulatedMotion, family: Family, offsets: Array) -> tuple[Array, Array]:
    """Return source joints (1, J, 3) and frames (1, J, 3, 3) in the T-pose, in world axes."""
    p = np.zeros((1, len(motion.names), 3))
    R = np.tile(np.eye(3), (1, len(motion.names), 1, 1))
    for j, (name, parent) in enumerate(zip(motion.names, motion.parents, strict=True)):
        if parent >= 0:
            p[0, j] = p[0, parent] + R[0, parent] @ offsets[j]
            R[0, j] = R[0, parent]
        if name in family.t_pose_deg:
            # x left, y up, z forward of the file are y, z, x of the world.
            about_y, about_z, about_x = np.deg2rad(family.t_pose_deg[name])
            R[0, j] = so3.euler_to_matrix("xzy", [about_x, about_z, about_y])
    return p, R


def _points(motion: ArticulatedMotion, at: tuple[Between, ...], p: Array) -> Array:
    """Return the package's joints (T, J, 3) from the source's positions."""
    starts = p[:, [motion.index(start) for start, _, _ in at]]
    stops = p[:, [motion.index(stop) for _, stop, _ in at]]
    share = np.array([share for _, _, share in at])[:, None]
    return np.asarray(starts + share * (stops - starts))


def _turns(motion: ArticulatedMotion, turns: tuple[Between, ...], R: Array) -> Array:
    """Return rotations (T, J, 3, 3) of the package's segments from the source's frames."""
    R_segment = R[:, [motion.index(start) for start, _, _ in turns]]
    for m, (_, stop, share) in enumerate(turns):
        if share:
            step = np.swapaxes(R_segment[:, m], -1, -2) @ R[:, motion.index(stop)]
            R_segment[:, m] = R_segment[:, m] @ so3.exp(share * so3.log(step))
    return R_segment


def _canonical_rotations(family: Family, p_rest: Array) -> Array:
    """Return constant rotations (J, 3, 3) that bring the limbs of the T-pose (J, 3) to their axes.

    A hand is turned like its forearm, and a foot like its shank in some families.
    """
    R = np.tile(np.eye(3), (len(NAMES), 1, 1))
    for joint, direction in _CANONICAL.items():
        m = NAMES.index(joint)
        (child,) = kinematics.children_of(PARENTS, m)
        R[m] = so3.minimal_rotation(p_rest[child] - p_rest[m], direction)
        if NAMES[child].endswith("Hand") or (NAMES[child].endswith("Foot") and family.feet_go_with_shanks):
            R[child] = R[m]
    return R


def _aimed(R_world_bone: Array, joint_offsets: Array, p_wanted: Array, aim: tuple[float, ...]) -> tuple[Array, Array]:
    """Return positions and orientations in which segments with one child turn towards its wanted position.

    `aim` has, by joint, the share of the smallest rotation that would point the segment at its child.
    """
    R, p = R_world_bone.copy(), p_wanted.copy()
    for m, parent in enumerate(PARENTS):
        if parent >= 0:
            p[:, m] = p[:, parent] + R[:, parent] @ joint_offsets[m]
        children = kinematics.children_of(PARENTS, m)
        if len(children) == 1:
            bone = R[:, m] @ joint_offsets[children[0]]
            turn = so3.minimal_rotation(bone, p_wanted[:, children[0]] - p[:, m])
            R[:, m] = (turn if aim[m] == 1 else so3.exp(aim[m] * so3.log(turn))) @ R[:, m]
    return p, R


def resample_clip(clip: MocapClip, rate_hz: float) -> MocapClip:
    """Resample a clip; an integer ratio of rates takes every n-th frame.

    Otherwise the rotation of each segment in its parent's frame is interpolated on the geodesic, the root's
    position linearly, and joints follow by forward kinematics.

    Args:
        rate_hz: new sampling rate, Hz.
    """
    poses = clip.poses
    ratio = poses.rate_hz / rate_hz
    if round(ratio) and abs(ratio - round(ratio)) < 1e-6:
        return replace(clip, poses=poses[:: round(ratio)])
    times = np.arange(int(poses.times[-1] * rate_hz * (1 + 1e-12)) + 1) / rate_hz
    local = kinematics.local_rotations(PARENTS, poses.R_world_bone)
    R = kinematics.world_rotations(PARENTS, signals.interpolate_rotations(poses.times, local, times))
    p_root = signals.interpolate(poses.times, poses.p_world_joint[:, 0], times)
    p = kinematics.positions(PARENTS, clip.joint_offsets, p_root, R)
    return replace(clip, poses=PoseSequence(times, p, R, NAMES))
