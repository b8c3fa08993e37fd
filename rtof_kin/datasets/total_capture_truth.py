"""Total Capture's ground truth in this package's frames, from whichever of its files there are.

World: the dataset's is y up, ours is z up: (x, y, z) -> (x, -z, y). Segments: in the T-pose the dataset's
are x to the subject's right, y backward, z down, ours x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.checks import indices_of
from rtof_kin.errors import FileFormatError, UnknownNameError
from rtof_kin.io.bvh import read_bvh
from rtof_kin.io.total_capture import JointTable, read_joints
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import PoseSequence

Array = NDArray[np.float64]
RATE_HZ = 60.0
INCH = 0.0254
WORLD_OF_VICON = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from the dataset's y-up world to the z-up one."""
SEGMENT_OF_BONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
"""Rotation from a bone (link) frame to the dataset's segment frame; its own inverse."""
RIGID_MM = 1.0
"""A skeleton whose offsets spread more than this was read wrongly."""
_SAME_MM = 5.0
_LENGTH_DIFFERENCE = 5
_GLITCHES = {
    ("S3", "freestyle1"): ((1936, 1961),),
    ("S4", "acting3"): ((655, 659), (2300, 2306)),
    ("S2", "acting2"): ((2124, 2129),),
}
"""Frames in which the reference itself jumps, first and last."""
_MARGIN = 2
"""Frames beside a glitch that are left out too, as differences reach across."""


@dataclass(frozen=True)
class Truth:
    """The ground truth of a take."""

    poses: PoseSequence
    joint_offsets: Array
    """(J, 3) each joint in its parent's link frame, m, in this take."""
    spread_mm: float
    """Largest standard deviation of an offset over the take: 0 for a rigid skeleton; NaN if the
    orientations were derived from the positions."""
    notes: tuple[str, ...]


def read_truth(
    take: tuple[str, str],
    find: Callable[[str], Path | None],
    offsets_of_others: Callable[[], list[Array]],
) -> Truth | None:
    """Positions and orientations of a take; None where there are neither positions nor a BVH file.

    Args:
        take: subject and take. find: the take's file of a kind, or None.
        offsets_of_others: offsets of other takes of the subject, for a take without orientations.

    Raises:
        FileFormatError: a file is damaged, its joints are wrong, files disagree, or the quaternions are
            in another order than x y z w.
    """
    skeleton = SkeletonModel.default()
    positions, orientations, bvh = find("positions"), find("orientations"), find("bvh")
    notes: list[str] = []
    p = R = None
    if positions is not None:
        p = INCH * _ordered(positions, read_joints(positions, 3), skeleton.names) @ WORLD_OF_VICON.T
    if orientations is not None:
        quat = _ordered(orientations, read_joints(orientations, 4), skeleton.names)
        R = _bone_rotations(orientations, quat, notes)
    if (p is None or R is None) and bvh is not None:
        p, R = _from_bvh(bvh, p, R, skeleton, notes)
    if p is None:
        return None
    observed: NDArray[np.bool_] = np.ones(len(skeleton.names), dtype=bool)
    spread = np.nan
    if R is None:
        offsets = _offsets_by_length(p, skeleton, offsets_of_others, notes)
        R = kinematics.rotations_from_positions(skeleton.parents, offsets, p)
        observed = skeleton.orientation_observed()
    else:
        p, R = _same_length(positions or bvh, p, R, notes)
        offsets, spread = _offsets(skeleton.parents, p, R)
        if spread > RIGID_MM:
            raise FileFormatError(
                orientations or bvh or Path(), _why_not_rigid(p, R, skeleton, spread)
            )
    poses = PoseSequence(
        np.arange(len(p)) / RATE_HZ, p, R, skeleton.names,
        valid=_valid(take, p, notes), orientation_observed=observed,
    )  # fmt: skip
    return Truth(poses, offsets, float(spread), tuple(notes))


def bone_rotations(R_vicon_segment: Array) -> Array:
    """R_world_bone (..., 3, 3) of the dataset's segment orientations."""
    return np.asarray(WORLD_OF_VICON @ R_vicon_segment @ SEGMENT_OF_BONE)


def _ordered(path: Path, table: JointTable, names: tuple[str, ...]) -> Array:
    """Values in the skeleton's order of joints."""
    try:
        index = indices_of("joint", names, table.names)
    except UnknownNameError as error:
        raise FileFormatError(path, f"a joint is missing: {error}", 1) from error
    return table.values[:, index]


def _bone_rotations(path: Path, quat_xyzw: Array, notes: list[str]) -> Array:
    norm = np.linalg.norm(quat_xyzw, axis=-1)
    absent = ~np.isfinite(norm) | (norm < 1e-6)
    wrong = ~absent & (np.abs(norm - 1) > 0.01)
    if wrong.any():
        frame, joint = np.argwhere(wrong)[0]
        raise FileFormatError(
            path, f"the quaternion of joint {joint + 1} has norm {norm[frame, joint]:.3g}, not 1",
            int(frame) + 2,
        )  # fmt: skip
    if absent.any():
        count = int(absent.any(axis=1).sum())
        notes.append(f"{count} frames have no orientation in {path.name}: left open")
    quat_wxyz = np.where(absent[..., None], [1.0, 0, 0, 0], np.roll(quat_xyzw, 1, axis=-1))
    R = bone_rotations(so3.from_quat_wxyz(quat_wxyz))
    R[absent] = np.nan
    return R


def _offsets(parents: tuple[int, ...], p: Array, R: Array) -> tuple[Array, float]:
    """Mean of each joint in its parent's frame (J, 3), m, and the largest spread, mm."""
    joints, above = np.arange(1, len(parents)), list(parents[1:])
    bones = p[:, joints] - p[:, above]
    local = np.einsum("tjba,tjb->tja", R[:, above], bones)
    whole: NDArray[np.bool_] = np.asarray(np.isfinite(local).all(axis=(1, 2)))
    local = local[whole]
    offsets = np.zeros((len(parents), 3))
    if not len(local):
        return offsets, np.inf
    offsets[1:] = local.mean(axis=0)
    return offsets, float(1000 * local.std(axis=0).max())


def _why_not_rigid(p: Array, R: Array, skeleton: SkeletonModel, spread_mm: float) -> str:
    """The likely reason why joints do not keep their place in their parents' frames."""
    text = f"the skeleton is not rigid: offsets spread by {spread_mm:.0f} mm. "
    known: NDArray[np.bool_] = np.asarray(np.isfinite(R).all(axis=(2, 3)))
    segment = WORLD_OF_VICON.T @ np.where(known[..., None, None], R, np.eye(3)) @ SEGMENT_OF_BONE
    wrong = so3.to_quat_wxyz(segment)  # what stood there was read as x y z w
    as_wxyz = bone_rotations(so3.from_quat_wxyz(np.roll(wrong, -1, axis=-1)))
    if _offsets(skeleton.parents, p, as_wxyz)[1] < RIGID_MM:
        return text + "It would be if the quaternions stood there as w x y z: write them as x y z w"
    return text + "Positions and orientations are probably of different takes"


def _same_length(path: Path | None, p: Array, R: Array, notes: list[str]) -> tuple[Array, Array]:
    """Both cut to the shorter where they differ by a few frames."""
    if len(p) != len(R):
        if abs(len(p) - len(R)) > _LENGTH_DIFFERENCE:
            raise FileFormatError(
                path or Path(), f"{len(p)} frames of positions and {len(R)} of orientations: one of "
                "the files is cut off or of another take",
            )  # fmt: skip
        notes.append(
            f"{len(p)} frames of positions, {len(R)} of orientations: the shorter is taken"
        )
    count = min(len(p), len(R))
    return p[:count], R[:count]


def _from_bvh(
    path: Path, p: Array | None, R: Array | None, skeleton: SkeletonModel, notes: list[str]
) -> tuple[Array, Array]:
    """What is missing of positions and orientations, from the take's BVH file.

    The frames of its joints are one constant rotation away from ours: the one that brings its offsets
    nearest to the skeleton's (for the dataset's own files, that of its segment frames).
    """
    motion = read_bvh(path)
    try:
        index = indices_of("joint", skeleton.names, motion.names)
    except UnknownNameError as error:
        raise FileFormatError(path, f"a joint is missing: {error}") from error
    theirs, ours = motion.offsets[index][1:], skeleton.joint_offsets[1:]
    R_file_bone = so3.nearest_rotation(theirs.T @ ours)
    quarter_turns = np.round(R_file_bone)
    if so3.is_rotation(quarter_turns) and so3.angle_between(R_file_bone, quarter_turns) < 0.18:
        R_file_bone = quarter_turns
    p_file, R_file = motion.forward_kinematics()
    p_bvh = INCH * p_file[:, index] @ WORLD_OF_VICON.T
    if p is not None:
        count = min(len(p), len(p_bvh))
        apart = 1000 * np.linalg.norm(p[:count] - p_bvh[:count], axis=-1)
        if np.median(apart) > _SAME_MM:
            raise FileFormatError(
                path, f"its joints are {np.median(apart):.0f} mm (median) away from those in the "
                "take's positions: a file of another take?",
            )  # fmt: skip
    if p is None:
        notes.append(f"positions from {path.name}")
        p = p_bvh
    if R is None:
        notes.append(f"orientations from {path.name}")
        R = WORLD_OF_VICON @ R_file[:, index] @ R_file_bone
    return p, R


def _offsets_by_length(
    p: Array, skeleton: SkeletonModel, others: Callable[[], list[Array]], notes: list[str]
) -> Array:
    """Offsets for a take that has positions alone: another take's of equal bones, else scaled ones."""
    above = list(skeleton.parents[1:])
    lengths = np.median(np.linalg.norm(p[:, 1:] - p[:, above], axis=-1), axis=0)
    for offsets in others():
        if np.abs(np.linalg.norm(offsets[1:], axis=-1) - lengths).max() < 0.001:
            notes.append(
                "no orientations: derived from the positions, with the offsets of another take of this "
                "subject with the same bones; twist is not known"
            )
            return offsets
    notes.append(
        "no orientations: derived from the positions, with the usual skeleton scaled to the bones; "
        "twist is not known"
    )
    names = skeleton.names[1:]
    return skeleton.with_bone_lengths(
        dict(zip(names, map(float, lengths), strict=True))
    ).joint_offsets


def _valid(take: tuple[str, str], p: Array, notes: list[str]) -> NDArray[np.bool_]:
    """(T, J) False where the reference is known to jump."""
    valid: NDArray[np.bool_] = np.asarray(np.isfinite(p).all(axis=-1))
    for first, last in _GLITCHES.get(take, ()):
        valid[max(first - _MARGIN, 0) : last + _MARGIN + 1] = False
        if first < len(p):
            notes.append(f"frames {first} to {last} are a glitch of the reference: not scored")
    return valid
