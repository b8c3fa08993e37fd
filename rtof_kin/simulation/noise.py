"""Random errors of IMUs.

The sizes were measured on one recording of thirteen IMUs. An IMU's orientation error is slow slip and soft-tissue
motion, mostly about the bone. Every parameter is drawn for each recording from a log-normal distribution
(`parameter_spread`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError, UnitError
from rtof_kin.data.imu import GRAVITY_WORLD, ImuCalibration, ImuSequence
from rtof_kin.data.poses import PoseSequence

ORIENTATION_MEDIAN_DEG: Final = {
    "Head": 2.0,
    "Hips": 3.0,
    "Spine3": 3.9,
    "LeftFoot": 2.2,
    "RightFoot": 8.4,
    "LeftArm": 5.3,
    "RightArm": 5.8,
    "LeftForeArm": 7.4,
    "RightForeArm": 10.0,
    "LeftUpLeg": 6.7,
    "RightUpLeg": 5.4,
    "LeftLeg": 4.6,
    "RightLeg": 5.8,
}
"""Median angle between an IMU with its best constant calibration and the segment, deg."""
_OTHER_MEDIAN_DEG: Final = 5.0
_MEDIAN_NORM: Final = 0.816  #: Median norm of a normal vector with standard deviations 1, 0.3, 0.3
_SWING_SHARE: Final = 0.3
_POSTURE_SCALE, _RATE_SCALE = 0.3, 1.0  #: Motion of a segment at which its soft-tissue error saturates, rad and rad/s
_CYCLE = ((1, 2), (2, 0), (0, 1))


def varied(noise: Any, rng: Generator, *fixed: str) -> dict[str, Any]:
    """Return the numbers of some errors, each but the fixed ones times a log-normal factor."""
    names = [one.name for one in fields(noise) if one.type == "float" and one.name not in ("parameter_spread", *fixed)]
    factors = np.exp(noise.parameter_spread * rng.standard_normal(len(names)))
    return {name: getattr(noise, name) * float(k) for name, k in zip(names, factors, strict=True)}


@dataclass(frozen=True)
class ImuNoise:
    """Errors of IMUs on a body: of orientation (`ORIENTATION_MEDIAN_DEG`) and of the accelerometer."""

    misalignment_deg: float = 0.9  # [deg] per axis, constant per sensor
    orientation_factor: float = 1.0  # [-] on the medians of each segment; 0 for none
    drift_memory: float = 20.0  # [s] correlation time of the slip
    wobble_share: float = 0.3  # [-] of the variance, correlated with the segment's motion
    white: float = 0.4  # [m/s^2] per axis and sample, at rest
    white_per_acceleration: float = 0.2  # [-] more of it, per m/s^2 of true acceleration
    coloured: float = 0.5  # [m/s^2] per axis
    coloured_memory: float = 0.2  # [s] its correlation time
    bias: float = 0.1  # [m/s^2] per axis, constant per sensor
    parameter_spread: float = 0.25  # [-] of the log-normal factor each number is drawn with

    @classmethod
    def perfect(cls) -> Self:
        """Return no errors."""
        return cls(
            misalignment_deg=0,
            orientation_factor=0,
            white=0,
            white_per_acceleration=0,
            coloured=0,
            bias=0,
            parameter_spread=0,
        )

    def drawn(self, rng: Generator) -> Self:
        """Return a sensor with randomly drawn parameters."""
        drawn = replace(self, **varied(self, rng))
        return replace(drawn, wobble_share=min(drawn.wobble_share, 1.0))


def coloured_noise(rng: Generator, times: Array, memory: ArrayLike, size: Sequence[int]) -> Array:
    """Return a stationary Ornstein-Uhlenbeck process (T, *size) of unit variance; `memory` in s."""
    steps = np.diff(times).reshape(-1, *(1 for _ in size))
    share = np.exp(-steps / np.asarray(memory, dtype=float))
    kicks = np.sqrt(1 - share**2)
    out = rng.standard_normal((len(times), *size))
    for t in range(1, len(times)):
        out[t] = share[t - 1] * out[t - 1] + kicks[t - 1] * out[t]
    return out


def smooth_noise(rng: Generator, times: Array, memory: float, size: Sequence[int], smoothing: float = 0.5) -> Array:
    """Return coloured noise (T, *size) of unit variance, low-pass filtered with a first-order filter; correlation time
    and the filter's time constant in s.
    """
    raw = coloured_noise(rng, times, memory, size)
    share = np.exp(-np.diff(times) / smoothing)
    for t in range(1, len(times)):
        raw[t] = share[t - 1] * raw[t - 1] + (1 - share[t - 1]) * raw[t]
    return np.asarray(raw * np.sqrt((memory + smoothing) / memory))


def mounting_errors(
    rng: Generator, times: Array, joint: str, axis: Array, R_parent_bone: Array, noise: ImuNoise
) -> Array:
    """Return a sensor's rotation (T, 3, 3) from its usual mounting, in the link frame; of identity mean.

    Args:
        times: (T,) s. axis: (3,) direction of the bone in its link frame, the main axis of slip.
        R_parent_bone: (T, 3, 3) segment in its parent's frame, with which soft-tissue errors correlate.
    """
    median_deg = ORIENTATION_MEDIAN_DEG.get(joint, _OTHER_MEDIAN_DEG) * noise.orientation_factor
    median_deg *= float(np.exp(noise.parameter_spread * rng.standard_normal()))
    drift = smooth_noise(rng, times, noise.drift_memory, (3,))
    wobble = _wobble(rng, times, R_parent_bone)
    share = noise.wobble_share
    mixed = np.sqrt(1 - share) * drift + np.sqrt(share) * wobble
    twist = np.outer(axis, axis)
    spread = (1 - _SWING_SHARE) * twist + _SWING_SHARE * np.eye(3)
    return so3.exp(np.radians(median_deg) / _MEDIAN_NORM * mixed @ spread)


def _wobble(rng: Generator, times: Array, R_parent_bone: Array) -> Array:
    """Return a random linear map (T, 3) of posture and turning rate, of unit variance for large motion."""
    R_mean_bone = so3.nearest_rotation(R_parent_bone.mean(axis=0)).T @ R_parent_bone
    # The sine of the turn times its axis, which stays smooth through half a turn.
    posture = np.stack([R_mean_bone[:, k, j] - R_mean_bone[:, j, k] for j, k in _CYCLE], -1) / 2
    steps = so3.log(np.swapaxes(R_parent_bone[:-1], -1, -2) @ R_parent_bone[1:])
    turning = np.concatenate([steps[:1], steps]) / np.median(np.diff(times))
    parts = []
    for values, scale in ((posture, _POSTURE_SCALE), (turning, _RATE_SCALE)):
        centred = values - values.mean(axis=0)
        parts.append(centred / np.maximum(centred.std(axis=0), scale))
    mixing = so3.unit(rng.standard_normal((3, 6)))
    return np.asarray(np.concatenate(parts, axis=1) @ mixing.T)


def accelerometer_errors(rng: Generator, times: Array, a_world: Array, noise: ImuNoise) -> Array:
    """Return errors of an accelerometer in sensor axes (T, 3), m/s^2, of an acceleration (T, 3) in world, m/s^2."""
    size = np.linalg.norm(a_world, axis=-1, keepdims=True)
    white = noise.white + noise.white_per_acceleration * size
    return np.asarray(
        white * rng.standard_normal((len(times), 3))
        + noise.coloured * coloured_noise(rng, times, noise.coloured_memory, (3,))
        + noise.bias * rng.standard_normal(3)
    )


def simulate_imus(
    rng: Generator, poses: PoseSequence, skeleton: SkeletonModel, sensors: Sequence[str], times: Array, noise: ImuNoise
) -> tuple[ImuSequence, ImuCalibration]:
    """Simulate the samples of sensors on a body, and their calibration, exact but for the misalignment.

    A sensor has its usual position on its segment, a random mounting and heading. Its specific force is
    ``R_world_sensor^T (a - g)``, a the second derivative of the cubic spline through ``p_joint + R_world_bone lever``.
    Slip rotates the sensor on the segment, so that orientation and acceleration stay consistent in sensor axes.
    `InvalidInputError`: implausibly fast motion; `UnknownNameError`: no such sensor.

    Args:
        rng: source of randomness; a subset of the sensors has the same errors as the whole set.
        sensors: names in the skeleton's table. times: (T',) s, inside the poses' times.
        noise: parameters are drawn around these for each sensor.
    """
    known = list(skeleton.sensors)
    wanted = indices_of("sensor", sensors, known)
    streams = rng.spawn(len(known))
    all_local = kinematics.local_rotations(skeleton.parents, poses.R_world_bone)
    R_world_inertial, R_sensor_bone, R_inertial_sensor, f_sensor = zip(
        *(_measure(streams[i], poses, skeleton, known[i], all_local, times, noise) for i in wanted), strict=True
    )
    places = [skeleton.sensors[name] for name in sensors]
    calibration = ImuCalibration(
        sensors=tuple(sensors),
        joints=tuple(joint for joint, _ in places),
        R_world_inertial=np.stack(R_world_inertial),
        R_sensor_bone=np.stack(R_sensor_bone),
        p_bone_sensor=np.stack([lever for _, lever in places]),
    )
    try:
        imus = ImuSequence(
            times=times,
            R_inertial_sensor=np.stack(R_inertial_sensor, axis=1),
            f_sensor=np.stack(f_sensor, axis=1),
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
) -> tuple[Array, Array, Array, Array]:
    """Return R_world_inertial, R_sensor_bone, R_inertial_sensor and f_sensor of one sensor."""
    joint, lever = skeleton.sensors[name]
    j = skeleton.index(joint)[0]
    noise = noise.drawn(rng)
    R_world_inertial = so3.about_axis("z", rng.uniform(-np.pi, np.pi))
    R_bone_sensor = so3.exp(so3.unit(rng.standard_normal(3)) * rng.uniform(0, np.pi))
    misalignment = so3.exp(np.radians(noise.misalignment_deg) * rng.standard_normal(3))

    axis = so3.unit(skeleton.table.joints[j].end)
    local = _at(poses, R_parent_bone[:, j], times)
    R_bone_slipped = mounting_errors(rng, times, joint, axis, local, noise)
    R_world_bone = _at(poses, poses.R_world_bone[:, j], times)
    R_world_sensor = R_world_bone @ R_bone_slipped @ R_bone_sensor

    p_world_sensor = poses.p_world_joint[:, j] + poses.R_world_bone[:, j] @ lever
    a_world = CubicSpline(poses.times, p_world_sensor).derivative(2)(times)
    f_sensor = np.einsum("tji,tj->ti", R_world_sensor, a_world - GRAVITY_WORLD)
    f_sensor = f_sensor + accelerometer_errors(rng, times, a_world, noise)
    return R_world_inertial, R_bone_sensor.T @ misalignment, R_world_inertial.T @ R_world_sensor, f_sensor


def _at(poses: PoseSequence, R: Array, times: Array) -> Array:
    """Interpolate rotations (T, 3, 3) of the poses."""
    if np.array_equal(times, poses.times):
        return R
    return signals.interpolate_rotations(poses.times, R[:, None], times)[:, 0]
