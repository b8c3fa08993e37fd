"""A long motion with sensors on clocks and headings of their own, and a video of a part of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.noise import ImuNoise, simulate_imus

SENSORS = ("L_LowArm", "R_LowArm", "L_UpLeg", "R_LowLeg")


def worn(
    motion: Motion, rate_hz: float = 100.0, sensors: tuple[str, ...] = SENSORS, seed: int = 0
) -> tuple[SensorLog, ImuCalibration]:
    """What exact sensors measure on the motion's clock, with any heading and mounting."""
    poses = motion.poses
    times = np.arange(0, poses.times[-1], 1 / rate_hz)
    rng = np.random.default_rng(seed)
    imus, calibration = simulate_imus(rng, poses, motion.skeleton, sensors, times, ImuNoise.perfect())
    streams = tuple(
        SensorStream(name, times, imus.f_sensor[:, s], imus.R_inertial_sensor[:, s])
        for s, name in enumerate(imus.names)
    )
    return SensorLog(Path("planted"), "planted", streams, Declaration()), calibration


def filmed(motion: Motion, start: float, seconds: float, radians: float = 0.1) -> tuple[PoseSequence, KeypointSequence]:
    """A part of a motion on a video's own clock: lifted with errors of orientation, and its keypoints."""
    truth = motion.poses
    first = round(start * planted.RATE_HZ)
    part = truth[first : first + round(seconds * planted.RATE_HZ)]
    part = replace(part, times=part.times - part.times[0])
    wrong = planted.smooth_noise(first, (*part.R_world_bone.shape[:2], 3), 20, radians)
    near = part.p_world_joint - part.p_world_joint[:, 0].mean(axis=0) * [1, 1, 0]  # before the camera
    poses = part.with_poses(slice(None), near, part.R_world_bone @ so3.exp(wrong))
    return poses, planted.keypoints(poses)


def shifted(log: SensorLog, offset: float, drift: float = 0.0) -> SensorLog:
    """The log on another clock: t_old = t_new + offset + drift t_new."""
    streams = tuple(replace(s, times=(s.times - offset) / (1 + drift)) for s in log.streams)
    return replace(log, streams=streams)


def cut(log: SensorLog, start: float, stop: float) -> SensorLog:
    """A part of a log."""
    return replace(log, streams=tuple(part for s in log.streams if (part := s.between(start, stop)) is not None))


def joints(calibration: ImuCalibration) -> dict[str, str]:
    """Sensor -> segment."""
    return dict(zip(calibration.sensors, calibration.joints, strict=True))


def skeleton() -> SkeletonModel:
    """The usual one."""
    return SkeletonModel.default()
