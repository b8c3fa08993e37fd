"""ISB segment frames from link frames, and the three angles of a rotation between two of them.

A link frame is x forward, y left, z up in the T-pose with palms down. An ISB frame is x forward, y up, z
to the right in the anatomical standing posture (arms hanging, palms forward), and fixed in the segment:
`R_bone_isb` is that constant. So every angle is 0 in the anatomical posture, whatever the skeleton's own
zero is.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SINGULAR_MARGIN, SkeletonModel
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals

Array = NDArray[np.float64]
R_ROS_ISB = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Columns are ISB's x forward, y up, z right in axes x forward, y left, z up."""
_MIRROR = np.array([1.0, 1.0, -1.0])
"""The sagittal plane's reflection in ISB axes."""


def anatomical_posture(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """(J, 3, 3) R_world_bone of the anatomical standing posture facing world x.

    It is the N-pose (palms to the thighs) with forearms and hands supinated by 90 degrees.
    """
    R_posture = np.array(skeleton.forward_kinematics(skeleton.n_pose()[None])[1][0])
    for side, quarter in (("right", -np.pi / 2), ("left", np.pi / 2)):
        for word in ("forearm", "hand"):
            (j,) = skeleton.index(table.segments[f"{side} {word}"])
            R_posture[j] = so3.about_axis("z", quarter) @ R_posture[j]
    return R_posture


def isb_frames(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """(J, 3, 3) constant R_bone_isb of every segment."""
    return np.asarray(np.swapaxes(anatomical_posture(skeleton, table), -1, -2) @ R_ROS_ISB)


def mirrored(R: Array) -> Array:
    """Rotations (..., 3, 3) in ISB axes as a mirror in the sagittal plane shows them."""
    return np.asarray(_MIRROR[:, None] * R * _MIRROR)


def mirror_image(v: Array) -> Array:
    """Vectors (3, ...) in ISB axes as a mirror in the sagittal plane shows them."""
    return np.asarray((_MIRROR * v.T).T)


def decompose(sequence: str, R: Array) -> Array:
    """Angles (..., 3) in radians of rotations (..., 3, 3) in ISB axes.

    Args:
        sequence: three different axes, the middle angle then in [-pi/2, pi/2]; or 'yxy', the middle
            angle then in [-pi, 0] (Wu et al. 2005: elevation is a negative rotation).
        R: (..., 3, 3), R_parent_child.

    At a singular posture the first angle is 0 and the third carries the whole turn.
    """
    return _matrix_to_yxy(R) if sequence == "yxy" else so3.matrix_to_euler(sequence, R)


def _matrix_to_yxy(R: Array) -> Array:
    sine = np.hypot(R[..., 0, 1], R[..., 2, 1])
    elevation = np.arctan2(sine, R[..., 1, 1])
    singular = sine < 1e-12
    first = np.where(singular, 0.0, np.arctan2(-R[..., 0, 1], -R[..., 2, 1]))
    third = np.arctan2(-R[..., 1, 0], R[..., 1, 2])
    third = np.where(singular, np.arctan2(R[..., 0, 2], R[..., 0, 0]), third)
    return np.stack([first, -elevation, third], axis=-1)


def compose(sequence: str, angles: Array) -> Array:
    """Inverse of `decompose`: rotations (..., 3, 3) of angles (..., 3) in radians."""
    return so3.euler_to_matrix(sequence, angles)


def near_singular(sequence: str, angles: Array) -> NDArray[np.bool_]:
    """(...) whether angles (..., 3) are within 5 degrees of a posture where only the sum of the outer
    two is defined.
    """
    middle = angles[..., 1]
    distance = np.abs(np.sin(middle) if sequence == "yxy" else np.cos(middle))
    return np.asarray(distance < np.sin(SINGULAR_MARGIN))


def continuous(sequence: str, angles: Array, center: Array) -> Array:
    """Angles without jumps over time, but for singular postures, where they are not defined.

    Every rotation has more than one name: whole turns, and (a + pi, pi - b, c + pi). Each stretch between
    two singular postures keeps one of them, that whose median is nearest to the middle of the ranges; so
    a hanging arm may circle its vertical as often as it likes, and after a glitch all is as before.

    Args:
        sequence: as in `decompose`. angles: (T, 3) of it, radians, no frame missing.
        center: (3,) radians, the middle of the ranges.

    Returns:
        (T, 3) radians. The middle angle of 'yxy' keeps its sign, so its plane turns by half a turn, fast
        but steadily, where the arm passes by its vertical.
    """
    out = np.empty_like(angles)
    singular = near_singular(sequence, angles)
    starts = [0, *(stop for _, stop in signals.runs(singular) if stop < len(angles))]
    for start, stop in pairwise([*starts, len(angles)]):
        names = [np.unwrap(angles[start:stop], axis=0)]
        if sequence != "yxy":
            names.append(names[0] * [1, -1, 1] + np.pi)
        names = [name - _whole_turns(np.median(name, axis=0) - center) for name in names]
        distances = [np.sum((np.median(name, axis=0) - center) ** 2) for name in names]
        out[start:stop] = names[int(np.argmin(distances))]
    return out


def _whole_turns(angle: Array) -> Array:
    return np.asarray(2 * np.pi * np.round(angle / (2 * np.pi)))


def relative_rotations(R_world_bone: Array, skeleton: SkeletonModel, table: AngleTable) -> dict[str, Array]:
    """R_parent_child (T, 3, 3) in ISB frames of every joint coordinate system, mirrored if left."""
    R_world_isb = R_world_bone @ isb_frames(skeleton, table)
    out = {}
    for joint in table.joints:
        (child,) = skeleton.index(joint.child)
        R_parent = R_ROS_ISB  # the world's own axes, as a subject who faces x has them
        if joint.urdf:
            R_parent = R_world_isb[:, skeleton.index(joint.parent)[0]]
        R = np.swapaxes(R_parent, -1, -2) @ R_world_isb[:, child]
        out[joint.name] = mirrored(R) if joint.side == "left" else R
    return out
