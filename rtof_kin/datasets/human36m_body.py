"""Joint offsets of a subject, measured from positions of the joints in many frames.

Human3.6M's bones have constant length, but the spine turns about the pelvis and the shoulders about the
thorax: segments with several children are not quite rigid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
_FRAMES = 4000
"""Number of frames, evenly spread, from which the shape of a segment is estimated."""
_ROUNDS, _CONVERGED = 50, 1e-9


def bone_lengths(skeleton: SkeletonModel, p_world_joint: Array) -> Array:
    """Return the median distance (J,) of each joint from its parent, m, 0 for the root.

    Args:
        skeleton: with the parents. p_world_joint: (T, J, 3) m, joints in its order, finite.
    """
    parents = np.maximum(skeleton.parents, 0)
    distance = np.linalg.norm(p_world_joint - p_world_joint[:, parents], axis=-1)
    return np.asarray(np.median(distance, axis=0))


def measured_offsets(skeleton: SkeletonModel, p_world_joint: Array) -> Array:
    """Return the subject's joint offsets (J, 3) in the parents' link frames, m, 0 for the root.

    Each bone has its median length. A segment with one child has the direction of the table. For one with
    several (pelvis, thorax) the directions are those of the mean shape of its children: a Procrustes
    analysis over the frames, without scale (Gower 1975), in axes nearest to the table's.

    Args:
        skeleton: with the table. p_world_joint: (T, J, 3) m, joints in its order, finite.

    Raises:
        InvalidInputError: a bone has no length.
    """
    lengths = bone_lengths(skeleton, p_world_joint)
    named = dict(zip(skeleton.names[1:], lengths[1:].tolist(), strict=True))
    offsets = np.array(skeleton.with_bone_lengths(named).joint_offsets)
    p = p_world_joint[:: -(-len(p_world_joint) // _FRAMES)]
    for joint in range(len(skeleton.names)):
        children = kinematics.children_of(skeleton.parents, joint)
        if len(children) > 1:
            bones = p[:, children] - p[:, [joint]]
            offsets[children] = _mean_shape(bones, offsets[children])
    return offsets


def _mean_shape(bones: Array, table: Array) -> Array:
    """Return directions of bones (T, C, 3) in common axes, near those of a table (C, 3), with its lengths."""
    lengths = np.linalg.norm(table, axis=-1, keepdims=True)
    shape = table
    for _ in range(_ROUNDS):
        R = so3.nearest_rotation(np.einsum("tci,cj->tij", bones, shape))
        turned = np.einsum("tji,tcj->tci", R, bones)
        before, shape = shape, lengths * so3.unit(np.median(turned, axis=0))
        if np.abs(shape - before).max() < _CONVERGED:
            break
    to_table = so3.nearest_rotation(np.einsum("ci,cj->ij", table, shape))
    return np.asarray(shape @ to_table.T)
