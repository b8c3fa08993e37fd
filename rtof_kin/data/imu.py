"""IMU samples as recorded (`ImuSequence`) and as calibrated to segments (`BoneImuSequence`).

`ImuCalibration.apply` converts one into the other. Axes are time, sensor, component. Missing is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, freeze, indices_of, readonly, shared
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnitError
from rtof_kin.core.over_time import OverTime

STANDARD_GRAVITY: Final = 9.80665  #: Standard gravity (CGPM 1901), m/s^2
GRAVITY_WORLD: Final[Array] = readonly("gravity", [0.0, 0.0, -STANDARD_GRAVITY], (3,))
"""Gravity in world, m/s^2. An accelerometer at rest reads its opposite."""
_ABSURD_ACCELERATION: Final = 1e4  #: Acceleration beyond any IMU, m/s^2


class UnitCheck:
    """Checks by gravity that specific force is in m/s^2, on samples that may come in blocks.

    The median over a whole recording is compared with one gravity. Repeated samples are ignored, because a
    sensor may freeze during an impact, and so are sensors that repeat one sample throughout.
    """

    def __init__(self) -> None:
        self._norms: list[Array] = []
        self._turned: list[Array] = []
        self._last: tuple[Array, Array] | None = None
        self._still: Any = True

    def add(self, R_inertial_sensor: Array, f_sensor: Array) -> None:
        """Take the next samples; R_inertial_sensor: (T, S, 3, 3). f_sensor: (T, S, 3)."""
        R, f = R_inertial_sensor, f_sensor
        norm = np.linalg.norm(f, axis=-1)
        turned = np.einsum("tsij,tsj->tsi", R, f)
        known = np.asarray(np.isfinite(turned).all(axis=-1))
        sums = np.where(known[..., None], turned, 0.0).sum(axis=0)
        self._turned.append(np.column_stack([sums, known.sum(axis=0)]))
        before, self._last = self._last, (R[-1:], f[-1:])
        if before is not None:
            R, f = np.concatenate([before[0], R]), np.concatenate([before[1], f])
        norm[len(norm) - len(f) + 1 :][(f[1:] == f[:-1]).all(axis=-1)] = np.nan
        self._norms.append(norm)
        self._still &= (R[1:] == R[:-1]).all(axis=(0, 2, 3))

    def check(self, names: Sequence[str]) -> None:
        """Check the samples that were added; `UnitError` where a sensor's unit is another one, or its gravity was
        removed.
        """
        norms = np.concatenate(self._norms)
        turned = np.sum(self._turned, axis=0)
        frozen = (np.isfinite(norms).sum(axis=0) == 1) & self._still & (len(norms) > 1)
        for s, name in enumerate(names):
            if not frozen[s] and np.any(np.isfinite(norms[:, s])):
                _check_unit(name, norms[:, s], turned[s])


def _check_unit(name: str, norm: Array, turned: Array) -> None:
    """Check the specific force of a sensor, of norms (T,), by the sum (4,) of the known samples in the inertial
    reference, and their number. A norm contains gravity, in any unit, if it is rarely small, or if most of it is
    constant in the inertial reference.
    """
    median = float(np.nanmedian(norm))
    feels_gravity = np.nanquantile(norm, 0.1) > 0.7 * median or (
        turned[3] > 0 and np.linalg.norm(turned[:3] / turned[3]) > 0.5 * np.nanmean(norm)
    )
    if 0.5 < median < 2.0 and feels_gravity:
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


@dataclass(frozen=True)
class ImuSequence(OverTime):
    """Orientation and specific force of IMUs, as measured."""

    times: Array  #: (T,) seconds, on the clock of the keypoints, strictly increasing
    R_inertial_sensor: Array  #: (T, S, 3, 3); NaN as a whole where missing
    f_sensor: Array  #: (T, S, 3) specific force in sensor axes, m/s^2, gravity included; NaN where missing
    names: tuple[str, ...]  #: S sensor names
    unit_checked: bool = field(default=False, repr=False)
    """Whether it is part of a longer sequence on which the unit of `f_sensor` was checked."""
    rows = ("R_inertial_sensor", "f_sensor")

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("IMU names", self.names))
        set_(self, "times", checked_times("IMU times", self.times))
        T, S = len(self.times), len(self.names)
        freeze(self, "IMU", R_inertial_sensor=(T, S, 3, 3), f_sensor=(T, S, 3))
        checked_rotations("IMU R_inertial_sensor", self.R_inertial_sensor)
        if np.any(np.isinf(self.f_sensor)):
            raise InvalidInputError("IMU f_sensor: infinite; write NaN where a sample is missing")
        if not self.unit_checked:
            unit = UnitCheck()
            unit.add(self.R_inertial_sensor, self.f_sensor)
            unit.check(self.names)

    def cut(self, frames: slice | Index) -> dict[str, Any]:
        """Return some rows of the fields, whose unit was checked on the whole."""
        return super().cut(frames) | {"unit_checked": True}

    @classmethod
    def joined(cls, parts: Sequence[Self], max_gap: float = 0.1) -> Self:
        """Join sensors; if their times differ, resample all to even times at the fastest sensor's rate.
        `InvalidInputError`: there are none, or two of the same name.

        Args:
            parts: any number of sensors each. max_gap: longest gap that is interpolated, s; beyond it values are NaN.
        """
        if not parts:
            raise InvalidInputError("IMUs to join: there are none")
        times, names = parts[0].times, [name for part in parts for name in part.names]
        resampled = any(not np.array_equal(part.times, times) for part in parts)
        if resampled:
            step = min(float(np.median(np.diff(p.times))) for p in parts if len(p) > 1)
            first, last = min(p.times[0] for p in parts), max(p.times[-1] for p in parts)
            count = int(np.floor((last - first) / step + 1e-6)) + 1
            times = np.minimum(first + step * np.arange(count), last)
        R, f, stop = np.empty((len(times), len(names), 3, 3)), np.empty((len(times), len(names), 3)), 0
        for part in parts:
            own, turned, felt = slice(stop, stop + len(part.names)), part.R_inertial_sensor, part.f_sensor
            R[:, own] = signals.interpolate_rotations(part.times, turned, times, max_gap) if resampled else turned
            f[:, own] = signals.interpolate(part.times, felt, times, max_gap) if resampled else felt
            stop = own.stop
        shared(R, f)
        return cls(times, R, f, tuple(names))

    def select(self, names: Sequence[str]) -> Self:
        """Return sensors in the order of `names`. `UnknownNameError`: a sensor does not exist."""
        index = indices_of("sensor", names, self.names)
        return replace(
            self,
            R_inertial_sensor=self.R_inertial_sensor[:, index],
            f_sensor=self.f_sensor[:, index],
            names=tuple(names),
        )


@dataclass(frozen=True)
class BoneImuSequence(OverTime):
    """Calibrated IMUs: orientation of their segments, acceleration in world."""

    times: Array  #: (T,) seconds, strictly increasing
    R_world_bone: Array  #: (T, S, 3, 3) orientation of the segment's link frame; NaN as a whole where missing
    a_world: Array  #: (T, S, 3) acceleration of the sensor in world, gravity removed, m/s^2; NaN where missing
    p_bone_sensor: Array  #: (S, 3) lever arm: position of the sensor in the segment's link frame, m
    joints: tuple[str, ...]  #: S segments that carry the sensors, by their proximal joint
    rows = ("R_world_bone", "a_world")

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "joints", checked_names("bone IMU joints", self.joints))
        set_(self, "times", checked_times("bone IMU times", self.times))
        T, S = len(self.times), len(self.joints)
        freeze(self, "bone IMU", R_world_bone=(T, S, 3, 3), a_world=(T, S, 3), p_bone_sensor=(S, 3))
        checked_rotations("bone IMU R_world_bone", self.R_world_bone)

    def select(self, joints: Sequence[str]) -> Self:
        """Return the sensors of segments in the order of `joints`. `UnknownNameError`: a segment has no sensor."""
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
        """Join sensors at given times; `resample` those with other times. parts: any number of sensors each. times:
        (T,) s. `InvalidInputError`: there are none, or two of the same segment.
        """
        joints = [joint for part in parts for joint in part.joints]
        if not parts or len(set(joints)) < len(joints):
            raise InvalidInputError("bone_imus: there must be some, each of another segment")
        own = [p if np.array_equal(p.times, times) else p.resample(times) for p in parts]
        return cls(
            times=own[0].times,
            R_world_bone=np.concatenate([part.R_world_bone for part in own], axis=1),
            a_world=np.concatenate([part.a_world for part in own], axis=1),
            p_bone_sensor=np.concatenate([part.p_bone_sensor for part in own]),
            joints=tuple(joints),
        )

    def low_passed(self, cutoff_hz: float) -> Self:
        """Low-pass filter the accelerations; implausible values are kept and excluded from the filter. cutoff_hz: -3 dB
        frequency, Hz.
        """
        absurd = (np.abs(self.a_world) > _ABSURD_ACCELERATION).any(axis=-1, keepdims=True)
        out = np.where(absurd, np.nan, self.a_world)
        for s in range(len(self.joints)):
            out[:, s] = signals.low_pass_known(self.times, out[:, s], cutoff_hz)
        return replace(self, a_world=np.where(absurd, self.a_world, out))

    def resample(self, times: ArrayLike, max_gap: float = 0.1) -> Self:
        """Resample to other times, usually those of the video.

        Orientation is interpolated on the geodesic. Acceleration is averaged over +-1 frame with a triangular
        kernel ([1 4 1] / 6 at equal rates), of which the central second difference of positions is exact.

        Args:
            times: (T',) s. max_gap: longest gap that is interpolated, s; beyond it values are NaN.
        """
        times = checked_times("times to resample to", times)
        step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / 60
        return replace(
            self,
            times=times,
            R_world_bone=signals.interpolate_rotations(self.times, self.R_world_bone, times, max_gap),
            a_world=signals.hat_average(self.times, self.a_world, times, step, max_gap),
        )


@dataclass(frozen=True)
class ImuCalibration:
    """Rotations of each sensor to world and to its segment, and its position in the segment.

    ::

        R_world_bone = R_world_inertial . R_inertial_sensor . R_sensor_bone
        a_world      = R_world_inertial . R_inertial_sensor . f_sensor + g,    g = (0, 0, -9.80665)

    The paper has R^imu = R_kj^-1 R_kg R_k (eq. 1); the frames close only in the order above, with
    R_kg = R_world_inertial, R_k = R_inertial_sensor and R_kj = R_sensor_bone^-1. It subtracts an upward g (eq. 6);
    here g points down and is added.
    """

    sensors: tuple[str, ...]  #: S sensor names
    joints: tuple[str, ...]  #: S segments that carry them, by their proximal joint
    R_world_inertial: Array  #: (S, 3, 3) from each sensor's gravity-aligned reference to world
    R_sensor_bone: Array  #: (S, 3, 3) from the segment's link frame to sensor axes
    p_bone_sensor: Array  #: (S, 3) lever arm: position of the sensor in the link frame, m
    mounting_sd_deg: Array | None = None
    """(S,) standard deviation of R_sensor_bone about each axis, deg; NaN, or None for all: not stated."""

    def __post_init__(self) -> None:
        S = len(self.sensors)
        if len(self.joints) != S:
            raise CalibrationError(f"calibration: {S} sensors but {len(self.joints)} segments")
        try:
            object.__setattr__(self, "sensors", checked_names("calibration: sensor", self.sensors))
            object.__setattr__(self, "joints", checked_names("calibration: segment", self.joints))
        except InvalidInputError as error:
            raise CalibrationError(str(error)) from error
        rotations = ("R_world_inertial", "R_sensor_bone")
        freeze(self, "calibration", **dict.fromkeys(rotations, (S, 3, 3)), p_bone_sensor=(S, 3))
        for rotation in rotations:
            for name, matrix in zip(self.sensors, getattr(self, rotation), strict=True):
                if not so3.is_rotation(matrix, tolerance=1e-5):
                    raise CalibrationError(f"calibration of {name}: {rotation} is not a rotation")
        for name, lever in zip(self.sensors, self.p_bone_sensor, strict=True):
            if not np.linalg.norm(lever) <= 1:
                raise CalibrationError(
                    f"calibration of {name}: its lever arm is not finite or longer than 1 m; give metres"
                )
        if self.mounting_sd_deg is None:
            return
        freeze(self, "calibration", mounting_sd_deg=(S,))
        for name, sd in zip(self.sensors, self.mounting_sd_deg, strict=True):
            if not (0 <= sd <= 180 or np.isnan(sd)):
                raise CalibrationError(
                    f"calibration of {name}: mounting_sd_deg is {sd:g}, no standard deviation of an angle; "
                    "give degrees, or leave it out"
                )

    def select(self, sensors: tuple[str, ...]) -> Self:
        """Return the calibration of sensors in the order given. `UnknownNameError`: a sensor has no calibration."""
        index = indices_of("calibrated sensor", sensors, self.sensors)
        return replace(
            self,
            sensors=sensors,
            joints=tuple(self.joints[i] for i in index),
            R_world_inertial=self.R_world_inertial[index],
            R_sensor_bone=self.R_sensor_bone[index],
            p_bone_sensor=self.p_bone_sensor[index],
            mounting_sd_deg=None if self.mounting_sd_deg is None else self.mounting_sd_deg[index],
        )

    def apply(self, imus: ImuSequence) -> BoneImuSequence:
        """Return orientations of the segments and accelerations in world without gravity. `CalibrationError`: a sensor
        has no calibration.
        """
        missing = [name for name in imus.names if name not in self.sensors]
        if missing:
            raise CalibrationError(
                f"no calibration for the sensors {', '.join(missing)}; there is one for {', '.join(self.sensors)}"
            )
        own = self.select(imus.names)
        R_world_sensor = own.R_world_inertial @ imus.R_inertial_sensor
        a_world = np.einsum("tsij,tsj->tsi", R_world_sensor, imus.f_sensor) + GRAVITY_WORLD
        return BoneImuSequence(
            times=imus.times,
            R_world_bone=R_world_sensor @ own.R_sensor_bone,
            a_world=a_world,
            p_bone_sensor=own.p_bone_sensor,
            joints=own.joints,
        )
