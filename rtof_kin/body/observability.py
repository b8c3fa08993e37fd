"""What of a motion was observed: segments, degrees of freedom, landmarks, and bones as they are drawn.

A configuration has a number for every degree of freedom, whether anybody saw it or not. One counts as
observed where

* the segments on both sides of its joint were seen, the direction of their bones at least;
* if it turns a segment about its own bone, so was the segment's whole orientation, or a bone beyond it;
* the model lets it move: knees and elbows of joint space are hinges, whose other two angles stay zero.

How well it is known is a matter of `MotionSequence.confidence`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
NOTHING, DIRECTION, WHOLE = 0, 1, 2
"""How much of a segment's orientation was seen."""
_APART = 0.01
"""Points of a segment show its direction, or its turn about that, from this distance on, m."""
_ALONG = 0.9
"""Cosine to the bone from which an axis is the one that a segment turns about its own bone."""
_FIXED, _MOVES = 1e-9, 1e-3
"""[rad] An angle that never leaves the one was fixed by the model, if another of its joint leaves the
other."""


def segment_levels(poses: PoseSequence, skeleton: SkeletonModel) -> NDArray[np.int_]:
    """(T, J) how much of each segment's orientation was seen: nothing, its bone's direction, or all."""
    at = poses.position_observed
    levels: NDArray[np.int_] = np.where(poses.direction_observed, DIRECTION, NOTHING)
    for j in range(len(skeleton.names)):
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) == 1:
            levels[at[:, j] & at[:, children[0]], j] = DIRECTION
    # A sensor sees its bone turn even while nobody sees where it is.
    levels[poses.orientation_observed & (poses.valid | bool(poses.provenance.any()))] = WHOLE
    levels[~np.isfinite(poses.R_world_bone).all(axis=(-2, -1))] = NOTHING
    return levels


def levels_by_points(skeleton: SkeletonModel, keypoints: KeypointSequence) -> NDArray[np.int_]:
    """(T, J) how much of each segment's orientation the landmarks show that lie in it: a direction by two
    points that are apart, all by three that are not on one line. Joints end the segment before, too.

    Args:
        keypoints: landmarks that the skeleton does not have are ignored.
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
        patterns, frames = np.unique(keypoints.seen[:, index], axis=0, return_inverse=True)
        ranks = [_rank(offsets[pattern]) for pattern in patterns]
        levels[:, j] = np.array(ranks)[frames.ravel()]
    return levels


def _rank(points: Array) -> int:
    """What points (n, 3) of a rigid segment show of its orientation."""
    if len(points) < 2:
        return NOTHING
    spread: Array = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return min(int(np.sum(spread > _APART)), WHOLE)


def observed_dofs(motion: MotionSequence) -> Mask:
    """(T, D) whether each degree of freedom was observed, in the order of `SkeletonModel.dof_names`.

    A motion that says nothing of who saw it (mocap) is taken to be observed wherever it is known.
    """
    skeleton, poses = motion.skeleton, motion.poses
    known: Mask = np.asarray(np.isfinite(motion.q).all(axis=1))
    out: Mask = np.repeat(known[:, None], len(skeleton.dof_names), axis=1)
    if not _says_who_saw(poses):
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
    """(T,) whether the orientation of the root's segment was observed, else as of `observed_dofs`."""
    known: Mask = np.asarray(np.isfinite(motion.q).all(axis=1))
    if not _says_who_saw(motion.poses):
        return known
    turned = segment_levels(motion.poses, motion.skeleton)[:, 0] == WHOLE
    return np.asarray(known & turned)


def never_observed(motion: MotionSequence) -> tuple[str, ...]:
    """Degrees of freedom, by their URDF names, that were observed in no frame and whose numbers place
    nothing that was seen: they are zero, or their segment carries no other.
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
    """(T, L) whether somebody saw where each landmark is: its joint, and of other points the segment's
    orientation, of which the bone's direction is enough for a point on the bone.
    """
    skeleton, poses = motion.skeleton, motion.poses
    levels = segment_levels(poses, skeleton)
    if not _says_who_saw(poses):
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
    """(T, J) whether the line from each joint's parent to it was seen: both ends, or the segment's turn
    where the joint is valid. Of the root, whether it was seen itself.
    """
    poses, skeleton = motion.poses, motion.skeleton
    located, levels = poses.position_observed, segment_levels(poses, skeleton)
    out: Mask = np.array(located)
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            turned = levels[:, parent] == WHOLE
            out[:, j] = located[:, [j, parent]].all(axis=1) | (turned & poses.valid[:, j])
    return out


def _says_who_saw(poses: PoseSequence) -> bool:
    return bool(poses.provenance.any() or poses.orientation_observed.any())


def _bone(skeleton: SkeletonModel, joint: int) -> Array:
    """(3,) unit vector along a segment in its link frame: to its only child, else to its far end."""
    children = kinematics.children_of(skeleton.parents, joint)
    only = skeleton.joint_offsets[children[0]] if len(children) == 1 else None
    return so3.unit(skeleton.table.joints[joint].end if only is None else only)
