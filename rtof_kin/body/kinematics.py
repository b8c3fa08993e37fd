"""Kinematics of a tree of rigid segments, on arrays and over all frames at once.

Every function takes the tree as `parents` (J,) with -1 for the root and parents before children, and
`offsets` (J, 3): each joint in its parent's link frame, m.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
NEAR_OPPOSITE = 1 + np.cos(np.radians(170.0))
"""Below this 1 + cos(angle) a swing keeps the twist of the frame before, not of the parent."""
TWIST_RETURN = np.radians(5.0)
"""Largest twist per frame, radians, by which a swing returns to the parent's after that."""


def children_of(parents: Sequence[int], joint: int) -> list[int]:
    """Indices of a joint's children."""
    return [child for child, parent in enumerate(parents) if parent == joint]


def line_to_root(parents: Sequence[int], joint: int) -> list[int]:
    """Indices of a joint, its parent, and so on to the root."""
    line = [joint]
    while parents[line[-1]] >= 0:
        line.append(parents[line[-1]])
    return line


def positions(parents: Sequence[int], offsets: Array, p_root: Array, R_world_bone: Array) -> Array:
    """Joint positions (..., J, 3) in world from segment orientations (..., J, 3, 3) and the root's."""
    p = np.empty((*R_world_bone.shape[:-2], 3))
    for j, parent in enumerate(parents):
        p[..., j, :] = (
            p_root if parent < 0 else p[..., parent, :] + R_world_bone[..., parent, :, :] @ offsets[j]
        )
    return p


def world_rotations(parents: Sequence[int], R_parent_bone: Array) -> Array:
    """Segment orientations in world (..., J, 3, 3) from those relative to the parent (root: world)."""
    R = np.empty_like(R_parent_bone)
    for j, parent in enumerate(parents):
        local = R_parent_bone[..., j, :, :]
        R[..., j, :, :] = local if parent < 0 else R[..., parent, :, :] @ local
    return R


def local_rotations(parents: Sequence[int], R_world_bone: Array) -> Array:
    """Inverse of `world_rotations`: R_parent_bone (..., J, 3, 3)."""
    R = R_world_bone.copy()
    for j, parent in enumerate(parents):
        if parent >= 0:
            R_parent = np.swapaxes(R_world_bone[..., parent, :, :], -1, -2)
            R[..., j, :, :] = R_parent @ R_world_bone[..., j, :, :]
    return R


def segment_rotation(parents: Sequence[int], offsets: Array, joint: int, p: Array, R_parent: Array) -> Array:
    """Orientation of one segment from joint positions: SolveRotation of the paper's Algorithm 1.

    Several children fix it (Kabsch). One child fixes the bone's direction; the twist follows the
    parent. A leaf copies its parent.

    Args:
        joint: index of the segment. p: (T, J, 3) m, any bone lengths, finite.
        R_parent: (T, 3, 3) orientation of the parent segment in world; identity for the root.

    Returns:
        (T, 3, 3) R_world_bone of the segment.
    """
    children = children_of(parents, joint)
    if not children:
        return R_parent
    bones = p[:, children] - p[:, [joint]]
    if len(children) == 1:
        return swing(R_parent, offsets[children[0]], bones[:, 0])
    return so3.nearest_rotation(np.einsum("tci,cj->tij", bones, offsets[children]))


def swing(R_parent: Array, rest: Array, observed: Array) -> Array:
    """The parent's orientation (T, 3, 3) turned so that a rest bone (3,) points as observed (T, 3).

    The turn is the smallest one. Where it is nearly half a turn its axis is undefined and the twist
    about the bone with it; there the twist is carried over from the frame before (parallel transport),
    and afterwards returns to the smallest turn's by at most `TWIST_RETURN` a frame: it never jumps.
    """
    expected, seen = R_parent @ so3.unit(rest), so3.unit(observed)
    R = so3.minimal_rotation(expected, seen) @ R_parent
    opposite = 1 + np.sum(expected * seen, axis=-1) < NEAR_OPPOSITE
    if not opposite.any():
        return R
    behind = bool(opposite[0])
    for t in range(max(int(np.argmax(opposite)), 1), len(R)):
        if not (opposite[t] or behind):
            continue
        carried = R_parent[t] @ R_parent[t - 1].T @ R[t - 1]
        carried = so3.minimal_rotation(carried @ rest, seen[t]) @ carried
        twist = so3.angle_about(seen[t], R[t] @ carried.T)
        behind = bool(opposite[t]) or abs(twist) > TWIST_RETURN
        if opposite[t]:
            R[t] = carried
        elif behind:
            R[t] = so3.exp(np.copysign(TWIST_RETURN, twist) * seen[t]) @ carried
    return R


def rotations_from_positions(parents: Sequence[int], offsets: Array, p: Array) -> Array:
    """Segment orientations (T, J, 3, 3) from joint positions (T, J, 3) alone; see `segment_rotation`.

    Frames with a joint that is not finite are NaN.
    """
    known = np.isfinite(p).all(axis=(1, 2))
    R = np.full((*p.shape[:2], 3, 3), np.nan)
    R_known = np.empty((int(known.sum()), p.shape[1], 3, 3))
    for j, parent in enumerate(parents):
        identity = np.broadcast_to(np.eye(3), (len(R_known), 3, 3))
        R_parent = identity if parent < 0 else R_known[:, parent]
        R_known[:, j] = segment_rotation(parents, offsets, j, p[known], R_parent)
    R[known] = R_known
    return R
