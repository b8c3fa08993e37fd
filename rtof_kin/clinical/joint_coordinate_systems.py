"""ISB segment frames, and the three angles of a rotation between two of them.

A link frame is x forward, y left, z up in the T-pose with palms down. An ISB frame is x forward, y up, z
right in the anatomical standing posture (arms hanging, palms forward) and fixed in the segment by the
constant `R_bone_isb`. So each angle is 0 in the anatomical posture, whatever the skeleton's own zero.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SINGULAR_MARGIN, SkeletonModel
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask

R_ROS_ISB: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""ISB axes (x forward, y up, z right) in axes x forward, y left, z up."""
MIRROR: Final = np.array([1.0, 1.0, -1.0])  # reflection in the sagittal plane, in ISB axes


def anatomical_posture(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """Return R_world_bone (J, 3, 3) of the anatomical standing posture facing world x.

    It is the N-pose (palms to the thighs) with forearms and hands supinated by 90 degrees.
    """
    R_posture = np.array(skeleton.forward_kinematics(skeleton.n_pose()[None])[1][0])
    for side, quarter in (("right", -np.pi / 2), ("left", np.pi / 2)):
        for word in ("forearm", "hand"):
            (j,) = skeleton.index(table.segments[f"{side} {word}"])
            R_posture[j] = so3.about_axis("z", quarter) @ R_posture[j]
    return R_posture


def isb_frames(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """Return the constant R_bone_isb (J, 3, 3) of all segments."""
    return np.asarray(np.swapaxes(anatomical_posture(skeleton, table), -1, -2) @ R_ROS_ISB)


def decompose(sequence: str, R: Array) -> Array:
    """Return the angles (..., 3) in radians of rotations in ISB axes.

    At a singular posture the first angle is 0 and the third is the sum.

    Args:
        sequence: three different axes, the middle angle then in [-pi/2, pi/2]; or 'yxy', the middle
            angle then in [-pi, 0] (Wu et al. 2005: elevation is a negative rotation).
        R: R_parent_child (..., 3, 3).
    """
    if sequence != "yxy":
        return so3.matrix_to_euler(sequence, R)
    sine = np.hypot(R[..., 0, 1], R[..., 2, 1])
    elevation = np.arctan2(sine, R[..., 1, 1])
    singular = sine < 1e-12
    first = np.where(singular, 0.0, np.arctan2(-R[..., 0, 1], -R[..., 2, 1]))
    third = np.arctan2(-R[..., 1, 0], R[..., 1, 2])
    third = np.where(singular, np.arctan2(R[..., 0, 2], R[..., 0, 0]), third)
    return np.stack([first, -elevation, third], axis=-1)


def near_singular(sequence: str, angles: Array) -> Mask:
    """Return a mask (...) of postures within 5 degrees of one where only the sum of the outer two is defined.

    Args:
        sequence: as in `decompose`. angles: (..., 3) radians.
    """
    distance = np.abs(np.sin(angles[..., 1]) if sequence == "yxy" else np.cos(angles[..., 1]))
    return np.asarray(distance < np.sin(SINGULAR_MARGIN))


def continuous(sequence: str, angles: Array, center: Array) -> Array:
    """Remove jumps over time, except at singular postures.

    The angles of a rotation are ambiguous by whole turns and by (a + pi, pi - b, c + pi). Each stretch
    between two singular postures gets one choice, that whose median is nearest to the middle of the ranges.
    The middle angle of 'yxy' keeps its sign.

    Args:
        sequence: as in `decompose`. angles: (T, 3) radians without NaN. center: (3,) middle of the ranges.
    """
    out = np.empty_like(angles)
    singular = near_singular(sequence, angles)
    starts = [0, *(stop for _, stop in signals.runs(singular) if stop < len(angles))]
    for start, stop in pairwise([*starts, len(angles)]):
        choices = [np.unwrap(angles[start:stop], axis=0)]
        if sequence != "yxy":
            choices.append(choices[0] * [1, -1, 1] + np.pi)
        turns = [np.round((np.median(choice, axis=0) - center) / (2 * np.pi)) for choice in choices]
        choices = [choice - 2 * np.pi * turn for choice, turn in zip(choices, turns, strict=True)]
        distances = [np.sum((np.median(choice, axis=0) - center) ** 2) for choice in choices]
        out[start:stop] = choices[int(np.argmin(distances))]
    return out


def relative_rotations(R_world_bone: Array, skeleton: SkeletonModel, table: AngleTable) -> dict[str, Array]:
    """Return R_parent_child (T, 3, 3) in ISB frames of all joint coordinate systems, mirrored if left.

    Args:
        R_world_bone: (T, J, 3, 3).
    """
    R_world_isb = R_world_bone @ isb_frames(skeleton, table)
    out = {}
    for joint in table.joints:
        R_parent = R_world_isb[:, skeleton.index(joint.parent)[0]] if joint.urdf else R_ROS_ISB
        R = np.swapaxes(R_parent, -1, -2) @ R_world_isb[:, skeleton.index(joint.child)[0]]
        out[joint.name] = MIRROR[:, None] * R * MIRROR if joint.side == "left" else R
    return out
