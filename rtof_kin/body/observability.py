"""Observability of segments, degrees of freedom, landmarks and bones of a motion.

A configuration has a value for every degree of freedom, observed or not. A degree of freedom is observed if

* at least the directions of the segments on both sides of its joint were observed;
* for a rotation of a segment about its own bone, the whole orientation or a bone beyond it was observed;
* the model lets it move: in joint space knees and elbows are hinges, whose other two angles stay zero.

Accuracy is described by `MotionSequence.confidence`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

NOTHING, DIRECTION, WHOLE = 0, 1, 2
"""Observed part of a segment's orientation."""
_APART = 0.01
"""Least distance of points from each other, or from the bone, that determines an orientation, m."""
_ALONG = 0.9
"""Least cosine between an axis and the bone for a rotation about the bone."""
_FIXED, _MOVES = 1e-9, 1e-3
"""An angle within the first was fixed by the model if another one of the joint exceeds the second, rad."""


def segment_levels(poses: PoseSequence, skeleton: SkeletonModel) -> NDArray[np.int_]:
    """Return `NOTHING`, `DIRECTION` (of the bone) or `WHOLE` for each segment (T, J).

    Args:
        poses: of all joints. skeleton: of the poses.
    """
    at = poses.position_observed
    levels: NDArray[np.int_] = np.where(poses.direction_observed, DIRECTION, NOTHING)
    for j in range(len(skeleton.names)):
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) == 1:
            levels[at[:, j] & at[:, children[0]], j] = DIRECTION
    # A sensor observes the orientation of its segment even while the position is unobserved.
    levels[poses.orientation_observed & (poses.valid | bool(poses.provenance.any()))] = WHOLE
    levels[~np.isfinite(poses.R_world_bone).all(axis=(-2, -1))] = NOTHING
    return levels


def levels_by_points(skeleton: SkeletonModel, keypoints: KeypointSequence) -> NDArray[np.int_]:
    """Return `segment_levels` (T, J) from landmarks: DIRECTION from two points, WHOLE from three not in line.

    A joint is a point of its own segment and of its parent's.

    Args:
        skeleton: of the person. keypoints: landmarks that the skeleton does not have are ignored.
    """
    places: list[list[tuple[int, Array]]] = [[] for _ in skeleton.names]
    for i, name in enumerate(keypoints.names):
        if name in skeleton.landmarks:
            joint, offset = skeleton.landmarks[name]
            j = skeleton.names.index(joint)
            places[j].append((i, offset))
            if name in skeleton.names and (parent := skeleton.parents[j]) >= 0:
                places[parent].append((i, skeleton.joint_offsets[j]))
    levels = np.full((len(keypoints), len(skeleton.names)), NOTHING)
    for j, points in enumerate(places):
        index = [i for i, _ in points]
        offsets = np.array([offset for _, offset in points]).reshape(-1, 3)
        seen = keypoints.seen[:, index]
        codes = seen @ (1 << np.arange(len(index)))  # a number for every pattern of seen points
        _, first, pattern = np.unique(codes, return_index=True, return_inverse=True)
        levels[:, j] = np.array([_rank(offsets[seen[t]]) for t in first])[pattern]
    return levels


def _rank(points: Array) -> int:
    """Return the level of orientation that points (n, 3) of a rigid segment determine."""
    if len(points) < 2:
        return NOTHING
    spread: Array = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return min(int(np.sum(spread > _APART)), WHOLE)


def observed_dofs(motion: MotionSequence) -> Mask:
    """Return a mask (T, D) of observed degrees of freedom, in the order of `SkeletonModel.dof_names`.

    A motion without provenance (mocap) is observed wherever it is finite.

    Args:
        motion: with poses and provenance.
    """
    skeleton, poses = motion.skeleton, motion.poses
    known: Mask = np.asarray(np.isfinite(motion.q).all(axis=1))
    out: Mask = np.repeat(known[:, None], len(skeleton.dof_names), axis=1)
    if not _has_provenance(poses):
        return out
    levels = segment_levels(poses, skeleton)
    for j, parent in enumerate(skeleton.parents):
        if parent < 0:
            continue
        joint = skeleton.table.joints[j]
        columns = [skeleton.dof_names.index(dof.urdf) for dof in joint.dofs]
        seen = (levels[:, [j, parent]] > NOTHING).all(axis=1)
        beyond = levels[:, kinematics.children_of(skeleton.parents, j)] > NOTHING
        turned = (levels[:, j] == WHOLE) | beyond.any(axis=1)
        along = np.abs(_bone(skeleton, j)) > _ALONG
        angles = np.abs(motion.q[known][:, 7:][:, columns])
        fixed = np.all(angles <= _FIXED, axis=0) & np.any(angles > _MOVES)
        for column, axis, still in zip(columns, joint.axes, fixed, strict=True):
            out[:, column] &= seen & ~still & (turned | ~along["xyz".index(axis)])
    return out


def root_turn_observed(motion: MotionSequence) -> Mask:
    """Return a mask (T,) of frames with observed root orientation.

    Args:
        motion: see `observed_dofs`.
    """
    known: Mask = np.asarray(np.isfinite(motion.q).all(axis=1))
    if not _has_provenance(motion.poses):
        return known
    turned = segment_levels(motion.poses, motion.skeleton)[:, 0] == WHOLE
    return np.asarray(known & turned)


def never_observed(motion: MotionSequence) -> tuple[str, ...]:
    """Return the URDF names of degrees of freedom that were never observed and do not move anything observed.

    They are zero, or belong to a segment without children.

    Args:
        motion: see `observed_dofs`.
    """
    skeleton = motion.skeleton
    observed = np.any(observed_dofs(motion), axis=0)
    zero = ~np.any(np.abs(motion.q[:, 7:]) > _FIXED, axis=0)
    ends = {
        dof.urdf for j, joint in enumerate(skeleton.table.joints) for dof in joint.dofs
        if j not in skeleton.parents
    }  # fmt: skip
    return tuple(
        name for name, seen, none in zip(skeleton.dof_names, observed, zero, strict=True)
        if not seen and (none or name in ends)
    )  # fmt: skip


def observed_landmarks(motion: MotionSequence) -> Mask:
    """Return a mask (T, L) of observed landmarks.

    The position of the joint must be observed, and for other points than the joint the orientation of the
    segment; the direction of the bone suffices for points on the bone.

    Args:
        motion: see `observed_dofs`.
    """
    skeleton, poses = motion.skeleton, motion.poses
    levels = segment_levels(poses, skeleton)
    if not _has_provenance(poses):
        levels[:] = WHOLE
    located = poses.position_observed
    columns = []
    for joint, offset in skeleton.landmarks.values():
        j = skeleton.names.index(joint)
        needed = NOTHING if not offset.any() else WHOLE
        if needed and np.linalg.norm(np.cross(_bone(skeleton, j), offset)) < _APART:
            needed = DIRECTION
        columns.append(located[:, j] & (levels[:, j] >= needed))
    return np.stack(columns, axis=1)


def observed_bones(motion: MotionSequence) -> Mask:
    """Return a mask (T, J) of observed lines from parents to joints; of the root, whether it is observed.

    Both ends must be observed, or the orientation of the segment if the joint is valid.

    Args:
        motion: see `observed_dofs`.
    """
    poses, skeleton = motion.poses, motion.skeleton
    located, levels = poses.position_observed, segment_levels(poses, skeleton)
    out: Mask = np.array(located)
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            turned = levels[:, parent] == WHOLE
            out[:, j] = located[:, [j, parent]].all(axis=1) | (turned & poses.valid[:, j])
    return out


def _has_provenance(poses: PoseSequence) -> bool:
    return bool(poses.provenance.any() or poses.orientation_observed.any())


def _bone(skeleton: SkeletonModel, joint: int) -> Array:
    """Return the unit vector (3,) along a segment, to its only child or else its far end."""
    children = kinematics.children_of(skeleton.parents, joint)
    only = skeleton.joint_offsets[children[0]] if len(children) == 1 else None
    return so3.unit(skeleton.table.joints[joint].end if only is None else only)
