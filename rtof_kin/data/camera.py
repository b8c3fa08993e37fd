"""Pinhole camera with OpenCV's distortion model, calibrated or with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_rotations, freeze
from rtof_kin.core.errors import InvalidInputError


@dataclass(frozen=True)
class CameraUncertainty:
    """Standard deviations of what is assumed of a camera; 0 for what is known."""

    focal: float = 0.0  #: [1] Relative, of the focal length
    tilt: float = 0.0  #: [rad] Each, of pitch and roll: rotations about the camera's x and z axes through its centre
    height: float = 0.0  #: [m] Of the camera's centre along the world's z axis
    k1: float = 0.0  #: [1] Of the first radial distortion coefficient
    roll: float | None = None  #: [rad] Of roll, where it is not that of `tilt`
    of_motion: bool = False
    """Whether floor and posture of the recording were used for it already; only walking narrows it then."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value is None or 0 <= value < np.inf):
                raise InvalidInputError(f"camera uncertainty {name}: {value} is no standard deviation")


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, fixed in the world."""

    K: Array  #: (3, 3) intrinsic matrix, px
    R_camera_world: Array  #: (3, 3) rotation from world to camera axes
    t_camera_world: Array  #: (3,) world origin in camera coordinates, m: p_camera = R_camera_world p_world + t
    width_px: int  #: Image width, px
    height_px: int  #: Image height, px
    distortion: Array = field(default_factory=lambda: np.zeros(5))  #: (5,) OpenCV's k1, k2, p1, p2, k3
    assumed: tuple[str, ...] = ()  #: Assumed, not measured, properties in words, e.g. 'focal length', 'pose'.
    uncertainty: CameraUncertainty | None = None
    """Of an uncalibrated camera, whose unknowns `reconstruct` estimates; None where it is calibrated."""
    stabilised: bool = False
    """Whether it stands for a camera that turned: points may lie beyond the borders of its image."""
    heading_drift: float = 0.0
    """Standard deviation, rad/s, of a steady drift of the heading where a gyroscope measured the turning;
    `reconstruct` estimates the drift where there are sensors."""
    accuracy: CameraUncertainty | None = None
    """Measured standard deviations of a calibrated camera; None where they are not stated."""

    def __post_init__(self) -> None:
        if self.distortion is None:  # callers may say None
            object.__setattr__(self, "distortion", np.zeros(5))
        freeze(self, "camera", K=(3, 3), R_camera_world=(3, 3), t_camera_world=(3,), distortion=(5,))
        if not so3.is_rotation(self.R_camera_world, tolerance=1e-4):
            raise InvalidInputError("camera R_camera_world: not a rotation matrix")
        regular = self.K[0, 0] * self.K[1, 1] - self.K[0, 1] * self.K[1, 0] > 0
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0 and regular and np.allclose(self.K[2], [0, 0, 1])):
            raise InvalidInputError(
                "camera K: singular; it needs positive focal lengths on the diagonal and 0, 0, 1 as its last row"
            )
        for name in ("K", "t_camera_world", "distortion"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise InvalidInputError(f"camera {name}: not finite")
        if self.width_px <= 0 or self.height_px <= 0:
            raise InvalidInputError("camera: width_px and height_px must be positive")

    @classmethod
    def looking_at(
        cls, position: ArrayLike, target: ArrayLike, focal_px: float, width_px: int = 1920, height_px: int = 1080
    ) -> Camera:
        """Return an upright camera whose optical axis passes through a point; position, target: (3,) in world, m.
        focal_px: focal length, px.
        """
        position = np.asarray(position, dtype=float)
        forward = so3.unit(np.asarray(target, dtype=float) - position)
        right = so3.unit(np.cross(forward, [0.0, 0.0, 1.0]))
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[focal_px, 0, width_px / 2], [0, focal_px, height_px / 2], [0, 0, 1.0]])
        return cls(K, R, -R @ position, width_px, height_px)

    @property
    def center_world(self) -> Array:
        """Optical centre (3,) in world, m."""
        return np.asarray(-self.R_camera_world.T @ self.t_camera_world)

    def to_camera(self, p_world: ArrayLike) -> Array:
        """Transform points to camera coordinates (..., 3), m; p_world: (..., 3) m."""
        return np.asarray(np.asarray(p_world) @ self.R_camera_world.T + self.t_camera_world)

    def project(self, p_world: ArrayLike) -> Array:
        """Project points to pixels (..., 2); NaN for points behind the camera. p_world: (..., 3) m."""
        p = self.to_camera(p_world)
        depth = p[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(depth > 1e-6, p[..., :2] / depth, np.nan)
        return self._distort(xy) @ self.K[:2, :2].T + self.K[:2, 2]

    def normalise(self, uv_px: ArrayLike) -> Array:
        """Return undistorted image-plane coordinates x/z, y/z (..., 2); uv_px: (..., 2) pixels."""
        xy_distorted = (np.asarray(uv_px) - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        xy = xy_distorted
        if np.any(self.distortion):
            for _ in range(20):  # fixed-point iteration as in OpenCV
                xy = xy - (self._distort(xy) - xy_distorted)
        return np.asarray(xy)

    def rays_world(self, uv_px: ArrayLike) -> Array:
        """Return unit directions (..., 3) in world from the optical centre through pixels; uv_px: (..., 2) pixels."""
        xy = self.normalise(uv_px)
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return so3.unit(rays @ self.R_camera_world)

    def carried(self, before: Camera, after: Camera) -> Camera:
        """Return the camera with its pose relative to another one kept while that one is corrected."""
        relative = self.R_camera_world @ before.R_camera_world.T
        R = so3.nearest_rotation(relative @ after.R_camera_world)
        t = self.t_camera_world + relative @ (after.t_camera_world - before.t_camera_world)
        return replace(self, R_camera_world=R, t_camera_world=t)

    def undistorted(self) -> Camera:
        """Return the camera without distortion."""
        return replace(self, distortion=np.zeros(5)) if np.any(self.distortion) else self

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


LONGEST_GAP: Final = 0.3  # [s] between known rotations that is interpolated


@dataclass(frozen=True)
class CameraTurning:
    """Rotations of a handheld camera about its centre, at the frames of its keypoints."""

    camera: Camera  #: Camera of the video; its pose is not used
    K_still: Array  #: (3, 3) intrinsic matrix of the camera that stands still instead, px; it has no distortion
    R_still_camera: Array  #: (T, 3, 3) axes of the camera to those of the still one; NaN as a whole where unknown

    def __post_init__(self) -> None:
        freeze(self, "camera turning", K_still=(3, 3), R_still_camera=("T", 3, 3))
        checked_rotations("camera turning R_still_camera", self.R_still_camera)

    def __getitem__(self, frames: Any) -> Self:
        return replace(self, R_still_camera=self.R_still_camera[frames])

    def resample(self, times: Array, at: Array) -> Self:
        """Return the rotations interpolated to other times; times: (T,) s, of the frames. at: (T',) s."""
        R = signals.interpolate_rotations(times, self.R_still_camera[:, None], at, LONGEST_GAP)
        return replace(self, R_still_camera=R[:, 0])

    def followed_by(self, R_other_still: Array, K_other: Array) -> Self:
        """Return the same for keypoints that were turned once more, from the axes of the still camera to those of
        another.
        """
        return replace(self, R_still_camera=R_other_still @ self.R_still_camera, K_still=K_other)

    def in_video(self, uv_still: Array, frames: Any) -> Array:
        """Return pixels (n, ..., 2) of the video for those of the still camera; NaN where the camera looked
        elsewhere.
        """
        xy = (uv_still - self.K_still[:2, 2]) @ np.linalg.inv(self.K_still[:2, :2]).T
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        R = self.R_still_camera[frames]
        seen = np.einsum("nji,n...j->n...i", R, rays)
        own = replace(self.camera, R_camera_world=np.eye(3), t_camera_world=np.zeros(3))
        return own.project(seen)
