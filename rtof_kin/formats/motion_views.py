"""Views of a motion for other programs: markers, a tree of joints, pieces without gaps, unobserved parts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks, observed_dofs, observed_landmarks, root_turn_observed
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.signals import runs
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.markers import MarkerBlocks
from rtof_kin.formats.world_axes import METRES, UP, world_of_file

AnyMotion = Motion | MotionSource
MOST_UNEVEN: Final = 0.02  #: Largest deviation of a time from an even grid, frames, in formats without times


def pieces(motion: AnyMotion) -> list[tuple[int, int]]:
    """Return frames [start, stop) of the runs in which the person was seen, for formats without gaps.

    A frame is in a gap where its configuration is unknown or no joint is valid (it was bridged).
    """
    return runs(outside_gaps(MotionSource.of(motion).masks))


def outside_gaps(masks: ObservationMasks) -> Mask:
    """Return a mask (T,) of the frames of `pieces`."""
    return np.asarray(masks.known & masks.valid.any(axis=1))


def shares_from_prior(motion: AnyMotion) -> dict[str, dict[str, float]]:
    """Return what was unobserved outside gaps -> the share of those frames, 0 to 1: of joints (`from_prior`), of
    landmarks that are no joints, e.g. heels (`landmarks_from_prior`), and of the root's orientation and degrees of
    freedom by URDF name (`dofs_from_prior`).
    """
    masks = MotionSource.of(motion).masks
    skeleton, inside = masks.skeleton, outside_gaps(masks)
    beside = len(skeleton.names)  # landmarks are the joints first
    observed = {
        "from_prior": (skeleton.names, masks.position_observed),
        "landmarks_from_prior": (tuple(skeleton.landmarks)[beside:], observed_landmarks(masks)[:, beside:]),
        "dofs_from_prior": (root_and_dof_names(skeleton), root_and_dofs_observed(masks)),
    }
    return {
        kind: {
            name: float(share)
            for name, share in zip(names, np.sum(~mask[inside], axis=0) / max(inside.sum(), 1), strict=True)
            if share > 0
        }
        for kind, (names, mask) in observed.items()
    }


def root_and_dof_names(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return names of the root's orientation and of the D degrees of freedom."""
    return (BASE_TURN, *skeleton.dof_names)


def root_and_dofs_observed(masks: ObservationMasks) -> Mask:
    """Return a mask (T, 1 + D) of what was observed, in the order of `root_and_dof_names`."""
    return np.column_stack([root_turn_observed(masks), observed_dofs(masks)])


def check_known(motion: AnyMotion) -> None:
    """Raise `InvalidInputError` where a configuration is unknown, for formats without gaps."""
    unknown = np.flatnonzero(~MotionSource.of(motion).masks.known)
    if len(unknown):
        raise InvalidInputError(
            f"motion: frame {unknown[0]} is not known, and this format has no gaps; write each of its "
            "`pieces` to a file"
        )


def even_times(times: Array) -> Array:
    """Return the even grid (T,), s, nearest to measured times (T,), s; `InvalidInputError` where one is more than
    `MOST_UNEVEN` frames beside it.
    """
    times = checked_times("motion times", times)
    even, step = np.linspace(times[0], times[-1], len(times), retstep=True)
    off = np.abs(times - even)
    if len(times) > 1 and off.max() > MOST_UNEVEN * step:
        frame = int(off.argmax())
        raise InvalidInputError(
            f"motion times: frame {frame} is {1000 * off[frame]:.1f} ms beside even times, which .mot, "
            ".sto, .trc, .c3d and .bvh need; resample the motion, or write csv, parquet or ros"
        )
    return np.asarray(even)


def landmark_markers(motion: AnyMotion) -> MarkerBlocks:
    """Return all landmarks of the skeleton, joints first, as markers; NaN where unobserved."""
    source = MotionSource.of(motion)

    def blocks() -> Iterator[Array]:
        for block, masks in source.observed_blocks():
            p = source.skeleton.landmark_positions(block.poses.p_world_joint, block.poses.R_world_bone)
            yield np.where(observed_landmarks(masks)[..., None], p, np.nan)

    return MarkerBlocks(source.times, tuple(source.skeleton.landmarks), blocks)


def joint_tree(motion: AnyMotion) -> Iterator[ArticulatedMotion]:
    """Yield the skeleton as a tree of joints in blocks of frames at even times, else `InvalidInputError`, as where a
    frame is unknown, with end sites at the far ends of its leaves. The y axis points up and lengths are in cm, as
    readers of BVH expect; a person who faces world x faces z.
    """
    check_known(motion)
    source, R_world_file = MotionSource.of(motion), world_of_file("y")
    skeleton, times = source.skeleton, even_times(source.times)
    leaves = [j for j in range(len(skeleton.names)) if j not in skeleton.parents]

    def in_file(vectors: Array) -> Array:
        return np.asarray(vectors @ R_world_file / METRES["cm"])

    for block in source.blocks():
        R_parent_joint = kinematics.local_rotations(skeleton.parents, block.motion.poses.R_world_bone)
        yield ArticulatedMotion(
            names=skeleton.names,
            parents=skeleton.parents,
            offsets=in_file(skeleton.joint_offsets),
            R_parent_joint=R_world_file.T @ R_parent_joint @ R_world_file,
            p_root=in_file(block.motion.q[:, :3]),
            rate_hz=float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 60.0,
            unit_m=METRES["cm"],
            end_parents=tuple(leaves),
            end_offsets=in_file(np.array([skeleton.table.joints[j].end for j in leaves])),
        )


# --- LAFAN1 --------------------------------------------------------------------------------------

_FOOT: Final = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T
_LAFAN1: Final = (
    ("", "Hips", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    ("Hips", "LeftUpLeg LeftLeg LeftFoot LeftToe", [[0, 0, -1], [1, 0, 0], [0, -1, 0]]),
    ("Hips", "RightUpLeg RightLeg RightFoot RightToe", [[0, 0, -1], [1, 0, 0], [0, -1, 0]]),
    ("Hips", "Spine Spine1 Spine2 Neck Head", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    ("Spine2", "LeftShoulder LeftArm LeftForeArm LeftHand", [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    ("Spine2", "RightShoulder RightArm RightForeArm RightHand", [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]),
)
"""LAFAN1's chains of joints in the order of its files (Harvey et al., 2020): what they hang on, names, and x, y and z
of their axes in the T-pose, in forward, left and up; x is along the bone. Those of feet and toes are `_FOOT`.
"""
_OURS: Final = {"Spine2": "Spine3", "LeftToe": "LeftToeBase", "RightToe": "RightToeBase"}  #: Our landmarks, if others


def lafan1_tree(motion: MotionSource) -> Iterator[ArticulatedMotion]:
    """Yield a motion on LAFAN1's tree: its 22 joints by name, in its order, and with its axes; else as `joint_tree`.

    Two of the four spine joints are one there: it points to the next joint, whose distance is a constant. Errors as
    `joint_tree`, and `InvalidInputError` for a skeleton that lacks a joint.
    """
    skeleton, above, R_bone_joint = motion.skeleton, dict[str, str](), np.empty((22, 3, 3))
    for start, chain, axes in _LAFAN1:
        for name in chain.split():
            R_bone_joint[len(above)] = np.transpose(axes)
            above[name], start = start, name
    names, marks = tuple(above), [_OURS.get(name, name) for name in above]
    if missing := [name for name in marks if name not in skeleton.landmarks]:
        raise InvalidInputError(f"LAFAN1 needs {', '.join(missing)}, which the skeleton {skeleton.name} does not have")
    parents = tuple(names.index(parent) if parent else -1 for parent in above.values())
    own = skeleton.index(*(skeleton.landmarks[name][0] for name in marks))
    (p_rest,) = skeleton.landmark_positions(*skeleton.forward_kinematics(skeleton.t_pose()[None]))
    p_rest = p_rest[[list(skeleton.landmarks).index(name) for name in marks]]
    bones = p_rest - p_rest[list(parents)]
    for foot in (names.index("LeftFoot"), names.index("RightFoot")):
        R_bone_joint[foot] = so3.minimal_rotation([1.0, 0, 0], bones[foot + 1]) @ _FOOT
        R_bone_joint[foot + 1] = _FOOT
    offsets = np.einsum("jba,jb->ja", R_bone_joint[list(parents)], bones) / METRES["cm"]
    offsets[0], spine, chest = 0.0, names.index("Spine1"), names.index("Spine2")
    for block, tree in zip(motion.blocks(), joint_tree(motion), strict=True):
        R_world_bone = block.motion.poses.R_world_bone[:, own]
        p = block.motion.poses.p_world_joint[:, own]
        upward = np.einsum("tba,tb->ta", R_world_bone[:, spine], p[:, chest] - p[:, spine])
        R_world_bone[:, spine] = R_world_bone[:, spine] @ so3.minimal_rotation(bones[chest], upward)
        R_file_joint = UP["y"].T @ R_world_bone @ R_bone_joint
        turns = kinematics.local_rotations(parents, R_file_joint)
        yield ArticulatedMotion(names, parents, offsets, turns, tree.p_root, tree.rate_hz, tree.unit_m)
