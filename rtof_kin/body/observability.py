"""Observability of segments, degrees of freedom, landmarks and bones of a motion.

A configuration has a value for every degree of freedom, observed or not. A degree of freedom is observed if

* at least the directions of the segments on both sides of its joint were observed;
* for a rotation of a segment about its own bone, the whole orientation or a bone beyond it was observed;
* the model lets it move: in joint space knees and elbows are hinges, whose other two angles stay zero.

Accuracy is described by `Motion.confidence`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance

NOTHING, DIRECTION, WHOLE = 0, 1, 2  #: Observed part of a segment's orientation
_APART = 0.01  #: Least distance of points from each other, or from the bone, that determines an orientation, m
_ALONG = 0.9  #: Least cosine between an axis and the bone for a rotation about the bone
_FIXED, _MOVES = 1e-9, 1e-3
"""An angle within the first was fixed by the model if another one of the joint exceeds the second, rad."""


@dataclass(frozen=True)
class ObservationMasks:
    """What of a motion was observed, without its poses: 5 bytes a joint and frame, whole at any length.

    Frames of it keep what is known of the whole: whether there is any provenance, and which angles move.
    """

    skeleton: SkeletonModel
    valid: Mask  #: (T, J) as in `PoseSequence`, like the next three
    provenance: NDArray[np.uint8]
    orientation_observed: Mask
    direction_observed: Mask
    posed: Mask  #: (T, J) whether the orientation of the segment is known
    known: Mask  #: (T,) whether the configuration is known
    largest: Array  #: (D,) largest absolute value of each degree of freedom in the whole motion, rad
    has_provenance: bool  #: Whether any joint of the whole motion has a provenance
    has_orientations: bool  #: Whether any orientation of the whole motion was observed

    @classmethod
    def of(cls, motion: Motion | Self) -> ObservationMasks:
        """Return the masks of a motion; masks are returned as they are."""
        if isinstance(motion, ObservationMasks):
            return motion
        masks = cls.of_poses(motion.poses, motion.skeleton)
        known: Mask = np.asarray(np.isfinite(motion.q).all(axis=1))
        largest = np.abs(motion.q[known, 7:]).max(axis=0, initial=0.0)
        return replace(masks, known=known, largest=largest)

    @classmethod
    def of_poses(cls, poses: PoseSequence, skeleton: SkeletonModel) -> ObservationMasks:
        """Return the masks of poses; their configuration counts as unknown."""
        return ObservationMasks(
            skeleton,
            **{name: getattr(poses, name) for name in _MASKS},
            posed=np.asarray(np.isfinite(poses.R_world_bone).all(axis=(-2, -1))),
            known=np.zeros(len(poses), dtype=np.bool_),
            largest=np.zeros(len(skeleton.dof_names)),
            has_provenance=bool(poses.provenance.any()),
            has_orientations=bool(poses.orientation_observed.any()),
        )

    @classmethod
    def joined(cls, parts: Sequence[ObservationMasks]) -> ObservationMasks:
        """Return the masks of consecutive parts of one motion as those of the whole."""
        whole: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS}
        return replace(
            parts[0],
            **whole,
            largest=np.max([part.largest for part in parts], axis=0),
            has_provenance=any(part.has_provenance for part in parts),
            has_orientations=any(part.has_orientations for part in parts),
        )

    def __len__(self) -> int:
        return len(self.known)

    def __getitem__(self, frames: slice) -> Self:
        own: dict[str, Any] = {name: getattr(self, name)[frames] for name in _ROWS}
        return replace(self, **own)

    @property
    def position_observed(self) -> Mask:
        """(T, J) observed positions, as in `PoseSequence`."""
        return np.asarray(self.valid & ((self.provenance >= Provenance.IMU) | (not self.has_provenance)))

    @property
    def has_sources(self) -> bool:
        """Whether the motion says what was observed; one of motion capture does not, and is observed."""
        return self.has_provenance or self.has_orientations

    @cached_property
    def levels(self) -> NDArray[np.int8]:
        """(T, J) `NOTHING`, `DIRECTION` (of the bone) or `WHOLE` of each segment."""
        at = self.position_observed
        levels = np.where(self.direction_observed, DIRECTION, NOTHING).astype(np.int8)
        for j in range(len(self.skeleton.names)):
            children = kinematics.children_of(self.skeleton.parents, j)
            if len(children) == 1:
                levels[at[:, j] & at[:, children[0]], j] = DIRECTION
        # A sensor observes the orientation of its segment even while the position is unobserved.
        levels[self.orientation_observed & (self.valid | self.has_provenance)] = WHOLE
        levels[~self.posed] = NOTHING
        return levels


_MASKS: Final = ("valid", "provenance", "orientation_observed", "direction_observed")
_ROWS: Final = (*_MASKS, "posed", "known")  #: Fields with a row per frame


def segment_levels(poses: PoseSequence, skeleton: SkeletonModel) -> NDArray[np.int8]:
    """Return `NOTHING`, `DIRECTION` (of the bone) or `WHOLE` for each segment (T, J)."""
    return ObservationMasks.of_poses(poses, skeleton).levels


def levels_by_points(skeleton: SkeletonModel, keypoints: KeypointSequence) -> NDArray[np.int_]:
    """Return `segment_levels` (T, J) from landmarks: DIRECTION from two points, WHOLE from three not in line.

    A joint is a point of its own segment and of its parent's.

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


def observed_dofs(motion: Motion | ObservationMasks) -> Mask:
    """Return a mask (T, D) of observed degrees of freedom, in the order of `SkeletonModel.dof_names`.

    A motion without provenance (mocap) is observed wherever it is finite.
    """
    masks = ObservationMasks.of(motion)
    skeleton, levels = masks.skeleton, masks.levels
    out: Mask = np.repeat(masks.known[:, None], len(skeleton.dof_names), axis=1)
    if not masks.has_sources:
        return out
    for j, parent in enumerate(skeleton.parents):
        if parent < 0:
            continue
        joint = skeleton.table.joints[j]
        columns = [skeleton.dof_names.index(dof.urdf) for dof in joint.dofs]
        seen = (levels[:, [j, parent]] > NOTHING).all(axis=1)
        beyond = levels[:, kinematics.children_of(skeleton.parents, j)] > NOTHING
        turned = (levels[:, j] == WHOLE) | beyond.any(axis=1)
        along = np.abs(_bone(skeleton, j)) > _ALONG
        largest = masks.largest[columns]
        fixed = (largest <= _FIXED) & np.any(largest > _MOVES)
        for column, axis, still in zip(columns, joint.axes, fixed, strict=True):
            out[:, column] &= seen & ~still & (turned | ~along["xyz".index(axis)])
    return out


def root_turn_observed(motion: Motion | ObservationMasks) -> Mask:
    """Return a mask (T,) of frames with observed root orientation."""
    masks = ObservationMasks.of(motion)
    return np.asarray(masks.known & (masks.levels[:, 0] == WHOLE)) if masks.has_sources else masks.known


def never_observed(motion: Motion | ObservationMasks) -> tuple[str, ...]:
    """Return the URDF names of degrees of freedom that were never observed and do not move anything observed. They are
    zero, or belong to a segment without children.
    """
    masks = ObservationMasks.of(motion)
    skeleton = masks.skeleton
    observed = np.any(observed_dofs(masks), axis=0)
    zero = masks.largest <= _FIXED
    ends = {
        dof.urdf for j, joint in enumerate(skeleton.table.joints) for dof in joint.dofs if j not in skeleton.parents
    }
    return tuple(
        name
        for name, seen, none in zip(skeleton.dof_names, observed, zero, strict=True)
        if not seen and (none or name in ends)
    )


def observed_landmarks(motion: Motion | ObservationMasks) -> Mask:
    """Return a mask (T, L) of observed landmarks. The position of the joint must be observed, and for other points than
    the joint the orientation of the segment; the direction of the bone suffices for points on the bone.
    """
    masks = ObservationMasks.of(motion)
    skeleton, located = masks.skeleton, masks.position_observed
    levels = masks.levels if masks.has_sources else np.full_like(masks.levels, WHOLE)
    columns = []
    for joint, offset in skeleton.landmarks.values():
        j = skeleton.names.index(joint)
        needed = NOTHING if not offset.any() else WHOLE
        if needed and np.linalg.norm(np.cross(_bone(skeleton, j), offset)) < _APART:
            needed = DIRECTION
        columns.append(located[:, j] & (levels[:, j] >= needed))
    return np.stack(columns, axis=1)


def observed_bones(motion: Motion | ObservationMasks) -> Mask:
    """Return a mask (T, J) of observed lines from parents to joints; of the root, whether it is observed. Both ends
    must be observed, or the orientation of the segment if the joint is valid.
    """
    masks = ObservationMasks.of(motion)
    located = masks.position_observed
    out: Mask = np.array(located)
    for j, parent in enumerate(masks.skeleton.parents):
        if parent >= 0:
            turned = masks.levels[:, parent] == WHOLE
            out[:, j] = located[:, [j, parent]].all(axis=1) | (turned & masks.valid[:, j])
    return out


def _bone(skeleton: SkeletonModel, joint: int) -> Array:
    """Return the unit vector (3,) along a segment, to its only child or else its far end."""
    children = kinematics.children_of(skeleton.parents, joint)
    only = skeleton.joint_offsets[children[0]] if len(children) == 1 else None
    return so3.unit(skeleton.table.joints[joint].end if only is None else only)
