"""A sensor moved by planted physics, and what its file would hold under any declaration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.imu_stream import Declaration, SensorStream

UP = -GRAVITY_WORLD
FINE = 20


@cache
def moved(
    seconds: float = 20.0,
    rate_hz: float = 60.0,
    seed: int = 0,
    rests: bool = True,
    noise: float = 1.0,
    name: str = "wrist",
) -> SensorStream:
    """A sensor on a limb that swings from posture to posture about a joint 0.4 m away.

    Rates and accelerations are differences on a fine grid, by NumPy and SciPy alone.

    Args:
        seconds, rate_hz: of the recording. seed: of postures and noise. rests: comes to rest in every
            posture. noise: multiple of that of a cheap sensor.
    """
    rng = np.random.default_rng(seed)
    dt = 1 / (FINE * rate_hz)
    count = int(seconds / dt)
    hold, blur = (1.2, 0.12) if rests else (0.4, 0.2)
    postures = rng.uniform(-1.3, 1.3, (int(seconds / hold) + 1, 3))
    angles = gaussian_filter1d(postures[(np.arange(count) * dt / hold).astype(int)], blur / dt, axis=0)
    R = Rotation.from_euler("ZYX", angles)
    quat = R.as_quat()
    rate = np.gradient(quat, dt, axis=0)
    w = 2 * (quat[:, 3:] * rate[:, :3] - rate[:, 3:] * quat[:, :3] - np.cross(quat[:, :3], rate[:, :3]))
    p = R.apply([0.0, 0.05, -0.4])
    f = R.inv().apply(np.gradient(np.gradient(p, dt, axis=0), dt, axis=0) + UP)
    at = slice(FINE, -FINE, FINE)
    T = len(f[at])
    drift = Rotation.from_rotvec(noise * np.cumsum(rng.normal(0, 3e-5, (T, 3)), axis=0))
    return SensorStream(
        name,
        10 + np.arange(T) / rate_hz,
        f[at] + noise * (rng.normal(0, 0.05, (T, 3)) + rng.normal(0, 0.08, 3)),
        (drift * R[at]).as_matrix(),
        w[at] + noise * (rng.normal(0, 0.01, (T, 3)) + rng.normal(0, 0.01, 3)),
        quaternion_norm=np.ones(T),
    )


def read_as(stream: SensorStream, means: Declaration, declared: Declaration) -> SensorStream:
    """The stream whose file means one thing, read as if it meant another."""
    R, f, w = stream.R_inertial_sensor, stream.f_sensor, stream.w_sensor
    assert R is not None
    if stream.quaternion_norm is None:
        new_R = declared.upright(means.filed_rotations(R))
    else:
        new_R = declared.rotations(means.filed_quaternions(R))
    if f is not None:
        f = declared.specific_force(means.filed_acceleration(f, R), new_R)
    if w is not None:
        w = declared.angular_velocity(means.filed_angular_velocity(w))
    return replace(stream, f_sensor=f, R_inertial_sensor=new_R, w_sensor=w)
