"""A motion as other programs know it: points in space, a tree of joints, stretches without gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.observability import observed_dofs, observed_landmarks, root_turn_observed
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import ShapeError
from rtof_kin.core.signals import runs
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.world_axes import METRES, world_of_file

Array = NDArray[np.float64]
MOST_UNEVEN = 0.02
"""Frames that a time may lie beside the even grid where a format has none of its own."""


def pieces(motion: MotionSequence) -> list[tuple[int, int]]:
    """Frames [start, stop) of the stretches in which the person was seen, for formats without gaps.

    A frame belongs to a gap where its configuration is not known, or where no joint of it is valid:
    what stands there was bridged, though sensors may have felt their bones turn.
    """
    return runs(np.isfinite(motion.q).all(axis=1) & motion.poses.valid.any(axis=1))


def from_prior(motion: MotionSequence) -> dict[str, float]:
    """Joints that nobody saw in some frames that are in no gap -> the share of those frames, 0 to 1.

    Where they are a prior or their neighbours say, though a sensor may have felt their segments turn.
    """
    return _shares(motion, motion.poses.names, motion.poses.position_observed)


def dofs_from_prior(motion: MotionSequence) -> dict[str, float]:
    """The same of degrees of freedom by their URDF names, and of the root's orientation, `BASE_TURN`."""
    observed = np.column_stack([root_turn_observed(motion), observed_dofs(motion)])
    return _shares(motion, (BASE_TURN, *motion.skeleton.dof_names), observed)


def landmarks_from_prior(motion: MotionSequence) -> dict[str, float]:
    """The same of landmarks that are no joints, as heels are where nobody saw the foot turn."""
    shares = _shares(motion, tuple(motion.skeleton.landmarks), observed_landmarks(motion))
    return {name: share for name, share in shares.items() if name not in motion.poses.names}


def _shares(motion: MotionSequence, names: tuple[str, ...], observed: NDArray[np.bool_]) -> dict[str, float]:
    """Which were not observed in some frames that are in no gap, and in what share of those."""
    inside = [~observed[start:stop] for start, stop in pieces(motion)]
    shares = np.concatenate(inside).mean(axis=0) if inside else np.zeros(len(names))
    return {name: float(share) for name, share in zip(names, shares, strict=True) if share > 0}


def check_known(motion: MotionSequence) -> None:
    """Raise `ShapeError` where a configuration is not known, for formats that have no gaps."""
    unknown = np.flatnonzero(~np.isfinite(motion.q).all(axis=1))
    if len(unknown):
        raise ShapeError(
            f"motion: frame {unknown[0]} is not known, which this format cannot say; write each of its "
            "`pieces` to a file"
        )


def even_times(times: Array) -> Array:
    """The even times (T,), s, that measured ones stand for; they differ by `MOST_UNEVEN` frames at most.

    Raises:
        ShapeError: they are more uneven than that.
    """
    times = checked_times("motion times", times)
    even, step = np.linspace(times[0], times[-1], len(times), retstep=True)
    off = np.abs(times - even)
    if len(times) > 1 and off.max() > MOST_UNEVEN * step:
        frame = int(off.argmax())
        raise ShapeError(
            f"motion times: frame {frame} is {1000 * off[frame]:.1f} ms beside even times, which .mot, "
            ".sto, .trc, .c3d and .bvh need; resample the motion, or write csv, parquet or ros"
        )
    return np.asarray(even)


def landmark_markers(motion: MotionSequence) -> MarkerSequence:
    """All landmarks of the skeleton, joints first, as markers; NaN where nobody saw them."""
    poses, skeleton = motion.poses, motion.skeleton
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    p = np.where(observed_landmarks(motion)[..., None], p, np.nan)
    return MarkerSequence(poses.times, tuple(skeleton.landmarks), p)


def joint_tree(motion: MotionSequence, *, up: str = "y", unit: str = "cm") -> ArticulatedMotion:
    """The skeleton as a tree in the axes and unit of such files, with end sites at its leaves' far ends.

    Args:
        up: the axis that shall point up, see `rtof_kin.formats.world_axes.UP`: with y, who faces world x
            faces z, as in most such files. unit: m, cm or mm.

    Raises:
        ShapeError: a frame is not known, times are uneven, or there is no such axis or unit.
    """
    if unit not in METRES:
        raise ShapeError(f"unit: {unit!r}; give one of {', '.join(METRES)}")
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
