"""Motion of one calibrated sensor, read as that of a segment: the data of `MotionLikelihood`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
RATE_HZ: Final = 60.0
"""Sampling rate of motions."""


@dataclass(frozen=True, eq=False)
class SegmentMotion:
    """Motion of one sensor on a segment."""

    joint: str
    """Segment, by its proximal joint."""
    R_world_bone: Array
    """(T, 3, 3)."""
    w_world: Array
    """(T, 3) angular velocity, rad/s."""
    a_world: Array
    """(T, 3) acceleration of the sensor, m/s^2."""
    p_bone_sensor: Array
    """(3,) m."""

    def moved(self, joint: str, R_bone_new: Array, p_bone_sensor: Array) -> SegmentMotion:
        """Return the motion of the same sensor on another segment, or mounted otherwise.

        Args:
            joint: segment. R_bone_new: (3, 3) factor of R_world_bone. p_bone_sensor: (3,) m.
        """
        return SegmentMotion(joint, self.R_world_bone @ R_bone_new, self.w_world, self.a_world, p_bone_sensor)

    def turned(self, R_world_new: Array) -> SegmentMotion:
        """Return the motion with its reference rotated in world.

        Args:
            R_world_new: (3, 3) factor from the left.
        """
        R, w, a = R_world_new @ self.R_world_bone, self.w_world @ R_world_new.T, self.a_world @ R_world_new.T
        return SegmentMotion(self.joint, R, w, a, self.p_bone_sensor)


def even_times(bone_imus: BoneImuSequence) -> Array:
    """Return times (T,), s, at `RATE_HZ` over the sensors' duration.

    Args:
        bone_imus: the sensors.

    Raises:
        InvalidInputError: less than a second.
    """
    start, stop = bone_imus.times[[0, -1]]
    if stop - start < 1.0:
        raise InvalidInputError(f"{stop - start:.2g} s of sensor data are too short to judge a movement by")
    return np.asarray(np.arange(start, stop + 1e-9, 1 / RATE_HZ), dtype=np.float64)


def segment_motions(bone_imus: BoneImuSequence) -> tuple[SegmentMotion, ...]:
    """Return the motions of calibrated sensors at `even_times`.

    Args:
        bone_imus: the sensors.
    """
    times = even_times(bone_imus)
    even = bone_imus.resample(times)
    motions = []
    for s, joint in enumerate(even.joints):
        R = even.R_world_bone[:, s]
        w_world = np.einsum("tij,tj->ti", R, orientation_rate(times, R))
        motions.append(SegmentMotion(joint, R, w_world, even.a_world[:, s], even.p_bone_sensor[s]))
    return tuple(motions)


def seen_bones(poses: PoseSequence, skeleton: SkeletonModel, times: Array) -> dict[str, Array]:
    """Return directions (T, C, 3) in world from each joint to its C children, from a camera's poses.

    Args:
        poses: of the skeleton. skeleton: the subject's. times: (T,) s.

    Returns:
        By joint, without those never seen.
    """
    skeleton.check_joints(poses.names)
    p = signals.interpolate(poses.times, poses.p_world_joint, times, max_gap=0.2)
    children = {j: kinematics.children_of(skeleton.parents, j) for j in range(len(skeleton.names))}
    return {
        skeleton.names[j]: so3.unit(p[:, own] - p[:, [j]])
        for j, own in children.items()
        if own and np.isfinite(p[:, [*own, j]]).all(axis=(1, 2)).any()
    }


def orientation_rate(times: Array, R: Array) -> Array:
    """Differentiate orientations to angular velocity (T, 3), rad/s, in the rotating frame.

    Central differences, ``log(R(t-1)^T R(t+1)) / (t(t+1) - t(t-1))``, one-sided at the ends.

    Args:
        times: (T,) s. R: (T, 3, 3); a rate is NaN where one of its two orientations is.
    """
    last = len(times) - 1
    before, after = np.maximum(np.arange(last + 1) - 1, 0), np.minimum(np.arange(last + 1) + 1, last)
    step = np.swapaxes(R[before], -1, -2) @ R[after]
    known = np.isfinite(step).all(axis=(-2, -1))
    out = np.full((last + 1, 3), np.nan)
    out[known] = so3.log(step[known]) / (times[after] - times[before])[known, None]
    return out
