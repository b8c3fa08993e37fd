"""Faults of the streams of inertial sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.accuracy.windows import SECOND_AFTER_HALF, bounds
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.imu import ImuSequence
from rtof_kin.formats.sensors.readings import WRAP_16, in_order
from rtof_kin.recording.recording import Recording

ONE = "L_LowArm"
"""The sensor of faults that befall one: on the left forearm."""
_SATURATED = 2 * 9.81
_RAMP = 0.2
"""s that a sensor takes to slip."""


def sensors(recording: Recording) -> ImuSequence:
    """The sensors of a recording that has some."""
    assert recording.imus is not None
    return recording.imus


def with_imus(recording: Recording, **changes: Any) -> Recording:
    """The sensors with other fields."""
    return replace(recording, imus=replace(sensors(recording), **changes))


def _without(recording: Recording, gone: Mask) -> Recording:
    """The recording without some samples (T, S)."""
    imus = sensors(recording)
    R = np.where(gone[..., None, None], np.nan, imus.R_inertial_sensor)
    return with_imus(recording, R_inertial_sensor=R, f_sensor=np.where(gone[..., None], np.nan, imus.f_sensor))


def _column(recording: Recording) -> int:
    return sensors(recording).names.index(ONE)


def without_sensor(recording: Recording, rng: Generator) -> Recording:
    """The left forearm's sensor missing altogether."""
    imus = sensors(recording)
    return replace(recording, imus=imus.select([name for name in imus.names if name != ONE]))


def with_stopped_sensors(recording: Recording, rng: Generator, names: tuple[str, ...] | None = None) -> Recording:
    """Some sensors, or all, that say nothing after half of the video."""
    imus = sensors(recording)
    stop, _ = bounds(recording.video.times, SECOND_AFTER_HALF)
    stopped = np.isin(imus.names, imus.names if names is None else names)
    return _without(recording, (imus.times >= stop)[:, None] & stopped)


def with_stuck_sensor(recording: Recording, rng: Generator) -> Recording:
    """The left forearm's sensor, which repeats its last sample after half of the video."""
    imus, s = sensors(recording), _column(recording)
    last = int(np.searchsorted(imus.times, bounds(recording.video.times, SECOND_AFTER_HALF)[0]))
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    R[last:, s], f[last:, s] = R[last, s], f[last, s]
    return with_imus(recording, R_inertial_sensor=R, f_sensor=f)


def with_slipped_sensor(recording: Recording, rng: Generator) -> Recording:
    """The left forearm's sensor, which slips by 30 deg about an axis across the bone within 0.2 s."""
    imus, s, own = sensors(recording), _column(recording), recording.calibration
    assert own is not None
    angle = rng.uniform(0, 2 * np.pi)
    bone = recording.skeleton.joint_offsets[recording.skeleton.names.index("LeftHand")]
    across, other = np.linalg.svd(bone[None])[2][1:]
    R_sensor_bone = own.R_sensor_bone[own.sensors.index(ONE)]
    axis = R_sensor_bone @ (np.cos(angle) * across + np.sin(angle) * other)
    start, _ = bounds(recording.video.times, SECOND_AFTER_HALF)
    share = np.clip((imus.times - start) / _RAMP, 0, 1)
    turn = so3.exp(np.radians(30.0) * share[:, None] * axis)
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    R[:, s] = R[:, s] @ turn
    f[:, s] = np.einsum("tji,tj->ti", turn, f[:, s])
    return with_imus(recording, R_inertial_sensor=R, f_sensor=f)


def with_turned_heading(recording: Recording, rng: Generator, degrees: Callable[[Array], Array]) -> Recording:
    """The left forearm's sensor, whose heading is off by `degrees` of the time in s after the middle."""
    imus, s = sensors(recording), _column(recording)
    after = imus.times - bounds(recording.video.times, SECOND_AFTER_HALF)[0]
    R = imus.R_inertial_sensor.copy()
    R[:, s] = so3.about_axis("z", np.radians(degrees(after))) @ R[:, s]
    return with_imus(recording, R_inertial_sensor=R)


def magnet(after: Array) -> Array:
    """40 deg in the middle second, coming and going within 0.1 s."""
    return np.interp(after, [-0.5, -0.4, 0.4, 0.5], [0.0, 40.0, 40.0, 0.0])


def drift(after: Array) -> Array:
    """Growing evenly to 20 deg over the second half."""
    return np.asarray(20.0 * np.clip(after / after[-1], 0, 1))


def with_saturated_accelerometers(recording: Recording, rng: Generator) -> Recording:
    """All accelerometers, which read 2 g per axis at most."""
    f = np.clip(sensors(recording).f_sensor, -_SATURATED, _SATURATED)
    return with_imus(recording, f_sensor=f)


def with_lost_packets(recording: Recording, rng: Generator) -> Recording:
    """A tenth of all packets lost, drawn one by one."""
    return _without(recording, rng.random(sensors(recording).f_sensor.shape[:2]) < 0.1)


def with_lost_bursts(recording: Recording, rng: Generator) -> Recording:
    """Bursts of 0.5 s in which a sensor's packets are lost, of a tenth of the time."""
    imus = sensors(recording)
    gone, length = np.zeros(imus.f_sensor.shape[:2], dtype=bool), 0.5
    count = max(1, round(0.1 * (imus.times[-1] - imus.times[0]) / length))
    for s in range(len(imus.names)):
        for start in rng.uniform(imus.times[0], imus.times[-1] - length, count):
            gone[(imus.times >= start) & (imus.times < start + length), s] = True
    return _without(recording, gone)


def with_repeated_packets(recording: Recording, rng: Generator) -> Recording:
    """A tenth of all packets sent twice, some a packet late, with a counter that wraps: as a reader of
    files takes them."""
    imus = sensors(recording)
    first = WRAP_16 - len(imus) // 2
    twice = np.sort(np.concatenate([np.arange(len(imus)), rng.permutation(len(imus))[: len(imus) // 10]]))
    late = 1 + 2 * rng.permutation((len(twice) - 1) // 2)[: len(imus) // 20]
    twice[late], twice[late + 1] = twice[late + 1], twice[late]
    counters = ((first + twice) % WRAP_16).astype(float)
    packets = in_order(Path("memory"), counters, range(len(twice)), WRAP_16, 16, "counter")
    rows = twice[packets.rows]
    times = imus.times[0] + (packets.count - first) * np.median(np.diff(imus.times))
    R, f = imus.R_inertial_sensor[rows], imus.f_sensor[rows]
    return replace(recording, imus=replace(imus, times=times, R_inertial_sensor=R, f_sensor=f))


def with_clocks_of_their_own(recording: Recording, rng: Generator) -> Recording:
    """Sensors of 40 and 100 Hz in turn that start up to 25 ms apart; time stamps jitter by 2 ms."""
    imus, parts = sensors(recording), []
    for s, name in enumerate(imus.names):
        rate = (40.0, 100.0)[s % 2]
        stamps = np.arange(imus.times[0] + rng.uniform(0, 0.025), imus.times[-1], 1 / rate)
        jitter = 2e-3 * rng.standard_normal(len(stamps)).clip(-2, 2)
        sampled = np.clip(stamps + jitter, imus.times[0], imus.times[-1])
        R, f = imus.R_inertial_sensor[:, [s]], imus.f_sensor[:, [s]]
        R = signals.interpolate_rotations(imus.times, R, sampled)
        parts.append(ImuSequence(stamps, R, signals.interpolate(imus.times, f, sampled), (name,)))
    return replace(recording, imus=ImuSequence.joined(parts))
