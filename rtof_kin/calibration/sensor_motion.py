"""What unplaced sensors measured, in terms that need neither a mounting nor a heading.

Orientation and acceleration of all sensors at common even times, low-pass filtered. The reference of each
sensor has z up and a heading of its own, so that of its vectors in that reference the vertical component,
the length of the horizontal one, and products of horizontal ones are known, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial.orientation import with_orientation

RATE_HZ: Final = 50.0  # Of `SensorMotions`
_CUTOFF_HZ = 6.0  # of all signals
_LONGEST_GAP = 0.1  # [s] that is interpolated
_LEAST_SECONDS = 1.0  # of common time
_TILTED_DEG = 10.0  # [deg] of the mean specific force from up, from which an orientation is not believed


@dataclass(frozen=True, eq=False)
class SensorMotions:
    """Motion of S sensors at T times, each in its own inertial reference with z up."""

    names: tuple[str, ...]  # S sensors
    times: Array  # (T,) s, on the log's clock; steps of 1 / `RATE_HZ` but where recordings were joined
    R: Array  # (T, S, 3, 3) R_inertial_sensor
    w: Array  # (T, S, 3) angular velocity, rad/s
    a: Array  # (T, S, 3) acceleration, m/s^2; NaN where the sensor has none
    D: Array  # (T, S, 3, 3) second derivative of R, 1/s^2: a point r of the sensor's body accelerates by a + D r

    @property
    def accelerated(self) -> bool:
        """Whether every sensor measured accelerations."""
        return bool(np.isfinite(self.a).all())

    def __len__(self) -> int:
        return len(self.times)

    def select(self, rows: slice | NDArray[Any]) -> SensorMotions:
        """Return only some times."""
        cut = {name: getattr(self, name)[rows] for name in ("times", "R", "w", "a", "D")}
        return replace(self, **cut)


def sensor_motions(log: SensorLog) -> SensorMotions:
    """Return the motion of the sensors over the time that all of them recorded.

    Raises:
        InvalidInputError: no common time, or a sensor without orientation that has no raw samples either.
    """
    if not log.streams:
        raise InvalidInputError(f"{log.path} has no sensor; name a file or folder with sensor data")
    start, stop = max(s.times[0] for s in log.streams), min(s.times[-1] for s in log.streams)
    if stop - start < _LEAST_SECONDS:
        raise InvalidInputError(
            f"the {len(log.streams)} sensors of {log.path} have {max(stop - start, 0):.1f} s in common; "
            f"{_LEAST_SECONDS:g} s at least are needed: record them together, on one clock"
        )
    times = np.arange(start, stop, 1 / RATE_HZ)
    parts = [_motion(_oriented(stream), times) for stream in log.streams]
    R, w, a, D = (np.stack(field, axis=1) for field in zip(*parts, strict=True))
    motions = SensorMotions(log.names, times, R, w, a, D)
    accelerated = [np.isfinite(a[:, s]).any() for s in range(len(log.names))]
    known = np.isfinite(D).all(axis=(1, 2, 3)) & np.isfinite(w).all(axis=(1, 2))
    known &= np.isfinite(a[:, accelerated]).all(axis=(1, 2))
    if known.sum() < _LEAST_SECONDS * RATE_HZ:
        raise InvalidInputError(
            f"the sensors of {log.path} have samples together for {known.sum() / RATE_HZ:.1f} s only; "
            "rtof-kin inspect lists their gaps"
        )
    return motions.select(known)


def _oriented(stream: SensorStream) -> SensorStream:
    """Return the stream with an orientation that agrees with gravity, estimated where the file has none."""
    f, R = stream.f_sensor, stream.R_inertial_sensor
    raw = f is not None and stream.w_sensor is not None
    if R is None:
        return with_orientation(stream)
    if f is not None and raw:
        up = np.nanmean(np.einsum("tij,tj->ti", R, f), axis=0)
        if np.degrees(np.arccos(np.clip(so3.unit(up)[2], -1, 1))) > _TILTED_DEG:
            return with_orientation(stream)
    return stream


def _motion(stream: SensorStream, times: Array) -> tuple[Array, Array, Array, Array]:
    assert stream.R_inertial_sensor is not None
    R = signals.interpolate_rotations(stream.times, stream.R_inertial_sensor[:, None], times, _LONGEST_GAP)
    flat = signals.low_pass_known(times, R.reshape(len(times), 9), _CUTOFF_HZ)
    smooth = flat.reshape(len(times), 3, 3)
    D, w = np.full_like(smooth, np.nan), np.full((len(times), 3), np.nan)
    D[1:-1] = (smooth[2:] - 2 * smooth[1:-1] + smooth[:-2]) * RATE_HZ**2
    turn = (smooth[2:] - smooth[:-2]) * (RATE_HZ / 2) @ np.swapaxes(smooth[1:-1], -1, -2)
    w[1:-1] = (
        np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1)
        / 2
    )
    if stream.f_sensor is None:
        return R[:, 0], w, np.full((len(times), 3), np.nan), D
    f = np.asarray(np.einsum("tij,tj->ti", stream.R_inertial_sensor, stream.f_sensor))
    f = signals.low_pass_known(stream.times, f, min(3 * _CUTOFF_HZ, 0.45 * stream.rate_hz))
    a = signals.interpolate(stream.times, f, times, _LONGEST_GAP) + GRAVITY_WORLD
    return R[:, 0], w, signals.low_pass_known(times, a, _CUTOFF_HZ), D


def joined(parts: Sequence[SensorMotions]) -> SensorMotions:
    """Return recordings of the same sensors, mounted as before, one after the other."""
    fields = {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("times", "R", "w", "a", "D")}
    return SensorMotions(parts[0].names, **fields)
