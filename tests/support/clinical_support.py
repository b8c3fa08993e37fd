"""Postures built from segment orientations, and real walking, for the tests of `rtof_kin.clinical`."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import all_observed, angles_and_paths
from rtof_kin.clinical.decomposition import anatomical_posture
from rtof_kin.clinical.paths import BodyPaths, PathCollector
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reporting.analysis import document
from rtof_kin.reporting.document import write_files
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


def body_paths(
    motion: Motion | MotionSource | PoseSequence, skeleton: SkeletonModel | None = None, standing: bool = False
) -> BodyPaths:
    """Paths of pelvis and feet of a motion, or of poses of a skeleton."""
    if not isinstance(motion, PoseSequence):
        return angles_and_paths(MotionSource.of(motion), standing=standing)[1]
    assert skeleton is not None
    collector = PathCollector(skeleton, motion.times, standing)
    collector.add(slice(None), motion, slice(None))
    return collector.paths(ObservationMasks.of_poses(motion, skeleton))


def limb(side: str, segments: tuple[str, ...], R_turn: Array) -> dict[str, Array]:
    """The same turn for several segments of one side, as `posture` takes them."""
    return {f"{side}_{segment}": R_turn for segment in segments}


@lru_cache
def walk() -> Motion:
    """Real walking, 4.2 s at 40 Hz, three strides; every orientation known."""
    clip = read_mocap(WALK, rate_hz=40.0, output_rate_hz=None)
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    return skeleton.motion(all_observed(clip.poses))


def walking(
    seconds: float = 6.0,
    *,
    speed: float = 1.1,
    stride_time: float = 1.2,
    stance: float = 0.64,
    heading: float = 0.0,
    treadmill: bool = False,
    late: float = 0.5,
    jitter: float = 0.0,
) -> Motion:
    """Planted walking at 60 Hz: feet that stand still in stance, straight ahead, knees by two bones.

    Args:
        speed: m/s, of the pelvis or the belt. stance: share of the stride. heading: rad.
        treadmill: whether the pelvis stays in place. late: strike of the left foot, share of the stride.
        jitter: amplitude of the stride phase, strides; unsteady if above 0.
    """
    times = np.arange(round(seconds * 60)) / 60
    phase = times / stride_time + jitter * np.sin(2 * np.pi * times / 3.1)
    ahead = {
        side: _foot(phase - shift, stance, speed * stride_time)
        for side, shift in (("right", 0.3), ("left", 0.3 + late))
    }
    way = np.zeros_like(times) if treadmill else speed * stride_time * phase
    return stepping(times, {side: xz + np.array([0.0, -0.78]) for side, xz in ahead.items()}, way, heading)


def _foot(phase: Array, stance: float, length: float) -> Array:
    """(T, 2) m ahead of and above its place under the pelvis, of a foot that strikes at whole phases."""
    share = phase % 1
    swing = np.clip((share - stance) / (1 - stance), 0, 1)
    smooth = swing**3 * (10 - 15 * swing + 6 * swing**2)
    ahead = length * (stance / 2 - share + smooth)
    return np.stack([ahead, 0.05 * np.sin(np.pi * swing) ** 2], axis=-1)


def stepping(times: Array, ankles: dict[str, Array], way: Array | float = 0.0, heading: Array | float = 0.0) -> Motion:
    """Legs whose ankles follow paths relative to the hips, under an upright trunk.

    Args:
        times: (T,) s. ankles: side -> (T, 2) m ahead of and above the hip. way: (T,) m, of the pelvis along
        its heading. heading: (T,) rad.
    """
    skeleton, turns = SkeletonModel.default(), {}
    thigh, shank = (skeleton.bone_lengths[name] for name in ("RightLeg", "RightFoot"))
    for side, xz in ankles.items():
        far = np.minimum(np.hypot(*xz.T), 0.999 * (thigh + shank))
        direction = np.arctan2(xz[:, 0], -xz[:, 1])
        hip = np.arccos((thigh**2 + far**2 - shank**2) / (2 * thigh * far))
        knee = np.arccos((shank**2 + far**2 - thigh**2) / (2 * shank * far))
        turns[f"{side}_thigh"] = so3.about_axis("y", -(direction + hip))
        turns[f"{side}_shank"] = so3.about_axis("y", -(direction - knee))
    facing = np.broadcast_to(heading, times.shape)
    poses = posture(skeleton, len(times), body=so3.about_axis("z", facing), **turns)
    lowest = np.minimum.reduce([xz[:, 1] for xz in ankles.values()])
    moved = np.stack([way * np.cos(facing), way * np.sin(facing), -0.9 - lowest], axis=-1)
    return skeleton.motion(poses.with_poses(slice(None), poses.p_world_joint + moved[:, None]))


def squatting(count: int = 4, depth: float = 0.35) -> Motion:
    """Squats of two seconds each, at 60 Hz, by so many metres."""
    times = np.arange(120 * count) / 60
    height = -0.78 + depth / 2 * (1 - np.cos(np.pi * times))
    ankle = np.stack([np.zeros_like(times), height], axis=-1)
    return stepping(times, {"right": ankle, "left": ankle})


def write_analysis(analysis: MotionAnalysis, folder: Path, sensors: int | None = None) -> None:
    """Write the tables of an analysis, without figures; sensors: those that the bands rest on."""
    write_files(replace(document(analysis, sensors), figures=()), folder)
