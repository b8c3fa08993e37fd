"""Virtual IMUs on a moving body.

A sensor has its usual place on its segment, a random mounting rotation and a random heading. Its specific force is
``R_world_sensor^T (a - g)``, a the second derivative of the cubic spline through ``p_joint + R_world_bone lever``.
Slip rotates the sensor on the segment, so that orientation and acceleration stay consistent in sensor axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from scipy.interpolate import CubicSpline

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError, UnitError
from rtof_kin.data.imu import GRAVITY_WORLD, ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation import noise as noises
from rtof_kin.simulation.noise import ImuNoise


def simulate_imus(
    rng: Generator, poses: PoseSequence, skeleton: SkeletonModel, sensors: Sequence[str], times: Array, noise: ImuNoise
) -> tuple[ImuSequence, ImuCalibration]:
    """Simulate the samples of sensors on a body, and their calibration, exact but for the misalignment.

    Args:
        rng: source of randomness; a subset of the sensors has the same errors as the whole set.
        sensors: names in the skeleton's table. times: (T',) s, inside the poses' times.
        noise: parameters are drawn around these for each sensor.

    Raises:
        InvalidInputError: implausibly fast motion. UnknownNameError: no such sensor.
    """
    known = list(skeleton.sensors)
    wanted = indices_of("sensor", sensors, known)
    streams = rng.spawn(len(known))
    all_local = kinematics.local_rotations(skeleton.parents, poses.R_world_bone)
    measured = [_measure(streams[i], poses, skeleton, known[i], all_local, times, noise) for i in wanted]
    places = [skeleton.sensors[name] for name in sensors]
    calibration = ImuCalibration(
        sensors=tuple(sensors),
        joints=tuple(joint for joint, _ in places),
        R_world_inertial=np.stack([m["R_world_inertial"] for m in measured]),
        R_sensor_bone=np.stack([m["R_sensor_bone"] for m in measured]),
        p_bone_sensor=np.stack([lever for _, lever in places]),
    )
    try:
        imus = ImuSequence(
            times=times,
            R_inertial_sensor=np.stack([m["R_inertial_sensor"] for m in measured], axis=1),
            f_sensor=np.stack([m["f_sensor"] for m in measured], axis=1),
            names=tuple(sensors),
        )
    except UnitError as error:
        raise InvalidInputError(
            f"simulation: no sensor would read what this motion makes it read ({error}); mocap that "
            "jitters needs `low_passed`, positions need metres"
        ) from error
    return imus, calibration


def _measure(
    rng: Generator,
    poses: PoseSequence,
    skeleton: SkeletonModel,
    name: str,
    R_parent_bone: Array,
    times: Array,
    noise: ImuNoise,
) -> dict[str, Array]:
    """Return what one sensor measured and its calibration, by field of the two sequences."""
    joint, lever = skeleton.sensors[name]
    j = skeleton.index(joint)[0]
    noise = noise.drawn(rng)
    R_world_inertial = so3.about_axis("z", rng.uniform(-np.pi, np.pi))
    R_bone_sensor = so3.exp(so3.unit(rng.standard_normal(3)) * rng.uniform(0, np.pi))
    misalignment = so3.exp(np.radians(noise.misalignment_deg) * rng.standard_normal(3))

    axis = so3.unit(skeleton.table.joints[j].end)
    local = _at(poses, R_parent_bone[:, j], times)
    R_bone_slipped = noises.mounting_errors(rng, times, joint, axis, local, noise)
    R_world_bone = _at(poses, poses.R_world_bone[:, j], times)
    R_world_sensor = R_world_bone @ R_bone_slipped @ R_bone_sensor

    p_world_sensor = poses.p_world_joint[:, j] + poses.R_world_bone[:, j] @ lever
    a_world = CubicSpline(poses.times, p_world_sensor).derivative(2)(times)
    f_sensor = np.einsum("tji,tj->ti", R_world_sensor, a_world - GRAVITY_WORLD)
    return {
        "R_inertial_sensor": R_world_inertial.T @ R_world_sensor,
        "f_sensor": f_sensor + noises.accelerometer_errors(rng, times, a_world, noise),
        "R_world_inertial": R_world_inertial,
        "R_sensor_bone": R_bone_sensor.T @ misalignment,
    }


def _at(poses: PoseSequence, R: Array, times: Array) -> Array:
    """Interpolate rotations (T, 3, 3) of the poses."""
    if np.array_equal(times, poses.times):
        return R
    return signals.interpolate_rotations(poses.times, R[:, None], times)[:, 0]
