"""Postures built from segment orientations, and real walking, for the tests of `rtof_kin.clinical`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.joint_coordinate_systems import anatomical_posture
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import read_mocap

Array = NDArray[np.float64]
WALK = Path(__file__).parents[1] / "fixtures" / "mocap" / "16_16.amc"
LEG = ("thigh", "shank", "foot")
ARM = ("upper_arm", "forearm", "hand")


def turn(**degrees: float) -> Array:
    """(3, 3) product of turns about world axes, the first named last to act: x forward, y left, z up."""
    R = np.eye(3)
    for axis, angle in degrees.items():
        R = R @ so3.about_axis(axis, np.radians(angle))
    return R


def posture(skeleton: SkeletonModel, frames: int = 1, **turns: Array) -> PoseSequence:
    """The anatomical posture with some segments turned, in world; fully observed.

    Args:
        turns: anatomical words with '_' ('right_shank') -> (3, 3) or (frames, 3, 3); 'body' turns all.
    """
    table = angle_table(skeleton.table)
    R = np.tile(anatomical_posture(skeleton, table), (frames, 1, 1, 1))
    whole = turns.pop("body", None)
    for word, R_turn in turns.items():
        side, _, segment = word.partition("_")
        name = table.segments[f"{side} {segment}" if side in ("right", "left") else word]
        (j,) = skeleton.index(name)
        R[:, j] = R_turn @ R[:, j]
    if whole is not None:
        R = np.reshape(whole, (-1, 1, 3, 3)) @ R
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.array([0.0, 0.0, 0.95]), R)
    return all_observed(PoseSequence(np.arange(frames) / 60, p, R, skeleton.names))


def limb(side: str, segments: tuple[str, ...], R_turn: Array) -> dict[str, Array]:
    """The same turn for several segments of one side, as `posture` takes them."""
    return {f"{side}_{segment}": R_turn for segment in segments}


@lru_cache
def walk() -> MotionSequence:
    """Real walking, 4.2 s at 40 Hz, three strides; every orientation known."""
    clip = read_mocap(WALK, rate_hz=40.0, output_rate_hz=None)
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    return skeleton.motion(all_observed(clip.poses))
