"""IMU samples as recorded, and as calibrated to segments.

Axes are time, then element, then component: (T, J, 3). Missing is NaN in the value and 0 in the
confidence, both. A different state of the data is a
different type: `ImuSequence` -> `ImuCalibration.apply` -> `BoneImuSequence`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import signals
from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, indices_of, readonly
from rtof_kin.core.errors import ShapeError, UnitError

Array = NDArray[np.float64]


STANDARD_GRAVITY = 9.80665
"""[m/s^2]"""
GRAVITY_WORLD = readonly("gravity", [0.0, 0.0, -STANDARD_GRAVITY], (3,))
"""Gravity in world, m/s^2. An accelerometer at rest reads its opposite."""
_ABSURD_ACCELERATION = 1e4  # [m/s^2] hundreds of times what IMUs measure


@dataclass(frozen=True)
class ImuSequence:
    """Orientation and specific force of IMUs, as sensors give them."""

    times: Array
    """(T,) seconds, on the clock of the keypoints, strictly increasing."""
    R_inertial_sensor: Array
    """(T, S, 3, 3); NaN as a whole where missing."""
    f_sensor: Array
    """(T, S, 3) specific force in sensor axes, m/s^2, gravity included; NaN where missing."""
    names: tuple[str, ...]
    """S sensor names."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("IMU names", self.names))
        set_(self, "times", checked_times("IMU times", self.times))
        T, S = len(self.times), len(self.names)
        R = readonly("IMU R_inertial_sensor", self.R_inertial_sensor, (T, S, 3, 3))
        checked_rotations("IMU R_inertial_sensor", R)
        set_(self, "R_inertial_sensor", R)
        set_(self, "f_sensor", readonly("IMU f_sensor", self.f_sensor, (T, S, 3)))
        if np.any(np.isinf(self.f_sensor)):
            raise ShapeError("IMU f_sensor: infinite; write NaN where a sample is missing")
        self._check_unit()

    def _check_unit(self) -> None:
        """Over a recording the median specific force is near one gravity.

        Samples that repeat the one before count for nothing: a sensor may stick in the middle of a blow;
        and of one that never says anything else, nothing can be told.
        """
        norm = np.linalg.norm(self.f_sensor, axis=-1)
        norm[1:][(self.f_sensor[1:] == self.f_sensor[:-1]).all(axis=-1)] = np.nan
        R = self.R_inertial_sensor
        frozen = np.isfinite(norm).sum(axis=0) == 1
        frozen &= (R[1:] == R[:-1]).all(axis=(0, 2, 3)) & (len(R) > 1)
        for s, name in enumerate(self.names):
            if frozen[s] or not np.any(np.isfinite(norm[:, s])):
                continue
            median = float(np.nanmedian(norm[:, s]))
            if 0.5 < median < 2.0 and self._feels_gravity(s, norm[:, s]):
                raise UnitError(
                    f"IMU {name}: the median specific force is {median:.2f}, which is one gravity "
                    f"in g; multiply by {STANDARD_GRAVITY} to get m/s^2"
                )
            if median < 4.0:
                raise UnitError(
                    f"IMU {name}: the median specific force is {median:.2f} m/s^2, so gravity was "
                    "removed; give the raw accelerometer, which reads 9.81 upwards at rest"
                )
            if median > 30.0:
                raise UnitError(
                    f"IMU {name}: the median specific force is {median:.3g}, far above one gravity; "
                    "give m/s^2 (9.81 at rest), not milli-g or raw counts"
                )

    def _feels_gravity(self, s: int, norm: Array) -> bool:
        """Whether a sensor's specific force (T,) in some unit has gravity in it: it is hardly ever small,
        or its mean in the reference is most of it.
        """
        if np.nanquantile(norm, 0.1) > 0.7 * np.nanmedian(norm):
            return True
        f = np.einsum("tij,tj->ti", self.R_inertial_sensor[:, s], self.f_sensor[:, s])
        f = f[np.isfinite(f).all(axis=-1)]
        return len(f) > 0 and bool(np.linalg.norm(f.mean(axis=0)) > 0.5 * np.nanmean(norm))

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def joined(cls, parts: Sequence[Self], max_gap: float = 0.1) -> Self:
        """Sensors that were sampled at times of their own, together.

        Where their times differ, all are brought to even ones, at the fastest sensor's rate over what any
        sensor covers: orientation on the geodesic, specific force linearly.

        Args:
            max_gap: no value is interpolated across a gap longer than this, s: it becomes NaN.

        Raises:
            ShapeError: there are none, or two of the same name.
        """
        if not parts:
            raise ShapeError("IMUs to join: there are none")
        times = parts[0].times
        if any(not np.array_equal(part.times, times) for part in parts):
            step = min(float(np.median(np.diff(p.times))) for p in parts if len(p) > 1)
            first, last = min(p.times[0] for p in parts), max(p.times[-1] for p in parts)
            count = int(np.floor((last - first) / step + 1e-6)) + 1
            times = np.minimum(first + step * np.arange(count), last)
            parts = [part._at(times, max_gap) for part in parts]
        return cls(
            times=times,
            R_inertial_sensor=np.concatenate([part.R_inertial_sensor for part in parts], axis=1),
            f_sensor=np.concatenate([part.f_sensor for part in parts], axis=1),
            names=tuple(name for part in parts for name in part.names),
        )

    def _at(self, times: Array, max_gap: float) -> Self:
        return replace(
            self,
            times=times,
            R_inertial_sensor=signals.interpolate_rotations(
                self.times, self.R_inertial_sensor, times, max_gap
            ),
            f_sensor=signals.interpolate(self.times, self.f_sensor, times, max_gap),
        )

    def select(self, names: Sequence[str]) -> Self:
        """The sensors named, in that order."""
        index = indices_of("sensor", names, self.names)
        return replace(
            self,
            R_inertial_sensor=self.R_inertial_sensor[:, index],
            f_sensor=self.f_sensor[:, index],
            names=tuple(names),
        )


@dataclass(frozen=True)
class BoneImuSequence:
    """IMUs after calibration: orientation of the segment that carries each, acceleration in world."""

    times: Array
    """(T,) seconds, strictly increasing."""
    R_world_bone: Array
    """(T, S, 3, 3) orientation of the segment's link frame; NaN as a whole where missing."""
    a_world: Array
    """(T, S, 3) acceleration of the sensor in world, gravity removed, m/s^2; NaN where missing."""
    p_bone_sensor: Array
    """(S, 3) lever arm: position of the sensor in the segment's link frame, m."""
    joints: tuple[str, ...]
    """S names of the segments (by their proximal joint) that carry the sensors."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "joints", checked_names("bone IMU joints", self.joints))
        set_(self, "times", checked_times("bone IMU times", self.times))
        T, S = len(self.times), len(self.joints)
        R = readonly("bone IMU R_world_bone", self.R_world_bone, (T, S, 3, 3))
        checked_rotations("bone IMU R_world_bone", R)
        set_(self, "R_world_bone", R)
        set_(self, "a_world", readonly("bone IMU a_world", self.a_world, (T, S, 3)))
        set_(self, "p_bone_sensor", readonly("bone IMU p_bone_sensor", self.p_bone_sensor, (S, 3)))

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return replace(
            self,
            times=self.times[frames],
            R_world_bone=self.R_world_bone[frames],
            a_world=self.a_world[frames],
        )

    def select(self, joints: Sequence[str]) -> Self:
        """The sensors on the segments named, in that order."""
        index = indices_of("IMU segment", joints, self.joints)
        return replace(
            self,
            R_world_bone=self.R_world_bone[:, index],
            a_world=self.a_world[:, index],
            p_bone_sensor=self.p_bone_sensor[index],
            joints=tuple(joints),
        )

    @classmethod
    def joined(cls, parts: Sequence[Self], times: ArrayLike) -> Self:
        """Sensors that were sampled at times of their own, all brought to these times (`resample`, but
        for those that have them already).

        Raises:
            ShapeError: there are none, or two are of the same segment.
        """
        joints = [joint for part in parts for joint in part.joints]
        if not parts or len(set(joints)) < len(joints):
            raise ShapeError("bone_imus: there must be some, each of another segment")
        own = [p if np.array_equal(p.times, times) else p.resample(times) for p in parts]
        return cls(
            times=own[0].times,
            R_world_bone=np.concatenate([part.R_world_bone for part in own], axis=1),
            a_world=np.concatenate([part.a_world for part in own], axis=1),
            p_bone_sensor=np.concatenate([part.p_bone_sensor for part in own]),
            joints=tuple(joints),
        )

    def low_passed(self, cutoff_hz: float) -> Self:
        """The same sensors, their accelerations without what is faster than a frequency. What no sensor
        measures stays as it is, and is kept out of the others.
        """
        absurd = (np.abs(self.a_world) > _ABSURD_ACCELERATION).any(axis=-1, keepdims=True)
        out = np.where(absurd, np.nan, self.a_world)
        for s in range(len(self.joints)):
            out[:, s] = signals.low_pass_known(self.times, out[:, s], cutoff_hz)
        return replace(self, a_world=np.where(absurd, self.a_world, out))

    def resample(self, times: ArrayLike, max_gap: float = 0.1) -> Self:
        """The same sensors at other times, usually those of the video.

        Orientation is interpolated on the geodesic. Acceleration is averaged over +-1 frame with a
        hat-shaped kernel: the central second difference of positions at the new rate is exactly that
        average of the true acceleration, so the two can be compared ([1 4 1] / 6 at equal rates).

        Args:
            times: (T',) seconds.
            max_gap: no value is interpolated across a gap longer than this, s: it becomes NaN.
        """
        times = checked_times("times to resample to", times)
        step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / 60
        return replace(
            self,
            times=times,
            R_world_bone=signals.interpolate_rotations(self.times, self.R_world_bone, times, max_gap),
            a_world=signals.hat_average(self.times, self.a_world, times, step, max_gap),
        )
