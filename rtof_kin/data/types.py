"""The data that flows through the package, as frozen, validated records of read-only arrays.

Axes are time, then element, then component: (T, J, 3). Missing is NaN in the value and 0 in the
confidence, both. A different state of the data is a different type:
`ImuSequence` -> `ImuCalibration.apply` -> `BoneImuSequence`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.checks import (
    checked_names,
    checked_rotations,
    checked_times,
    indices_of,
    readonly,
)
from rtof_kin.core.errors import ShapeError, UnitError

Array = NDArray[np.float64]
STANDARD_GRAVITY = 9.81
GRAVITY_WORLD = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""Gravity in world, m/s^2. An accelerometer at rest reads its opposite."""


class Provenance(IntEnum):
    """Who saw a joint at an instant."""

    NOBODY = 0
    PRIOR = 1
    BRIDGED = 2
    IMU = 3
    CAMERA = 4
    CAMERA_AND_IMU = 5


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera, fixed in the world."""

    K: Array
    """(3, 3) intrinsic matrix, px."""
    R_camera_world: Array
    """(3, 3) rotation from world to camera axes."""
    t_camera_world: Array
    """(3,) world origin in camera coordinates, m: p_camera = R_camera_world p_world + t."""
    width_px: int
    """Image width, px."""
    height_px: int
    """Image height, px."""
    distortion: Array = None  # type: ignore[assignment]
    """(5,) OpenCV's k1, k2, p1, p2, k3; zeros where not given."""
    assumed: tuple[str, ...] = ()
    """What nobody measured of it, in words: 'focal length', 'pose'."""

    def __post_init__(self) -> None:
        distortion = np.zeros(5) if self.distortion is None else self.distortion
        set_ = object.__setattr__
        set_(self, "K", readonly("camera K", self.K, (3, 3)))
        set_(self, "R_camera_world", readonly("camera R_camera_world", self.R_camera_world, (3, 3)))
        set_(self, "t_camera_world", readonly("camera t_camera_world", self.t_camera_world, (3,)))
        set_(self, "distortion", readonly("camera distortion", distortion, (5,)))
        if not so3.is_rotation(self.R_camera_world, tolerance=1e-4):
            raise ShapeError("camera R_camera_world: not a rotation matrix")
        regular = self.K[0, 0] * self.K[1, 1] - self.K[0, 1] * self.K[1, 0] > 0
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0 and regular and np.allclose(self.K[2], [0, 0, 1])):
            raise ShapeError(
                "camera K: singular; it needs positive focal lengths on the diagonal and "
                "0, 0, 1 as its last row"
            )
        for field in ("K", "t_camera_world", "distortion"):
            if not np.all(np.isfinite(getattr(self, field))):
                raise ShapeError(f"camera {field}: not finite")
        if self.width_px <= 0 or self.height_px <= 0:
            raise ShapeError("camera: width_px and height_px must be positive")

    @classmethod
    def looking_at(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        focal_px: float,
        width_px: int = 1920,
        height_px: int = 1080,
    ) -> Camera:
        """An upright camera at `position` whose optical axis passes through `target` (world, m)."""
        position = np.asarray(position, dtype=float)
        forward = so3.unit(np.asarray(target, dtype=float) - position)
        right = so3.unit(np.cross(forward, [0.0, 0.0, 1.0]))
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[focal_px, 0, width_px / 2], [0, focal_px, height_px / 2], [0, 0, 1.0]])
        return cls(K, R, -R @ position, width_px, height_px)

    @property
    def center_world(self) -> Array:
        """(3,) optical centre in world, m."""
        return np.asarray(-self.R_camera_world.T @ self.t_camera_world)

    def to_camera(self, p_world: ArrayLike) -> Array:
        """World points (..., 3) in camera coordinates, m."""
        return np.asarray(np.asarray(p_world) @ self.R_camera_world.T + self.t_camera_world)

    def project(self, p_world: ArrayLike) -> Array:
        """Pixels (..., 2) of world points (..., 3); NaN for points not in front of the camera."""
        p = self.to_camera(p_world)
        depth = p[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(depth > 1e-6, p[..., :2] / depth, np.nan)
        return self._distort(xy) @ self.K[:2, :2].T + self.K[:2, 2]

    def normalise(self, uv_px: ArrayLike) -> Array:
        """Undistorted image-plane coordinates x/z, y/z (..., 2) of pixels (..., 2)."""
        xy_distorted = (np.asarray(uv_px) - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        xy = xy_distorted
        if np.any(self.distortion):
            for _ in range(20):  # fixed point, as OpenCV does
                xy = xy - (self._distort(xy) - xy_distorted)
        return np.asarray(xy)

    def rays_world(self, uv_px: ArrayLike) -> Array:
        """Unit directions (..., 3) in world from the optical centre through pixels (..., 2)."""
        xy = self.normalise(uv_px)
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return so3.unit(rays @ self.R_camera_world)

    def undistorted(self) -> Camera:
        """The same camera without distortion."""
        return replace(self, distortion=np.zeros(5))

    def _distort(self, xy: Array) -> Array:
        if not np.any(self.distortion):
            return xy
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        y_d = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([x_d, y_d], axis=-1)


@dataclass(frozen=True)
class KeypointSequence:
    """2D landmarks of one person seen by one camera."""

    camera: Camera
    """The camera that saw them."""
    times: Array
    """(T,) seconds, strictly increasing."""
    uv_px: Array
    """(T, L, 2) pixels; NaN where unseen."""
    confidence: Array
    """(T, L) in [0, 1]; 0 where unseen."""
    names: tuple[str, ...]
    """L landmark names."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("keypoint names", self.names))
        set_(self, "times", checked_times("keypoint times", self.times))
        T, L = len(self.times), len(self.names)
        uv = np.array(readonly("keypoints uv_px", self.uv_px, (T, L, 2)))
        confidence = np.array(readonly("keypoint confidence", self.confidence, (T, L)))
        if np.any((confidence < 0) | (confidence > 1)):
            raise ShapeError("keypoint confidence: outside [0, 1]; divide by the detector's maximum")
        if np.any(np.isinf(uv)):
            raise ShapeError("keypoints uv_px: infinite; write NaN where a landmark was not seen")
        missing = np.isnan(uv).any(axis=-1) | ~(confidence > 0)
        uv[missing], confidence[missing] = np.nan, 0.0
        set_(self, "uv_px", readonly("keypoints uv_px", uv, (T, L, 2)))
        set_(self, "confidence", readonly("keypoint confidence", confidence, (T, L)))

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return replace(
            self,
            times=self.times[frames],
            uv_px=self.uv_px[frames],
            confidence=self.confidence[frames],
        )

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(T, L) whether a landmark was seen."""
        return np.asarray(self.confidence > 0)

    def select(self, names: Sequence[str]) -> Self:
        """The landmarks named, in that order; those not present are NaN with confidence 0."""
        uv = np.full((len(self), len(names), 2), np.nan)
        confidence = np.zeros((len(self), len(names)))
        for i, name in enumerate(names):
            if name in self.names:
                j = self.names.index(name)
                uv[:, i], confidence[:, i] = self.uv_px[:, j], self.confidence[:, j]
        return replace(self, uv_px=uv, confidence=confidence, names=tuple(names))


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
        or its mean in the reference is most of it."""
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


_ABSURD_ACCELERATION = 1e4  # [m/s^2] hundreds of times what IMUs measure


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
        measures stays as it is, and is kept out of the others."""
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
            R_world_bone=signals.interpolate_rotations(
                self.times, self.R_world_bone, times, max_gap
            ),
            a_world=signals.hat_average(self.times, self.a_world, times, step, max_gap),
        )


@dataclass(frozen=True)
class PoseSequence:
    """Joint positions and segment orientations of one person in world."""

    times: Array
    """(T,) seconds, strictly increasing."""
    p_world_joint: Array
    """(T, J, 3) m; NaN where unknown."""
    R_world_bone: Array
    """(T, J, 3, 3) orientation of each joint's segment; NaN where unknown."""
    names: tuple[str, ...]
    """J joint names."""
    provenance: NDArray[np.uint8] = None  # type: ignore[assignment]
    """(T, J) `Provenance` of each joint; NOBODY where not given."""
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether the position is an estimate to rely on; where not given, whether it is finite."""
    orientation_observed: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether all three angles of the segment were seen; where False, its twist follows the
    parent. One row (J,) stands for all frames; all False where not given."""
    direction_observed: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(T, J) whether points of the segment beside joints showed the direction of its bone, as the far end
    of a hand does; what joints show of it follows from `located`. Given like `orientation_observed`."""
    sigma_rad: Array = None  # type: ignore[assignment]
    """(T, J) standard deviation per axis of the orientations, rad; NaN where it is not known, as it is
    everywhere where not given."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("pose names", self.names))
        set_(self, "times", checked_times("pose times", self.times))
        T, J = len(self.times), len(self.names)
        p = readonly("pose p_world_joint", self.p_world_joint, (T, J, 3))
        R = readonly("pose R_world_bone", self.R_world_bone, (T, J, 3, 3))
        checked_rotations("pose R_world_bone", R)
        known = np.isfinite(p).all(axis=-1)
        provenance = np.zeros((T, J)) if self.provenance is None else self.provenance
        if not np.all(np.isin(provenance, list(Provenance))):
            raise ShapeError(f"pose provenance: a value is none of {', '.join(map(repr, Provenance))}")
        valid = known if self.valid is None else self.valid
        valid = readonly("pose valid", valid, (T, J), np.bool_) & known
        set_(self, "p_world_joint", p)
        set_(self, "R_world_bone", R)
        set_(self, "provenance", readonly("pose provenance", provenance, (T, J), np.uint8))
        set_(self, "valid", readonly("pose valid", valid, (T, J), np.bool_))
        for name in ("orientation_observed", "direction_observed"):
            observed = np.zeros(J) if getattr(self, name) is None else getattr(self, name)
            if np.ndim(observed) == 1:  # the same in all frames
                observed = np.tile(observed, (T, 1))
            set_(self, name, readonly(f"pose {name}", observed, (T, J), np.bool_))
        sigma = np.full((T, J), np.nan) if self.sigma_rad is None else self.sigma_rad
        sigma = readonly("pose sigma_rad", sigma, (T, J))
        if np.any(sigma <= 0):
            raise ShapeError("pose sigma_rad: not positive; write NaN where it is not known")
        set_(self, "sigma_rad", sigma)

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, frames: slice) -> Self:
        return self.posed(frames, self.p_world_joint[frames])

    def posed(self, frames: slice, p_world_joint: Array, R_world_bone: Array | None = None) -> Self:
        """Some of the frames in other poses; with the same orientations where none are given, else their
        spread is not known any more."""
        sigma_rad = self.sigma_rad[frames]
        return replace(
            self,
            times=self.times[frames],
            p_world_joint=p_world_joint,
            R_world_bone=self.R_world_bone[frames] if R_world_bone is None else R_world_bone,
            provenance=self.provenance[frames],
            valid=self.valid[frames],
            orientation_observed=self.orientation_observed[frames],
            direction_observed=self.direction_observed[frames],
            sigma_rad=sigma_rad if R_world_bone is None else np.full_like(sigma_rad, np.nan),
        )

    @property
    def located(self) -> NDArray[np.bool_]:
        """(T, J) whether somebody saw where a joint is; without any provenance, whether it is valid."""
        given = bool(self.provenance.any())
        return np.asarray(self.valid & ((self.provenance >= Provenance.IMU) | (not given)))

    @property
    def rate_hz(self) -> float:
        """Frames per second, from the median step; 60 for a single frame."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0
