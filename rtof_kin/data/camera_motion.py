"""Turning of a handheld camera, and its keypoints as a camera that stands still would have seen them.

Bearings of a camera that turns about its optical centre differ from one instant to another by a rotation,
whatever the distance (Hartley and Zisserman, Multiple View Geometry, 2004, sec. 8.4). Not modelled are the
translation of a hand and the rolling shutter, which takes an image's rows up to 30 ms after each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_rotations, checked_times, freeze
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import LONGEST_GAP, Camera, CameraTurning
from rtof_kin.data.keypoints import KeypointSequence

_SIGMA_TILT: Final = np.radians(1.0)  # by a phone's accelerometer, whose axes are not quite the camera's
_WIDEST: Final = np.radians(65.0)  # from the still camera's axis; pixels are stretched 2.4 to 5.6 times there


@dataclass(frozen=True)
class CameraMotion:
    """Orientation of a camera over time, relative to its first."""

    times: Array  #: (T,) s, on the clock of the keypoints
    R_first_camera: Array
    """(T, 3, 3) camera axes to those of a fixed orientation, e.g. the first; NaN as a whole where unknown."""
    sigma: float = 0.0  #: Standard deviation per axis of each rotation, rad
    up_first: Array | None = None
    """(3,) unit vector up in the axes of the fixed orientation, where gravity was measured."""
    drift: float = 0.0  #: Standard deviation of a steady drift of the heading, rad/s
    focal_px: float | None = None  #: Focal length that the rotations were estimated with from images, px

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("camera motion times", self.times))
        freeze(self, "camera motion", R_first_camera=(len(self.times), 3, 3))
        checked_rotations("camera motion R_first_camera", self.R_first_camera)
        if np.isnan(self.R_first_camera).all():
            raise InvalidInputError("camera motion: no rotation is known")
        for name in ("sigma", "drift"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidInputError(f"camera motion {name}: {getattr(self, name)} is no standard deviation")
        if self.focal_px is not None and not (np.isfinite(self.focal_px) and self.focal_px > 0):
            raise InvalidInputError(f"camera motion focal_px: {self.focal_px} is not positive")
        if self.up_first is not None:
            freeze(self, "camera motion", up_first=(3,))
            if abs(np.linalg.norm(self.up_first) - 1) > 1e-3:
                raise InvalidInputError("camera motion up_first: not a unit vector")

    @property
    def R_first_still(self) -> Array:
        """(3, 3) mean orientation: that of a camera that stands still instead."""
        R = self.R_first_camera
        return so3.nearest_rotation(R[np.isfinite(R).all(axis=(1, 2))].mean(axis=0))

    @property
    def angles(self) -> Array:
        """(T,) rad from the mean orientation; NaN where unknown."""
        angles = np.full(len(self.times), np.nan)
        known = np.isfinite(self.R_first_camera).all(axis=(1, 2))
        angles[known] = so3.angle_between(self.R_first_still, self.R_first_camera[known])
        return angles

    def shifted(self, seconds: float) -> Self:
        """Return the motion with seconds added to its times; seconds: s."""
        return replace(self, times=self.times + seconds)


def stabilised(keypoints: KeypointSequence, motion: CameraMotion) -> KeypointSequence:
    """Return keypoints as a camera without distortion that stands still in the mean orientation sees them.

    The declared pose of the camera is taken for that of the mean orientation. Where the motion knows gravity, the
    declared heading and position stay and the tilt is the measured one. `InvalidInputError`: the motion has no rotation
    at the times of the keypoints, or was applied before.

    Returns:
        Keypoints with `Camera.stabilised`: they may lie beyond the borders of its image. They are missing
        where the rotation is unknown or they lie more than 65 degrees from the still camera's axis.
    """
    R, still = still_camera_of(keypoints.camera, keypoints.times, motion)
    return turned(keypoints, R, still)


def still_camera_of(camera: Camera, times: Array, motion: CameraMotion) -> tuple[Array, Camera]:
    """Return rotations (T, 3, 3) from the camera, at times (T,) s of its frames, to one that stands still, and that
    one; see `stabilised`, whose errors are raised.
    """
    if camera.stabilised:
        raise InvalidInputError("camera motion: these keypoints are stabilised already; leave it out")
    known = np.isfinite(motion.R_first_camera).all(axis=(1, 2))
    span, step = (motion.times[known][[0, -1]], np.median(np.diff(times)) if len(times) > 1 else 0.0)
    inside = (times >= span[0] - 1.5 * step) & (times <= span[1] + 1.5 * step)  # a frame more at either end
    R = signals.interpolate_rotations(motion.times, motion.R_first_camera[:, None], np.clip(times, *span), LONGEST_GAP)[
        :, 0
    ]
    R[~inside] = np.nan
    if np.isnan(R).all():
        raise InvalidInputError(
            f"camera motion: known from {span[0]:g} to {span[1]:g} s, keypoints are from {times[0]:g} to "
            f"{times[-1]:g} s; put it on their clock"
        )
    R_first_still = motion.R_first_still
    R_still, uncertainty = camera.R_camera_world, camera.uncertainty
    if motion.up_first is not None:  # the tilt is measured
        R_still = so3.minimal_rotation(R_still[:, 2], R_first_still.T @ motion.up_first) @ R_still
        if uncertainty is not None:
            uncertainty = replace(uncertainty, tilt=min(uncertainty.tilt, _SIGMA_TILT))
    still = replace(camera.undistorted(), R_camera_world=R_still, t_camera_world=-R_still @ camera.center_world)
    still = replace(still, uncertainty=uncertainty, stabilised=True, heading_drift=motion.drift)
    return np.asarray(R_first_still.T @ R), still


def turned(keypoints: KeypointSequence, R_camera_seen: Array, camera: Camera) -> KeypointSequence:
    """Return keypoints as another camera at the same place, without distortion, sees them, by rotations (T, 3, 3) of
    their axes to its; missing where the rotation is, or more than 65 degrees from the axis of the other camera.
    """
    xy = keypoints.camera.normalise(keypoints.uv_px)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    rays = np.einsum("tij,tlj->tli", R_camera_seen, rays)
    near = rays[..., 2] > np.cos(_WIDEST) * np.linalg.norm(rays, axis=-1)  # False for NaN
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = rays[..., :2] / rays[..., 2:] @ camera.K[:2, :2].T + camera.K[:2, 2]
    turning = keypoints.turning
    if turning is not None:
        turning = turning.followed_by(R_camera_seen, camera.K)
    elif not keypoints.camera.stabilised:  # else the camera of the video is unknown
        turning = CameraTurning(keypoints.camera, camera.K, R_camera_seen)
    return replace(
        keypoints,
        camera=camera,
        uv_px=np.where(near[..., None], uv, np.nan),
        confidence=np.where(near, keypoints.confidence, 0.0),
        turning=turning,
    )
