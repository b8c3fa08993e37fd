"""Sensors on a person who holds a pose and then moves, with the true calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import planted
from numpy.typing import NDArray

from benchmarks.held import exercise, held_then_moving
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import orientation_rate
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import LIMB_SENSORS

Array = NDArray[np.float64]
WALK = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"


@dataclass(frozen=True)
class Worn:
    """A motion, its sensors and their true calibration."""

    skeleton: SkeletonModel
    poses: PoseSequence
    imus: ImuSequence
    truth: ImuCalibration

    @property
    def joints(self) -> dict[str, str]:
        """Sensor -> segment."""
        return dict(zip(self.truth.sensors, self.truth.joints, strict=True))

    def errors_deg(self, calibration: ImuCalibration) -> Array:
        """(S,) mean angle of the segments by a calibration to the true ones, turned to one world."""
        R = calibration.select(self.imus.names).apply(self.imus).R_world_bone
        R_true = self.poses.R_world_bone[:, self.skeleton.index(*self.truth.joints)]
        turn = so3.about_axis("z", so3.heading((R_true @ np.swapaxes(R, -1, -2)).mean(axis=(0, 1))))
        return np.asarray(np.degrees(so3.angle_between(turn @ R, R_true)).mean(axis=0))

    def with_one_reference(self, heading: float) -> Worn:
        """The sensors with references of one heading, rad, in world."""
        turn = so3.about_axis("z", -heading)
        R = turn @ self.truth.R_world_inertial @ self.imus.R_inertial_sensor
        R_world_inertial = np.broadcast_to(turn.T, self.truth.R_world_inertial.shape)
        return replace(
            self,
            imus=replace(self.imus, R_inertial_sensor=R),
            truth=replace(self.truth, R_world_inertial=R_world_inertial),
        )

    def log(self) -> SensorLog:
        """Sensor log with gyroscopes, each sensor at its own times."""
        streams = []
        for s, name in enumerate(self.imus.names):
            own = slice(s, len(self.imus) - s)
            times, R = self.imus.times, self.imus.R_inertial_sensor[:, s]
            w = orientation_rate(times, R)
            streams.append(SensorStream(name, times[own], self.imus.f_sensor[own, s], R[own], w[own]))
        return SensorLog(Path("worn"), "planted", tuple(streams), Declaration())


def worn(
    poses: PoseSequence,
    skeleton: SkeletonModel,
    sensors: Sequence[str] = LIMB_SENSORS,
    noise: ImuNoise | None = None,
    seed: int = 0,
) -> Worn:
    """Sensors on a moving person; without noise by default."""
    rng = np.random.default_rng(seed)
    noise = noise or ImuNoise.perfect()
    imus, truth = simulate_imus(rng, poses, skeleton, sensors, poses.times, noise)
    return Worn(skeleton, poses, imus, truth)


def walking(R_pose: Array | None = None, sensors: Sequence[str] = LIMB_SENSORS, **options: object) -> Worn:
    """A walk of CMU's, after a pose held for two seconds where one is given."""
    clip = read_mocap(WALK, rate_hz=30.0, output_rate_hz=60.0)
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    poses = clip.poses if R_pose is None else held_then_moving(clip.poses, R_pose, skeleton)
    return worn(poses, skeleton, sensors, **options)  # type: ignore[arg-type]


def free(sensors: Sequence[str] = LIMB_SENSORS, seed: int = 0, **options: object) -> Worn:
    """Six seconds of a motion drawn from the pose prior."""
    skeleton = SkeletonModel.default()
    poses = planted.human(skeleton, 360, seed=seed).poses
    return worn(poses, skeleton, sensors, seed=seed, **options)  # type: ignore[arg-type]


def exercising(sensors: Sequence[str] = LIMB_SENSORS, seed: int = 0, **options: object) -> Worn:
    """A person in the N-pose who flexes knees, elbows and trunk."""
    skeleton = SkeletonModel.default()
    poses = exercise(skeleton, np.random.default_rng(seed), 4.0)
    return worn(poses, skeleton, sensors, seed=seed, **options)  # type: ignore[arg-type]
