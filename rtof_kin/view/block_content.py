"""What is drawn of a block of frames, as arrays for the batched meshes of the scene.

Nothing unobserved is drawn as if it had been seen: a segment has the colour of the weakest of its ends, and
the colour of the prior where its direction was not observed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.observability import DIRECTION, WHOLE, segment_levels
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.view.legend import PALETTE

_TRUNK: Final = (0.8, 1.25)
"""Depth and width of a segment in the middle of the body, relative to the radius in the table."""
_LONGER: Final = 1.12  # Length of a solid relative to its bone: neighbours overlap
QUANTILE_95: Final = 2.795483
"""Radius of the 95 % ellipsoid of a normal error in three dimensions, in standard deviations."""
LARGEST_SEMI_AXIS: Final = 2.0  #: [m] Ellipsoids beyond it are not drawn: the position is unknown
AXES_LENGTH: Final = 0.12  #: [m] of the axes of a joint whose orientation was observed as a whole
_SHORT: Final = 0.45  # Relative length of the axes of other joints
_FAINT: Final = 0.35  # Opacity of a segment that is not valid


class SegmentSolids(NamedTuple):
    """Place and size of the solid of each segment, in its link frame."""

    centers: Array  #: (J, 3) m from the joint
    R_bone_solid: Array  #: (J, 3, 3); the solid's z axis is along the bone
    sizes: Array  #: (J, 3) m, half thickness in x and y, half length in z


def segment_solids(skeleton: SkeletonModel) -> SegmentSolids:
    """Return the solids of a person's segments, of the thickness in the skeleton's table."""
    centers, turns, sizes = [], [], []
    for joint in skeleton.table.joints:
        along = so3.unit(joint.end)
        length = float(np.linalg.norm(joint.end))
        middle = abs(joint.end[1]) < 1e-3 and not joint.name.startswith(("Left", "Right"))
        depth, width = _TRUNK if middle else (1.0, 1.0)
        centers.append(joint.end / 2)
        turns.append(so3.minimal_rotation(np.array([0.0, 0.0, 1.0]), along))
        sizes.append([depth * joint.radius, width * joint.radius, _LONGER * length / 2])
    return SegmentSolids(np.array(centers), np.array(turns), np.array(sizes))


@dataclass(frozen=True)
class Ellipsoids:
    """95 % regions of the joint positions of a block."""

    quat_wxyz: NDArray[np.float32]  #: (n, J, 4) orientations in world
    sizes: NDArray[np.float32]  #: (n, J, 3) semi-axes, m; 0 where there is none
    left_out: NDArray[np.int_]  #: (n,) number of joints whose position is unknown by more than `LARGEST_SEMI_AXIS`


@dataclass(frozen=True)
class BlockContent:
    """Solids, axes and colours of the segments in the frames of a block."""

    start: int  #: First frame
    p_root: Array  #: (n, 3) m in world; NaN where missing
    centers: NDArray[np.float32]  #: (n, J, 3) m in world, of the solids
    solids_wxyz: NDArray[np.float32]  #: (n, J, 4) orientations of the solids
    shown: NDArray[np.float32]  #: (n, J) 1 where there is a pose, 0 where there is none
    colours: NDArray[np.uint8]  #: (n, J, 3) RGB of the segments
    opacities: NDArray[np.float32]  #: (n, J) 1 where valid
    p_joint: NDArray[np.float32]  #: (n, J, 3) m in world; 0 where missing
    joints_wxyz: NDArray[np.float32]  #: (n, J, 4) orientations of the segments
    axes: NDArray[np.float32]  #: (n, J) length of the axes relative to `AXES_LENGTH`; 0 where there is none
    in_world: Ellipsoids | None = None  #: Of positions in world
    to_root: Ellipsoids | None = None  #: Of positions relative to the root


def block_content(
    poses: PoseSequence, skeleton: SkeletonModel, start: int = 0, confidence: Confidence | None = None
) -> BlockContent:
    """Return what is drawn of a block.

    `poses`: of the block; joints of the skeleton that they do not have are missing. start: first frame of the block.
    """
    poses, solids = with_joints_of(poses, skeleton), segment_solids(skeleton)
    p, R = poses.p_world_joint, poses.R_world_bone
    finite: Mask = np.asarray(np.isfinite(p).all(axis=-1))
    there: Mask = finite & np.asarray(np.isfinite(R).all(axis=(-2, -1)))
    R = np.where(there[..., None, None], R, np.eye(3))
    p = np.where(finite[..., None], p, 0.0)
    levels = segment_levels(poses, skeleton) if poses.provenance.any() else np.full(there.shape, WHOLE)
    return BlockContent(
        start=start,
        p_root=poses.p_world_joint[:, 0],
        centers=_float(p + np.einsum("njik,jk->nji", R, solids.centers)),
        solids_wxyz=_quaternions(R @ solids.R_bone_solid),
        shown=_float(there),
        colours=PALETTE[segment_provenance(poses, skeleton)],
        opacities=_float(np.where(poses.valid, 1.0, _FAINT)),
        p_joint=_float(p),
        joints_wxyz=_quaternions(R),
        axes=_float(there * np.where(levels == WHOLE, 1.0, _SHORT)),
        in_world=None if confidence is None else ellipsoids(confidence.position_covariance, finite),
        to_root=None if confidence is None else ellipsoids(confidence.relative_covariance, finite),
    )


def segment_provenance(poses: PoseSequence, skeleton: SkeletonModel) -> NDArray[np.uint8]:
    """Return the `Provenance` (T, J) of each segment: that of the weakest of its joint and the next ones.

    A segment whose direction was not observed, although its joint was, has that of the prior. One whose whole
    orientation was observed needs no other joint.
    """
    own = np.array(poses.provenance)
    if not own.any():
        return own
    out, levels = own.copy(), segment_levels(poses, skeleton)
    for j in range(len(skeleton.names)):
        children = kinematics.children_of(skeleton.parents, j)
        ends = own[:, [j, *children]].min(axis=1)
        out[:, j] = np.where(levels[:, j] == WHOLE, own[:, j], ends)
    several = np.array([len(kinematics.children_of(skeleton.parents, j)) > 1 for j in range(own.shape[1])])
    unseen = (levels < DIRECTION) & ~several & (out >= Provenance.IMU)
    return np.where(unseen, Provenance.PRIOR, out).astype(np.uint8)


def with_joints_of(poses: PoseSequence, skeleton: SkeletonModel) -> PoseSequence:
    """Return poses of all joints of a skeleton in its order, with orientations wherever they follow.

    `poses`: of some of its joints, e.g. of motion capture; others are left out. skeleton: see above.
    """
    if poses.names != skeleton.names:
        poses = _reordered(poses, skeleton)
    R = poses.R_world_bone
    missing: Mask = np.asarray(np.isnan(R).any(axis=(-2, -1)))
    if not missing.any():
        return poses
    p = poses.p_world_joint
    by_points = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    return replace(poses, R_world_bone=np.where(missing[..., None, None], by_points, R))


def _reordered(poses: PoseSequence, skeleton: SkeletonModel) -> PoseSequence:
    own = [poses.names.index(name) if name in poses.names else -1 for name in skeleton.names]  # -1: what is added

    def of_skeleton(values: NDArray[Any], missing: float = 0) -> NDArray[Any]:
        return np.concatenate([values, np.full_like(values[:, :1], missing)], axis=1)[:, own]

    p, R = of_skeleton(poses.p_world_joint, np.nan), of_skeleton(poses.R_world_bone, np.nan)
    flags = map(of_skeleton, (poses.provenance, poses.valid, poses.orientation_observed, poses.direction_observed))
    return PoseSequence(poses.times, p, R, skeleton.names, *flags)


def ellipsoids(covariance: Array, finite: Mask) -> Ellipsoids:
    """Return the 95 % ellipsoids of positions.

    `covariance`: (n, J, 3, 3) m^2; NaN where unknown. finite: (n, J) whether there is a position.
    """
    known: Mask = np.asarray(np.isfinite(covariance).all(axis=(-2, -1))) & finite
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], covariance, np.eye(3)))
    sizes = QUANTILE_95 * np.sqrt(np.maximum(values, 0.0))
    vectors = vectors * np.sign(np.linalg.det(vectors))[..., None, None]
    large = known & (sizes.max(axis=-1) > LARGEST_SEMI_AXIS)
    sizes = np.where((known & ~large)[..., None], sizes, 0.0)
    return Ellipsoids(_quaternions(vectors), _float(sizes), np.count_nonzero(large, axis=1))


def _quaternions(R: Array) -> NDArray[np.float32]:
    return _float(so3.to_quat_wxyz(R))


def _float(array: Array | Mask) -> NDArray[np.float32]:
    return np.asarray(array, dtype=np.float32)
