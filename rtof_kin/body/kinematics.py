"""Vectorised kinematics of a tree of rigid segments.

The tree is `parents` (J,), with -1 for the root and parents before children, and `offsets` (J, 3) of each
joint in its parent's link frame, m.

Segment frames that all rigs share, from joint centres alone. Link frames of different rigs agree in the T-pose, but not
with the joints: the lumbar joint lies 17 degrees behind the vertical over the hips in CMU's skeletons and 26 in Total
Capture's. What is learned on one rig about the pelvis and the joints around it would be wrong by the difference on the
other. The shared frame of the pelvis is defined by hip and lumbar joints, those of the limbs' long bones by their
directions; the others are link frames. On CMU's mean skeleton all of them are.

``R_world_shared = R_world_bone @ R_bone_shared`` and ``offset_shared = R_parent_shared^T offset``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

LIMBS = tuple(
    tuple(side + part for part in parts)
    for side in ("Left", "Right")
    for parts in (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"))
)
"""Segments of each limb by their joints: two long bones and the end."""


def bare(sensors: Collection[str]) -> set[str]:
    """Return the segments of limbs without any sensor."""
    return {name for limb in LIMBS if not {*limb} & {*sensors} for name in limb}


def both_bones_sensed(sensors: Collection[str]) -> bool:
    """Return whether a limb has sensors on both long bones, which makes the root position observable."""
    return any({*limb[:2]} <= {*sensors} for limb in LIMBS)


_NEAR_OPPOSITE = 1 + np.cos(np.radians(170.0))
"""Value of 1 + cos(angle) below which a swing keeps the twist of the previous frame."""
_TWIST_RETURN = np.radians(5.0)
"""Largest twist per frame, rad, by which a swing returns to the twist of the parent afterwards."""


def children_of(parents: Sequence[int], joint: int) -> list[int]:
    """Return the indices of the children of a joint."""
    return [child for child, parent in enumerate(parents) if parent == joint]


def line_to_root(parents: Sequence[int], joint: int) -> list[int]:
    """Return the indices of a joint and its ancestors, up to the root."""
    line = [joint]
    while parents[line[-1]] >= 0:
        line.append(parents[line[-1]])
    return line


def positions(parents: Sequence[int], offsets: Array, p_root: Array, R_world_bone: Array) -> Array:
    """Return joint positions (..., J, 3) in world, m. p_root: (..., 3) m. R_world_bone: (..., J, 3, 3)."""
    p = np.empty((*R_world_bone.shape[:-2], 3))
    for j, parent in enumerate(parents):
        p[..., j, :] = p_root if parent < 0 else p[..., parent, :] + R_world_bone[..., parent, :, :] @ offsets[j]
    return p


def world_rotations(parents: Sequence[int], R_parent_bone: Array) -> Array:
    """Return R_world_bone (..., J, 3, 3). R_parent_bone: (..., J, 3, 3), the root's relative to world."""
    R = np.empty_like(R_parent_bone)
    for j, parent in enumerate(parents):
        local = R_parent_bone[..., j, :, :]
        R[..., j, :, :] = local if parent < 0 else R[..., parent, :, :] @ local
    return R


def local_rotations(parents: Sequence[int], R_world_bone: Array) -> Array:
    """Return R_parent_bone (..., J, 3, 3), the inverse of `world_rotations`. R_world_bone: (..., J, 3, 3)."""
    R = R_world_bone.copy()
    for j, parent in enumerate(parents):
        if parent >= 0:
            R_parent = np.swapaxes(R_world_bone[..., parent, :, :], -1, -2)
            R[..., j, :, :] = R_parent @ R_world_bone[..., j, :, :]
    return R


def segment_rotation(parents: Sequence[int], offsets: Array, joint: int, p: Array, R_parent: Array) -> Array:
    """Return R_world_bone (T, 3, 3) of a segment from joint positions (SolveRotation in Algorithm 1 of the paper).

    Several children determine it (Kabsch). One child determines the direction of the bone; the twist follows
    the parent. A leaf has the orientation of its parent.

    Args:
        p: (T, J, 3) m, finite, of any bone lengths.
        R_parent: (T, 3, 3) orientation of the parent in world; identity for the root.
    """
    children = children_of(parents, joint)
    if not children:
        return R_parent
    bones = p[:, children] - p[:, [joint]]
    if len(children) == 1:
        return swing(R_parent, offsets[children[0]], bones[:, 0])
    return so3.nearest_rotation(np.einsum("tci,cj->tij", bones, offsets[children]))


def swing(R_parent: Array, rest: Array, observed: Array) -> Array:
    """Rotate the parent's orientation by the smallest angle that aligns a bone: (T, 3, 3).

    Near 180 degrees the axis, and so the twist about the bone, is undefined: the twist is carried over from
    the previous frame (parallel transport) and returns afterwards by at most 5 degrees per frame.

    Args:
        R_parent: (T, 3, 3). rest: (3,) bone in the link frame. observed: (T, 3) bone in world.
    """
    expected, seen = R_parent @ so3.unit(rest), so3.unit(observed)
    R = so3.minimal_rotation(expected, seen) @ R_parent
    opposite = 1 + np.sum(expected * seen, axis=-1) < _NEAR_OPPOSITE
    if not opposite.any():
        return R
    behind = bool(opposite[0])
    for t in range(max(int(np.argmax(opposite)), 1), len(R)):
        if not (opposite[t] or behind):
            continue
        carried = R_parent[t] @ R_parent[t - 1].T @ R[t - 1]
        carried = so3.minimal_rotation(carried @ rest, seen[t]) @ carried
        twist = so3.angle_about(seen[t], R[t] @ carried.T)
        behind = bool(opposite[t]) or abs(twist) > _TWIST_RETURN
        if opposite[t]:
            R[t] = carried
        elif behind:
            R[t] = so3.exp(np.copysign(_TWIST_RETURN, twist) * seen[t]) @ carried
    return R


def rotations_from_positions(parents: Sequence[int], offsets: Array, p: Array) -> Array:
    """Return `segment_rotation` of all joints (T, J, 3, 3) from positions (T, J, 3), m; NaN in incomplete frames."""
    known = np.isfinite(p).all(axis=(1, 2))
    R = np.full((*p.shape[:2], 3, 3), np.nan)
    R_known = np.empty((int(known.sum()), p.shape[1], 3, 3))
    for j, parent in enumerate(parents):
        identity = np.broadcast_to(np.eye(3), (len(R_known), 3, 3))
        R_parent = identity if parent < 0 else R_known[:, parent]
        R_known[:, j] = segment_rotation(parents, offsets, j, p[known], R_parent)
    R[known] = R_known
    return R


LUMBAR_PITCH: Final = np.radians(-17.5)
"""Direction from the middle of the hips to the lumbar joint in the shared frame, about y from z, rad."""
_STRAIGHT: Final = np.radians(6.0)
"""A lumbar joint nearer to the vertical is drawn there, not measured; the pelvis keeps its link frame."""


def shared_frames(names: Sequence[str], offsets: Array) -> Array:
    """Return the shared frame of each segment in its link frame, R_bone_shared (J, 3, 3).

    Args:
        names: J joints; those of the 21-joint skeleton are known, segments of others keep their link frames.
        offsets: (J, 3) in the parents' link frames, m.
    """
    offset = dict(zip(names, np.asarray(offsets, dtype=float), strict=True))
    R = np.tile(np.eye(3), (len(names), 1, 1))
    if {"Hips", "LeftUpLeg", "RightUpLeg", "Spine"} <= set(names):
        R[names.index("Hips")] = _pelvis(offset["LeftUpLeg"], offset["RightUpLeg"], offset["Spine"])
    for limb in LIMBS:
        left = limb[0].startswith("Left")
        direction = [0, 0, -1] if limb[0].endswith("Leg") else [0, 1 if left else -1, 0]
        for joint, child in pairwise(limb):
            if {joint, child} <= set(names):
                R[names.index(joint)] = so3.minimal_rotation(direction, offset[child])
    return R


def to_shared(R_bone_shared: Array, parents: Sequence[int], offsets: Array) -> Array:
    """Return joint offsets (J, 3) in the parents' shared frames, m, from those in the parents' link frames, m."""
    above = R_bone_shared[np.maximum(parents, 0)]
    return np.asarray(np.einsum("jba,jb->ja", above, offsets))


def hip_centres(left_asis: Array, right_asis: Array, back: Array) -> tuple[Array, Array]:
    """Return the left and the right hip joint centre (..., 3), m, by the simple regressions of Harrington et al. (2007,
    J. Biomech. 40) from the iliac spines, the hind ones by their middle, (..., 3) m in any axes.
    """
    front, across = (left_asis + right_asis) / 2, so3.unit(left_asis - right_asis)
    width, depth = (np.linalg.norm(way, axis=-1, keepdims=True) for way in (left_asis - right_asis, front - back))
    forward = so3.unit(front - back - np.sum((front - back) * across, axis=-1, keepdims=True) * across)
    up = np.cross(forward, across)
    middle = front - (0.24 * depth + 0.0099) * forward - (0.30 * width + 0.0109) * up
    out = (0.33 * width + 0.0073) * across
    return middle + out, middle - out


def _pelvis(left_hip: Array, right_hip: Array, lumbar: Array) -> Array:
    """Frame (3, 3) with y from hip to hip and the lumbar joint at `LUMBAR_PITCH`."""
    up = lumbar - (left_hip + right_hip) / 2
    if abs(np.arctan2(up[0], up[2])) < _STRAIGHT:
        return np.eye(3)
    y = so3.unit(left_hip - right_hip)
    z = so3.unit(up - (up @ y) * y)
    return np.stack([np.cross(y, z), y, z], axis=-1) @ so3.about_axis("y", -LUMBAR_PITCH)
