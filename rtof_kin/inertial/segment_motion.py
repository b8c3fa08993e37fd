"""One calibrated sensor's movement, read as that of some segment: what evidence is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.stillness import orientation_rate

Array = NDArray[np.float64]
RATE_HZ = 60.0
"""Rate that motions are compared at; calibrated sensors are resampled to it."""


@dataclass(frozen=True, eq=False)
class SegmentMotion:
    """One sensor, read as sitting on a segment."""

    joint: str
    """The segment, by its proximal joint."""
    R_world_bone: Array
    """(T, 3, 3)"""
    w_world: Array
    """(T, 3) angular velocity in world, rad/s"""
    a_world: Array
    """(T, 3) acceleration of the sensor, m/s^2"""
    p_bone_sensor: Array
    """(3,) m"""

    def moved(self, joint: str, R_bone_new: Array, p_bone_sensor: Array) -> SegmentMotion:
        """The same sensor on another segment, or mounted otherwise: bone axes turned by R_bone_new."""
        return SegmentMotion(joint, self.R_world_bone @ R_bone_new, self.w_world, self.a_world, p_bone_sensor)

    def turned(self, R_world_new: Array) -> SegmentMotion:
        """The same with its reference turned in world, by R (3, 3) from the left."""
        return SegmentMotion(
            self.joint,
            R_world_new @ self.R_world_bone,
            self.w_world @ R_world_new.T,
            self.a_world @ R_world_new.T,
            self.p_bone_sensor,
        )


def even_times(bone_imus: BoneImuSequence) -> Array:
    """(T,) s at `RATE_HZ`, over all that the sensors measured.

    Raises:
        ShapeError: that is too short to say anything about movement.
    """
    start, stop = bone_imus.times[[0, -1]]
    if stop - start < 1.0:
        raise ShapeError(f"{stop - start:.2g} s of sensor data are too short to judge a movement by")
    return np.asarray(np.arange(start, stop + 1e-9, 1 / RATE_HZ), dtype=np.float64)


def segment_motions(bone_imus: BoneImuSequence) -> tuple[SegmentMotion, ...]:
    """The sensors as declared, at `even_times`."""
    times = even_times(bone_imus)
    even = bone_imus.resample(times)
    motions = []
    for s, joint in enumerate(even.joints):
        R = even.R_world_bone[:, s]
        w_world = np.einsum("tij,tj->ti", R, orientation_rate(times, R))
        motions.append(SegmentMotion(joint, R, w_world, even.a_world[:, s], even.p_bone_sensor[s]))
    return tuple(motions)


def seen_bones(poses: PoseSequence, skeleton: SkeletonModel, times: Array) -> dict[str, Array]:
    """Directions (T, C, 3) in world, at some times, from each joint to its C children, as a camera
    saw them.

    Joints of which nothing was seen, and those without children, are not there.
    """
    skeleton.check_joints(poses.names)
    p = signals.interpolate(poses.times, poses.p_world_joint, times, max_gap=0.2)
    children = {j: kinematics.children_of(skeleton.parents, j) for j in range(len(skeleton.names))}
    return {
        skeleton.names[j]: so3.unit(p[:, own] - p[:, [j]])
        for j, own in children.items()
        if own and np.isfinite(p[:, [*own, j]]).all(axis=(1, 2)).any()
    }
