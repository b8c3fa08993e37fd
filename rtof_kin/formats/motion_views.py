"""Views of a motion for other programs: markers, a tree of joints, pieces without gaps, unobserved parts."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.observability import observed_dofs, observed_landmarks, root_turn_observed
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.signals import runs
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.world_axes import METRES, world_of_file

MOST_UNEVEN: Final = 0.02
"""Largest deviation of a time from an even grid, frames, in formats without times."""


def pieces(motion: MotionSequence) -> list[tuple[int, int]]:
    """Return frames [start, stop) of the runs in which the person was seen, for formats without gaps.

    A frame is in a gap where its configuration is unknown or no joint is valid (it was bridged).
    """
    return runs(outside_gaps(motion))


def outside_gaps(motion: MotionSequence) -> Mask:
    """Return a mask (T,) of the frames of `pieces`."""
    return np.asarray(np.isfinite(motion.q).all(axis=1) & motion.poses.valid.any(axis=1))


def from_prior(motion: MotionSequence) -> dict[str, float]:
    """Return joints whose position was unobserved outside gaps -> the share of those frames, 0 to 1."""
    return _shares(motion, motion.poses.names, motion.poses.position_observed)


def dofs_from_prior(motion: MotionSequence) -> dict[str, float]:
    """Return the same shares of degrees of freedom by URDF name, and of the root's orientation."""
    return _shares(motion, root_and_dof_names(motion.skeleton), root_and_dofs_observed(motion))


def root_and_dof_names(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return names of the root's orientation and of the D degrees of freedom."""
    return (BASE_TURN, *skeleton.dof_names)


def root_and_dofs_observed(motion: MotionSequence) -> Mask:
    """Return a mask (T, 1 + D) of what was observed, in the order of `root_and_dof_names`."""
    return np.column_stack([root_turn_observed(motion), observed_dofs(motion)])


def landmarks_from_prior(motion: MotionSequence) -> dict[str, float]:
    """Return the same shares of landmarks that are no joints, e.g. heels."""
    shares = _shares(motion, tuple(motion.skeleton.landmarks), observed_landmarks(motion))
    return {name: share for name, share in shares.items() if name not in motion.poses.names}


def _shares(motion: MotionSequence, names: tuple[str, ...], observed: Mask) -> dict[str, float]:
    inside = ~observed[outside_gaps(motion)]
    shares = inside.mean(axis=0) if len(inside) else np.zeros(len(names))
    return {name: float(share) for name, share in zip(names, shares, strict=True) if share > 0}


def check_known(motion: MotionSequence) -> None:
    """Raise `InvalidInputError` where a configuration is unknown, for formats without gaps."""
    unknown = np.flatnonzero(~np.isfinite(motion.q).all(axis=1))
    if len(unknown):
        raise InvalidInputError(
            f"motion: frame {unknown[0]} is not known, and this format has no gaps; write each of its "
            "`pieces` to a file"
        )


def even_times(times: Array) -> Array:
    """Return the even grid (T,), s, nearest to measured times.

    Args:
        times: (T,) s.

    Raises:
        InvalidInputError: a time is more than `MOST_UNEVEN` frames beside the grid.
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


def landmark_markers(motion: MotionSequence) -> MarkerSequence:
    """Return all landmarks of the skeleton, joints first, as markers; NaN where unobserved."""
    poses, skeleton = motion.poses, motion.skeleton
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    p = np.where(observed_landmarks(motion)[..., None], p, np.nan)
    return MarkerSequence(poses.times, tuple(skeleton.landmarks), p)


def joint_tree(motion: MotionSequence, *, up: str = "y", unit: str = "cm") -> ArticulatedMotion:
    """Return the skeleton as a tree of joints, with end sites at the far ends of its leaves.

    Args:
        motion: poses without unknown frames, at even times.
        up: the axis that points up, see `world_axes.UP`; with y, a person who faces world x faces z.
        unit: m, cm or mm.

    Raises:
        InvalidInputError: a frame is unknown, times are uneven, or unknown axis or unit.
    """
    if unit not in METRES:
        raise InvalidInputError(f"unit: {unit!r}; give one of {', '.join(METRES)}")
    check_known(motion)
    skeleton, R_world_file = motion.skeleton, world_of_file(up)
    leaves = [j for j in range(len(skeleton.names)) if j not in skeleton.parents]
    R_parent_joint = kinematics.local_rotations(skeleton.parents, motion.poses.R_world_bone)
    times = even_times(motion.times)

    def in_file(vectors: Array) -> Array:
        return np.asarray(vectors @ R_world_file / METRES[unit])

    return ArticulatedMotion(
        names=skeleton.names,
        parents=skeleton.parents,
        offsets=in_file(skeleton.joint_offsets),
        R_parent_joint=R_world_file.T @ R_parent_joint @ R_world_file,
        p_root=in_file(motion.q[:, :3]),
        rate_hz=(len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 60.0,
        unit_m=METRES[unit],
        end_parents=tuple(leaves),
        end_offsets=in_file(np.array([skeleton.table.joints[j].end for j in leaves])),
    )
