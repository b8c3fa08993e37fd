"""`CameraTurning`: back from the image of a camera that stands still to the video of the one that turned."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_rotations, freeze
from rtof_kin.data.camera import Camera

LONGEST_GAP: Final = 0.3  # [s] between known rotations that is interpolated


@dataclass(frozen=True)
class CameraTurning:
    """Rotations of a handheld camera about its centre, at the frames of its keypoints."""

    camera: Camera
    """Camera of the video; its pose is not used."""
    K_still: Array
    """(3, 3) intrinsic matrix of the camera that stands still instead, px; it has no distortion."""
    R_still_camera: Array
    """(T, 3, 3) axes of the camera to those of the still one; NaN as a whole where unknown."""

    def __post_init__(self) -> None:
        freeze(self, "camera turning", K_still=(3, 3), R_still_camera=("T", 3, 3))
        checked_rotations("camera turning R_still_camera", self.R_still_camera)

    def __getitem__(self, frames: Any) -> Self:
        return replace(self, R_still_camera=self.R_still_camera[frames])

    def resample(self, times: Array, at: Array) -> Self:
        """Return the rotations interpolated to other times.

        Args:
            times: (T,) s, of the frames. at: (T',) s.
        """
        R = signals.interpolate_rotations(times, self.R_still_camera[:, None], at, LONGEST_GAP)
        return replace(self, R_still_camera=R[:, 0])

    def followed_by(self, R_other_still: Array, K_other: Array) -> Self:
        """Return the same for keypoints that were turned once more.

        Args:
            R_other_still: (T, 3, 3) axes of the still camera to those of another.
        """
        return replace(self, R_still_camera=R_other_still @ self.R_still_camera, K_still=K_other)

    def in_video(self, uv_still: Array, frames: Any) -> Array:
        """Return pixels (n, ..., 2) of the video; NaN where the camera looked elsewhere.

        Args:
            uv_still: (n, ..., 2) pixels of the still camera.
        """
        xy = (uv_still - self.K_still[:2, 2]) @ np.linalg.inv(self.K_still[:2, :2]).T
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        R = self.R_still_camera[frames]
        seen = np.einsum("nji,n...j->n...i", R, rays)
        own = replace(self.camera, R_camera_world=np.eye(3), t_camera_world=np.zeros(3))
        return own.project(seen)
