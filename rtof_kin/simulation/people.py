"""Other people's neutral postures on a known movement.

People stand with another tilt of the pelvis, another bend of each part of the spine and other clavicles,
and move from there. Their limbs and upper trunk do the same movement.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.random import Generator

from rtof_kin.body import kinematics
from rtof_kin.body.neutral_posture import SPINE
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import PoseSequence

PELVIS_DEG: Final = (1.5, 5.0, 1.5)
"""Spread over people of the pelvis, about its axes x forward, y left, z up."""
BEND_DEG: Final = (1.5, 5.0, 1.5)
"""The same of each part of the spine, relative to the mean of all parts."""
CLAVICLE_DEG: Final = (5.0, 1.5, 6.0)
"""The same of a clavicle."""


def another_person(rng: Generator, poses: PoseSequence, skeleton: SkeletonModel) -> PoseSequence:
    """Return a movement as a person with another neutral posture makes it.

    Args:
        poses: (T, J) the movement.

    Returns:
        The movement with pelvis, lumbar spine and clavicles turned by constants in their own frames. Limbs,
        head and upper trunk keep their orientations; the lowest foot keeps its height.
    """
    R, p_root = np.array(poses.R_world_bone), poses.p_world_joint[:, 0]
    at = {name: skeleton.names.index(name) for name in ("Hips", *SPINE, "LeftShoulder", "RightShoulder")}
    bends = np.radians(rng.normal(0.0, BEND_DEG, (len(SPINE), 3)))
    bends -= bends.mean(axis=0)
    turned = np.zeros(3)
    for name, bend in zip(SPINE[:-1], bends[:-1], strict=True):
        turned = turned + bend
        R[:, at[name]] = R[:, at[name]] @ so3.exp(turned)
    R[:, at["Hips"]] = R[:, at["Hips"]] @ so3.exp(np.radians(rng.normal(0.0, PELVIS_DEG)))
    for side, mirror in (("Left", 1.0), ("Right", -1.0)):
        constant = np.radians(rng.normal(0.0, CLAVICLE_DEG)) * [mirror, 1.0, mirror]
        R[:, at[f"{side}Shoulder"]] = R[:, at[f"{side}Shoulder"]] @ so3.exp(constant)
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p_root, R)
    p[..., 2] += poses.p_world_joint[..., 2].min() - p[..., 2].min()
    return replace(poses, p_world_joint=p, R_world_bone=R)
