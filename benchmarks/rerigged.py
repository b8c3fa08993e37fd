"""Motion of the held-out people on a rig like Total Capture's, each with a neutral posture of his own.

A stand-in: recordings of that rig may not be used here, and every rig of the free motion bends its trunk as
its software does. What is known of that rig is put on free motion: the proportions and zero pose of the
package's skeleton, scaled to the person; one bend of the trunk, spread evenly over Spine to Spine3 about
constant offsets; clavicles that follow the arms. The offsets are the person's neutral posture, drawn with
the spread that real people of that rig have (5 degrees of pitch for each part of the spine). Pelvis, upper
trunk, head and limbs move as in the original, whose joint centres define them (`body.kinematics.shared_frames`).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import shared_frames
from rtof_kin.body.pose_prior import SPINE
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.simulation.mocap import MocapClip

RIG = "total_capture_like"
SIGMA_BEND_DEG = (1.5, 5.0, 1.5)
"""Spread over people of each part's constant rotation, about x forward, y left, z up."""
CLAVICLE_DEG, SIGMA_CLAVICLE_DEG = (12.0, 0.0), (5.0, 6.0)
"""Mean and spread over people of a clavicle's elevation and protraction with the arm to the side."""
FOLLOWS = (0.25, 0.2)
"""Clavicle's elevation for that of the arm, rad/rad, and its protraction for the arm's direction forward."""
_LOWEST = 0.06  # [m] of a joint over the floor


@dataclass(frozen=True)
class Posture:
    """The neutral posture of a person."""

    bends: Array
    """(4, 3) constant rotations of Spine to Spine3, rad, with sum zero."""
    clavicles: Array
    """(2, 2) elevation and protraction, left and right, with the arm to the side, rad."""

    @classmethod
    def of(cls, subject: str) -> Self:
        """Draw a person's posture; his name is the seed."""
        rng = np.random.default_rng(zlib.crc32(subject.encode()))
        bends = np.radians(rng.normal(0.0, SIGMA_BEND_DEG, (4, 3)))
        clavicles = np.radians(rng.normal(CLAVICLE_DEG, SIGMA_CLAVICLE_DEG, (2, 2)))
        return cls(bends - bends.mean(axis=0), clavicles)


def rerigged(clip: MocapClip) -> MocapClip:
    """The motion of a clip on the other rig, named after it."""
    offsets = _offsets(clip)
    R = _orientations(clip, offsets, clip.poses.R_world_bone)
    parents = SkeletonModel.default().parents
    p = kinematics.positions(parents, offsets, clip.poses.p_world_joint[:, 0], R)
    p[..., 2] += _LOWEST - p[..., 2].min()
    poses = replace(clip.poses, p_world_joint=p, R_world_bone=R)
    return replace(clip, name=f"{clip.name}_tc", poses=poses, joint_offsets=offsets, rig=RIG)


def t_pose(clip: MocapClip) -> dict[str, Array]:
    """Rotations (3, 3) to the parents' frames in a T-pose, for which the source's are identities.

    Args:
        clip: of the person, not re-rigged.
    """
    skeleton = SkeletonModel.default()
    R = _orientations(clip, _offsets(clip), np.eye(3) + np.zeros((1, len(skeleton.names), 3, 3)))
    local = kinematics.local_rotations(skeleton.parents, R)[0]
    names = ("Hips", "LeftUpLeg", "RightUpLeg", *SPINE, "LeftShoulder", "RightShoulder")
    return {name: local[skeleton.names.index(name)] for name in names}


def _offsets(clip: MocapClip) -> Array:
    rest = SkeletonModel.default().joint_offsets
    return rest * np.linalg.norm(clip.joint_offsets, axis=1).sum() / np.linalg.norm(rest, axis=1).sum()


def _orientations(clip: MocapClip, offsets: Array, R_world_source: Array) -> Array:
    """R_world_bone (T, J, 3, 3) on the other rig, with these joint offsets (J, 3)."""
    skeleton, posture = SkeletonModel.default(), Posture.of(clip.subject)
    source, ours = (shared_frames(skeleton.names, o) for o in (clip.joint_offsets, offsets))
    R = R_world_source @ source @ np.swapaxes(ours, -1, -2)
    at = {name: skeleton.names.index(name) for name in skeleton.names}
    bend = so3.log(np.swapaxes(R[:, at["Hips"]], -1, -2) @ R[:, at["Spine3"]]) / len(SPINE)
    for name, constant in zip(SPINE[:-1], posture.bends[:-1], strict=True):  # what is left is Spine3's
        R[:, at[name]] = R[:, skeleton.parents[at[name]]] @ so3.exp(bend + constant)
    for side, sign, constant in zip(("Left", "Right"), (1, -1), posture.clavicles, strict=True):
        arm = sign * np.einsum("tji,tj->ti", R[:, at["Spine3"]], R[:, at[f"{side}Arm"], :, 1])
        up, forward = np.arcsin(np.clip(arm[:, 2], -0.93, 0.93)), arm[:, 0]
        turn = constant + np.multiply(FOLLOWS, np.stack([up, forward], axis=-1))
        R[:, at[f"{side}Shoulder"]] = R[:, at["Spine3"]] @ so3.exp(
            sign * np.stack([turn[:, 0], np.zeros(len(R)), -turn[:, 1]], axis=-1)
        )
    return R
