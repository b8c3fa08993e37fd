"""Ground truth of Total Capture in this package's frames.

World: the dataset's is y up, ours is z up: (x, y, z) -> (x, -z, y). Segments: in the T-pose the dataset's
are x to the subject's right, y backward, z down, ours x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.total_capture import read_joints

RATE_HZ = 60.0
_INCH: Final = 0.0254
WORLD_OF_VICON = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from the dataset's y-up world to the z-up one."""
SEGMENT_OF_BONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
"""Rotation from a bone (link) frame to the dataset's segment frame; its own inverse."""
RIGID_MM = 1.0  #: Largest spread of joint offsets of a rigid skeleton, mm
_LENGTH_DIFFERENCE: Final = 5  #: Largest difference in length of files of one take, frames; the shorter one counts
_GLITCHES = {
    ("S3", "freestyle1"): ((1936, 1961),),
    ("S4", "acting3"): ((655, 659), (2300, 2306)),
    ("S2", "acting2"): ((2124, 2129),),
}
"""First and last frames of glitches of the reference, by take."""
_MARGIN = 2  #: Frames beside a glitch that are invalid too


@dataclass(frozen=True)
class Truth:
    """Ground truth of a take."""

    poses: PoseSequence
    joint_offsets: Array  #: (J, 3) each joint in its parent's link frame, m
    spread_mm: float  #: Largest standard deviation of an offset over the take, mm; NaN for derived orientations
    notes: tuple[str, ...]


def read_truth(take: tuple[str, str], positions: Path, orientations: Path | None) -> Truth:
    """Read positions and orientations of a take; without orientations they are derived from the positions.
    `FileFormatError`: damaged or contradicting files, wrong joints, or quaternions not in order x y z w.
    """
    skeleton, notes = SkeletonModel.default(), list[str]()
    p = _INCH * _positions(positions, skeleton, notes) @ WORLD_OF_VICON.T
    R = None if orientations is None else _orientations(orientations, skeleton, notes)
    if orientations is None or R is None:
        offsets, spread = _offsets_by_length(p, skeleton, notes), np.nan
        R = kinematics.rotations_from_positions(skeleton.parents, offsets, p)
    else:
        p, R = _same_length(orientations, p, R, notes)
        offsets, spread = _offsets(skeleton.parents, p, R)
        if spread > RIGID_MM:
            raise FileFormatError(orientations, _why_not_rigid(spread))
    observed = np.full(len(skeleton.names), np.isfinite(spread))
    poses = PoseSequence(
        np.arange(len(p)) / RATE_HZ, p, R, skeleton.names, valid=_valid(take, p, notes), orientation_observed=observed
    )
    return Truth(poses, offsets, float(spread), tuple(notes))


def _ordered(path: Path, width: int, skeleton: SkeletonModel, notes: list[str]) -> Array:
    """Read a table's values (T, J, width) in the skeleton's order of joints."""
    table = read_joints(path, width)
    if absent := [name for name in skeleton.names if name not in table.names]:
        raise FileFormatError(path, f"has no joint {', '.join(absent)}; its joints are {', '.join(table.names)}", 1)
    if further := [name for name in table.names if name not in skeleton.names]:
        notes.append(f"joints of {path.name} that the skeleton does not have: {', '.join(further)}")
    return table.values[:, indices_of("joint", skeleton.names, table.names)]


def _positions(path: Path, skeleton: SkeletonModel, notes: list[str]) -> Array:
    """Read positions (T, J, 3), NaN in frames of zeros."""
    p = _ordered(path, 3, skeleton, notes).copy()
    absent = ~p.any(axis=(1, 2))
    if absent.any() and not absent.all():
        notes.append(f"{int(absent.sum())} frames of zeros in {path.name}: unknown")
        p[absent] = np.nan
    return p


def _orientations(path: Path, skeleton: SkeletonModel, notes: list[str]) -> Array | None:
    """Read R_world_bone (T, J, 3, 3), NaN where the file has zeros; None if it has only zeros."""
    quat_wxyz = np.roll(_ordered(path, 4, skeleton, notes), 1, axis=-1)
    R_vicon_segment, absent = rotations_of(path, quat_wxyz, skeleton.names)
    if absent.all():
        notes.append(f"{path.name} holds no orientation at all")
        return None
    if absent.any():
        count = int(absent.any(axis=1).sum())
        notes.append(f"{count} frames have joints without an orientation in {path.name}: unknown")
    return np.asarray(WORLD_OF_VICON @ R_vicon_segment @ SEGMENT_OF_BONE)


def rotations_of(path: Path, quat_wxyz: Array, names: Sequence[str]) -> tuple[Array, Mask]:
    """Return rotations (T, S, 3, 3) of quaternions (T, S, 4), NaN where a file has zeros, and where that is (T, S).
    `FileFormatError`: a quaternion is neither zero nor of norm 1.
    """
    norm = np.linalg.norm(quat_wxyz, axis=-1)
    absent = norm < 1e-6
    wrong = ~absent & (np.abs(norm - 1) > 0.01)
    if wrong.any():
        frame, one = np.argwhere(wrong)[0]
        raise FileFormatError(
            path, f"frame {frame + 1}: the quaternion of {names[one]} has norm {norm[frame, one]:.3g}, not 1"
        )
    R = so3.from_quat_wxyz(np.where(absent[..., None], [1.0, 0, 0, 0], quat_wxyz))
    R[absent] = np.nan
    return R, np.asarray(absent)


def _offsets(parents: tuple[int, ...], p: Array, R: Array) -> tuple[Array, float]:
    """Return the mean of each joint in its parent's frame (J, 3), m, and the largest spread, mm."""
    joints, above = np.arange(1, len(parents)), list(parents[1:])
    local = np.einsum("tjba,tjb->tja", R[:, above], p[:, joints] - p[:, above])
    known = np.isfinite(local).all(axis=-1, keepdims=True)
    count = known.sum(axis=0)
    offsets = np.zeros((len(parents), 3))
    if not count.all():
        return offsets, np.inf
    offsets[1:] = np.where(known, local, 0.0).sum(axis=0) / count
    variance = np.where(known, local - offsets[1:], 0.0) ** 2
    return offsets, float(1000 * np.sqrt(variance.sum(axis=0) / count).max())


def _why_not_rigid(spread_mm: float) -> str:
    if np.isinf(spread_mm):
        return "there is no frame in which a joint's position and its parent's orientation are known"
    return (
        f"the skeleton is not rigid: joints move by {spread_mm:.3g} mm in their parents' frames. Are positions and "
        "orientations of different takes, or quaternions w x y z? This file has x y z w"
    )


def _same_length(path: Path, p: Array, R: Array, notes: list[str]) -> tuple[Array, Array]:
    """Cut both to the shorter where they differ by a few frames."""
    if len(p) != len(R):
        text = f"{len(p)} frames of positions and {len(R)} of orientations"
        if abs(len(p) - len(R)) > _LENGTH_DIFFERENCE:
            raise FileFormatError(path, f"{text}: one file is cut off or of another take; fetch and unpack both again")
        notes.append(f"{text}: the shorter counts")
    count = min(len(p), len(R))
    return p[:count], R[:count]


def _offsets_by_length(p: Array, skeleton: SkeletonModel, notes: list[str]) -> Array:
    """Return offsets for positions only: the package's skeleton, scaled to these bones."""
    notes.append("no orientations: derived from the positions, twist unknown, with the package's skeleton scaled")
    lengths = np.nanmedian(np.linalg.norm(p[:, 1:] - p[:, list(skeleton.parents[1:])], axis=-1), axis=0)
    return skeleton.with_bone_lengths(dict(zip(skeleton.names[1:], map(float, lengths), strict=True))).joint_offsets


def _valid(take: tuple[str, str], p: Array, notes: list[str]) -> Mask:
    """Return validity (T, J), False in known glitches."""
    valid: Mask = np.asarray(np.isfinite(p).all(axis=-1))
    for first, last in _GLITCHES.get(take, ()):
        valid[max(first - _MARGIN, 0) : last + _MARGIN + 1] = False
        if first - _MARGIN < len(p):
            notes.append(f"frames {first} to {last} are a glitch of the reference: not valid")
    return valid
