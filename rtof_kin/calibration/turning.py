"""Angular velocities of segments as an image shows them, and of sensors, at even times.

A sensor and the segment that carries it have the same angular velocity in world, whatever the mounting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import angular_velocity

STEP: Final = 0.02
"""[s] between samples."""
LEAST_SECONDS: Final = 2.0
"""[s] Least time that a person is seen."""
_CUTOFF_HZ: Final = 5.0
_FASTEST: Final = 6.0
"""[rad/s] Faster turns are shortened to it: in the image they are mostly exchanged limbs."""
_LONGEST_GAP: Final = 0.2


@dataclass(frozen=True)
class Turning:
    """Angular velocities at even times, `STEP` apart."""

    start: float
    """[s] Time of the first sample."""
    w_world: Array
    """(T, N, 3) rad/s in world, or in each sensor's own reference; NaN where missing."""

    @property
    def known(self) -> Array:
        """(T, N) 1 where known, else 0."""
        return np.asarray(np.isfinite(self.w_world[..., 0]), dtype=float)

    def __getitem__(self, frames: slice) -> Turning:
        return Turning(self.start + STEP * (frames.start or 0), self.w_world[frames])

    def of(self, columns: Index | Sequence[int]) -> Turning:
        """Return some of the N."""
        return replace(self, w_world=self.w_world[:, columns])


def image_turning(poses: PoseSequence, keypoints: KeypointSequence, skeleton: SkeletonModel) -> Turning:
    """Return the segments' angular velocities in world as an image shows them.

    Raises:
        CalibrationError: nobody is seen for two seconds.
    """
    skeleton.check_joints(poses.names)
    shown = poses.valid.any(axis=1) & (keypoints.seen.mean(axis=1) > 0)
    R = np.where(shown[:, None, None, None], poses.R_world_bone, np.nan)
    out = turning_of(poses.times, R)
    seconds = STEP * float(out.known.any(axis=1).sum())
    if seconds < LEAST_SECONDS:
        raise CalibrationError(
            f"the video shows a person for {seconds:.1f} s, too short to find the sensors' clock by; "
            "check the detections, or use a longer video"
        )
    return out


def sensor_turning(log: SensorLog) -> Turning:
    """Return sensors' angular velocities (T, S, 3), each in its own reference."""
    first = min(stream.times[0] for stream in log.streams)
    last = max(stream.times[-1] for stream in log.streams)
    grid = _grid(first, last)
    columns = []
    for stream in log.streams:
        assert stream.R_inertial_sensor is not None
        columns.append(turning_of(stream.times, stream.R_inertial_sensor[:, None], grid).w_world)
    return Turning(float(grid[0]), np.concatenate(columns, axis=1))


def joined(parts: Sequence[Turning]) -> Turning:
    """Return parts of one recording on one grid; NaN between them."""
    if len(parts) == 1:
        return parts[0]
    start = min(part.start for part in parts)
    firsts = [round((part.start - start) / STEP) for part in parts]
    stop = max(first + len(part.w_world) for first, part in zip(firsts, parts, strict=True))
    out = np.full((stop, *parts[0].w_world.shape[1:]), np.nan)
    for first, part in zip(firsts, parts, strict=True):
        out[first : first + len(part.w_world)] = part.w_world
    return Turning(start, out)


def _grid(first: float, last: float) -> Array:
    """Multiples of `STEP` from one time to another."""
    return np.asarray(STEP * np.arange(np.ceil(first / STEP - 1e-6), last / STEP + 1e-6))


def turning_of(times: Array, R: Array, grid: Array | None = None) -> Turning:
    """Return the angular velocities of orientations.

    Args:
        times: (T,) s. R: (T, N, 3, 3). grid: even times, `STEP` apart; default: all multiples of it.
    """
    grid = _grid(float(times[0]), float(times[-1])) if grid is None else grid
    R = signals.interpolate_rotations(times, R, grid, _LONGEST_GAP)
    w = np.stack([angular_velocity(grid, one) for one in R.swapaxes(0, 1)], axis=1)
    w *= np.minimum(1.0, _FASTEST / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-9))
    smooth = [signals.low_pass_known(grid, one, _CUTOFF_HZ) for one in w.swapaxes(0, 1)]
    return Turning(float(grid[0]), np.stack(smooth, axis=1))
