"""Segment frames that all rigs share, from joint centres alone.

Link frames of different rigs agree in the T-pose, but not with the joints: the lumbar joint lies 17 degrees
behind the vertical over the hips in CMU's skeletons and 26 in Total Capture's. What is learned on one rig
about the pelvis and the joints around it would be wrong by the difference on the other. The shared frame of
the pelvis is defined by hip and lumbar joints, those of the limbs' long bones by their directions; the others
are link frames. On CMU's mean skeleton all of them are.

``R_world_shared = R_world_bone @ R_bone_shared`` and ``offset_shared = R_parent_shared^T offset``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from rtof_kin.body.limbs import LIMBS
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

LUMBAR_PITCH: Final = np.radians(-17.5)
"""Direction from the middle of the hips to the lumbar joint in the shared frame, about y from z, rad."""
_STRAIGHT: Final = np.radians(6.0)
"""A lumbar joint nearer to the vertical is drawn there, not measured; the pelvis keeps its link frame."""


def shared_frames(names: Sequence[str], offsets: Array) -> Array:
    """Return the shared frame of each segment in its link frame, R_bone_shared (J, 3, 3).

    Args:
        names: J joints; those of the 21-joint skeleton are known, segments of others keep their link frames.
        offsets: (J, 3) in the parents' link frames, m.
    """
    offset = dict(zip(names, np.asarray(offsets, dtype=float), strict=True))
    R = np.tile(np.eye(3), (len(names), 1, 1))
    if {"Hips", "LeftUpLeg", "RightUpLeg", "Spine"} <= set(names):
        R[names.index("Hips")] = _pelvis(offset["LeftUpLeg"], offset["RightUpLeg"], offset["Spine"])
    for limb in LIMBS:
        left = limb[0].startswith("Left")
        direction = [0, 0, -1] if limb[0].endswith("Leg") else [0, 1 if left else -1, 0]
        for joint, child in pairwise(limb):
            if {joint, child} <= set(names):
                R[names.index(joint)] = so3.minimal_rotation(direction, offset[child])
    return R


def to_shared(R_bone_shared: Array, parents: Sequence[int], offsets: Array) -> Array:
    """Return joint offsets (J, 3) in the parents' shared frames, m.

    Args:
        R_bone_shared: (J, 3, 3). parents: (J,) of each joint. offsets: (J, 3) in the parents' link frames, m.
    """
    above = R_bone_shared[np.maximum(parents, 0)]
    return np.asarray(np.einsum("jba,jb->ja", above, offsets))


def _pelvis(left_hip: Array, right_hip: Array, lumbar: Array) -> Array:
    """Frame (3, 3) with y from hip to hip and the lumbar joint at `LUMBAR_PITCH`."""
    up = lumbar - (left_hip + right_hip) / 2
    if abs(np.arctan2(up[0], up[2])) < _STRAIGHT:
        return np.eye(3)
    y = so3.unit(left_hip - right_hip)
    z = so3.unit(up - (up @ y) * y)
    return np.stack([np.cross(y, z), y, z], axis=-1) @ so3.about_axis("y", -LUMBAR_PITCH)
